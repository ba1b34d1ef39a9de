"""Hooks of MkDocs: files from the top of the tree, and equations without a script in the reader's browser.

README.md, CONTRIBUTING.md and CHANGELOG.md stay where everybody looks for them; here they become pages of the site, and
their links are adapted. The examples come onto the site as they are. Equations become MathML as the page is built.
Docstrings are written with Sphinx's roles, which Markdown does not know: the reference shows only the names in them.
"""

import html
import re
from pathlib import Path
from typing import Final

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

TREE: Final = Path(__file__).resolve().parents[2]
PAGES: Final = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
"""Files at the top of the tree, and the pages that they become."""
EXAMPLES: Final = "examples/"
"""The folder at the top of the tree whose files the site has as well, under the same names."""
EXAMPLE_KINDS: Final = frozenset({".py", ".toml", ".dbc"})
"""What is on the site of that folder: what somebody has written, and not what an installation leaves there."""

_LINK: Final = re.compile(r"(?<=\]\()([^)\s]+)(?=\))")
_EQUATION: Final = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
_TAG: Final = re.compile(r"\\tag\{([^}]*)\}")
_ROLE: Final = re.compile(r":(?:attr|class|data|exc|func|meth|mod):<code>(?:~[\w.]*\.)?([^<]*)</code>")
_LITERAL_BLOCK: Final = re.compile(r"(?:<p>:|(?<=\S):):</p>(?=\s*<(?:div|pre)\b)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages from the top of the tree, and the examples."""
    for name, page in PAGES.items():
        text = (TREE / name).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=_LINK.sub(lambda link: from_top(link[1]), text)))
    for path in sorted((TREE / EXAMPLES).rglob("*")):
        if path.suffix in EXAMPLE_KINDS:
            files.append(File.generated(config, path.relative_to(TREE).as_posix(), abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001 - MkDocs' own
    """Turn a page's links to files at the top of the tree."""
    return _LINK.sub(lambda link: to_top(link[1]), markdown)


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001 - likewise
    """Typeset a page's equations, and leave only names of the roles in its docstrings."""
    content = _EQUATION.sub(lambda found: typeset(html.unescape(found[2]), block=found[1] == "div"), content)
    return without_roles(content)


def from_top(link: str) -> str:
    """Return what a link of a file at the top of the tree is on the site."""
    path, mark, place = link.partition("#")
    return PAGES.get(path, path.removeprefix("docs/")) + mark + place


def to_top(link: str) -> str:
    """Return what a link to a file at the top of the tree is on the site."""
    path, mark, place = link.partition("#")
    steps, name = path[: path.rfind("../") + 3] if "../" in path else "", path.rpartition("../")[2]
    # A page in docs/ leaves it by its last step up.
    if not steps or not (name in PAGES or name.startswith(EXAMPLES)):
        return link
    return f"{steps.removesuffix('../')}{PAGES.get(name, name)}{mark}{place}"


def without_roles(content: str) -> str:
    """Return a page without Sphinx's markup: a role becomes its name, a tilde leaves the last part of it."""
    content = _ROLE.sub(r"<code>\1</code>", content)
    return _LITERAL_BLOCK.sub(lambda found: "" if found[0].startswith("<") else ":</p>", content)


def typeset(latex: str, *, block: bool) -> str:
    """Return an equation as MathML, its number beside it."""
    tags = _TAG.findall(latex)
    mathematics: str = convert(_TAG.sub("", latex).strip(), display="block" if block else "inline")
    return mathematics + "".join(f'<p class="equation-number">({tag})</p>' for tag in tags)
