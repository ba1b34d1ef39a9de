"""Hooks of MkDocs: pages from the top of the tree, and equations without a script in the reader's browser.

README.md, CONTRIBUTING.md and CHANGELOG.md stay where everybody looks for them; here they become pages of the site, and
their links are adapted. The files of examples/ become one page. Equations become MathML as the page is built.
Docstrings are written with Sphinx's roles, which Markdown does not know: the reference shows only the names in them.
Code in a sentence may be broken behind a slash, and nowhere within an option or a name.
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

EXAMPLES: Final = "examples"
"""Folder whose files are shown on one page, ``examples.md``."""

_LANGUAGES: Final = {".py": "python", ".toml": "toml", ".dbc": "text"}
"""How each kind of example is highlighted."""

_LINK: Final = re.compile(r"(?<=\]\()([^)\s]+)(?=\))")
_EQUATION: Final = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
_TAG: Final = re.compile(r"\\tag\{([^}]*)\}")
_ROLE: Final = re.compile(r":(?:attr|class|data|exc|func|meth|mod):<code>(?:~[\w.]*\.)?([^<]*)</code>")
_INLINE_CODE: Final = re.compile(r"(?<!<pre>)(?<!</span>)<code>([^<]*)</code>")
_SLASH: Final = re.compile(r"(?<=\w)/(?=\w)")
_OPTION: Final = re.compile(r"[^\s<>]*-[^\s<>]*")
_LITERAL_BLOCK: Final = re.compile(r"(?:<p>:|(?<=\S):):</p>(?=\s*<(?:div|pre)\b)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages from the top of the tree."""
    for name, page in PAGES.items():
        text = (TREE / name).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=_LINK.sub(lambda link: from_top(link[1]), text)))
    files.append(File.generated(config, f"{EXAMPLES}.md", content=examples_page(TREE / EXAMPLES)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001 - MkDocs' own
    """Turn a page's links to files at the top of the tree."""
    return _LINK.sub(lambda link: to_top(link[1]), markdown)


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001 - likewise
    """Typeset a page's equations, and leave only names of the roles in its docstrings."""
    content = _EQUATION.sub(lambda found: typeset(html.unescape(found[2]), block=found[1] == "div"), content)
    return _INLINE_CODE.sub(lambda found: f"<code>{breakable(found[1])}</code>", without_roles(content))


def examples_page(folder: Path) -> str:
    """Return the page of the examples: each file of the folder by its name, but what an installation leaves there."""
    parts = ["# Examples\n"]
    for path in sorted(path for path in (*folder.glob("*"), *folder.glob("*/*")) if path.suffix in _LANGUAGES):
        name = path.relative_to(folder).as_posix()
        text = path.read_text(encoding="utf-8").strip()
        parts.append(f"## {name} {{ #{place_of(name)} }}\n\n```{_LANGUAGES[path.suffix]}\n{text}\n```\n")
    return "\n".join(parts)


def place_of(example: str) -> str:
    """Return the anchor of an example on its page."""
    return re.sub(r"\W", "-", example)


def page_of(path: str) -> str | None:
    """Return the page on which the site shows a file at the top of the tree; None for any other file."""
    if path.startswith(f"{EXAMPLES}/"):
        return f"{EXAMPLES}.md#{place_of(path.removeprefix(f'{EXAMPLES}/'))}"
    return PAGES.get(path)


def from_top(link: str) -> str:
    """Return what a link of a file at the top of the tree is on the site."""
    path, mark, place = link.partition("#")
    return (page_of(path) or path.removeprefix("docs/")) + mark + place


def to_top(link: str) -> str:
    """Return what a link to a file at the top of the tree is on the site."""
    path, mark, place = link.partition("#")
    steps, name = path[: path.rfind("../") + 3] if "../" in path else "", path.rpartition("../")[2]
    page = page_of(name)
    # A page in docs/ leaves it by its last step up.
    return f"{steps.removesuffix('../')}{page}{mark}{place}" if steps and page else link


def breakable(code: str) -> str:
    """Return code as it stands in a sentence: a path may be broken behind each slash, an option in no place."""
    return _OPTION.sub(lambda word: f'<span class="whole">{word[0]}</span>', _SLASH.sub("/<wbr>", code))


def without_roles(content: str) -> str:
    """Return a page without Sphinx's markup: a role becomes its name, a tilde leaves the last part of it."""
    content = _ROLE.sub(r"<code>\1</code>", content)
    return _LITERAL_BLOCK.sub(lambda found: "" if found[0].startswith("<") else ":</p>", content)


def typeset(latex: str, *, block: bool) -> str:
    """Return an equation as MathML, its number beside it."""
    tags = _TAG.findall(latex)
    mathematics: str = convert(_TAG.sub("", latex).strip(), display="block" if block else "inline")
    return mathematics + "".join(f'<p class="equation-number">({tag})</p>' for tag in tags)
