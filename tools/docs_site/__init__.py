"""What the docs site needs beyond MkDocs: ``mkdocs build --strict``."""
