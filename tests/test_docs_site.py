"""What the docs site turns: links to and from the pages at the top of the tree, and equations."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mkdocs", reason="it comes with the extra docs")

from tools.docs_site.hooks import TREE, breakable, examples_page, from_top, to_top, typeset, without_roles

STEP_IN_CI = re.compile(r'^step "docs site" .*/mkdocs" (.*) --site-dir', re.MULTILINE)
SITE = "{site_name: one page, theme: mkdocs, plugins: []}"


def built_as_in_ci(folder: Path, page: str) -> subprocess.CompletedProcess[str]:
    """Build a site of one page with the arguments of the step in .ci/run."""
    (arguments,) = STEP_IN_CI.findall((TREE / ".ci" / "run").read_text(encoding="utf-8"))
    (folder / "docs").mkdir()
    (folder / "docs" / "index.md").write_text(page, encoding="utf-8")
    (folder / "mkdocs.yml").write_text(SITE, encoding="utf-8")
    command = [sys.executable, "-m", "mkdocs", *shlex.split(arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)  # noqa: S603 - our own text


@pytest.mark.parametrize(
    ("link", "page"),
    [
        ("docs/states.md#limits", "states.md#limits"),
        ("docs/pictures/move.svg", "pictures/move.svg"),
        ("CONTRIBUTING.md", "contributing.md"),
        ("CHANGELOG.md#unreleased", "changelog.md#unreleased"),
        ("examples/01_first_move.py", "examples.md#01_first_move-py"),
        ("#your-own-axis", "#your-own-axis"),
        ("https://semver.org/", "https://semver.org/"),
    ],
)
def test_a_link_of_a_file_at_the_top_leads_to_the_page(link: str, page: str) -> None:
    assert from_top(link) == page


@pytest.mark.parametrize(
    ("link", "page"),
    [
        ("../README.md#your-own-axis", "index.md#your-own-axis"),
        ("../../README.md", "../index.md"),
        ("../CHANGELOG.md", "changelog.md"),
        ("../examples/05_own_law/cascade_law.py", "examples.md#05_own_law-cascade_law-py"),
        ("../../examples/01_first_move.py", "../examples.md#01_first_move-py"),
        ("README.md", "README.md"),
        ("../states.md#x", "../states.md#x"),
        ("law.md", "law.md"),
        ("#here", "#here"),
    ],
)
def test_a_link_of_a_page_to_a_file_at_the_top_leads_to_its_page(link: str, page: str) -> None:
    assert to_top(link) == page


@pytest.mark.parametrize(("link", "leads_somewhere"), [("index.md", True), ("nowhere.md", False)])
def test_the_step_in_ci_fails_on_a_broken_link(tmp_path: Path, link: str, leads_somewhere: bool) -> None:
    built = built_as_in_ci(tmp_path, f"[a link]({link})\n")
    assert (built.returncode == 0) is leads_somewhere, built.stderr
    assert leads_somewhere or "nowhere.md" in built.stderr


def test_an_equation_is_typeset_with_its_number_beside_it() -> None:
    block = typeset(r"a_{12} = \frac{1 - a_{22}}{p} \tag{1}", block=True)
    assert block.startswith("<math")
    assert 'display="block"' in block
    assert "<mfrac>" in block
    assert block.endswith('<p class="equation-number">(1)</p>')
    assert "tag" not in block
    assert 'display="inline"' in typeset("u", block=False)


@pytest.mark.parametrize(
    ("docstring", "shown"),
    [
        ("see :class:<code>~a.b.Drive</code>", "see <code>Drive</code>"),
        ("see :meth:<code>Law.stop</code>", "see <code>Law.stop</code>"),
        ("see <code>~a.b</code>", "see <code>~a.b</code>"),
        ('<p>by its name::</p>\n<div class="highlight">', '<p>by its name:</p>\n<div class="highlight">'),
        ("<p>the key a::</p>\n<p>", "<p>the key a::</p>\n<p>"),
        ('<p>::</p>\n<div class="highlight">', '\n<div class="highlight">'),
    ],
)
def test_the_reference_shows_the_names_in_sphinx_roles(docstring: str, shown: str) -> None:
    assert without_roles(docstring) == shown


def test_every_example_is_on_the_page_of_the_examples_where_a_link_to_it_leads() -> None:
    page = examples_page(TREE / "examples")
    files = [path for path in (TREE / "examples").glob("**/*") if path.suffix in {".py", ".toml", ".dbc"}]
    files = [path for path in files if "build" not in path.parts]
    assert files
    for path in files:
        assert path.read_text(encoding="utf-8").strip() in page
        place = from_top(path.relative_to(TREE).as_posix()).partition("#")[2]
        assert f"{{ #{place} }}\n" in page


@pytest.mark.parametrize(
    ("code", "shown"),
    [
        ("moving_speed_stage", "moving_speed_stage"),
        ("service/tick.py", "service/<wbr>tick.py"),
        ("demo --fast", 'demo <span class="whole">--fast</span>'),
        ("run /etc/twostage-servo/x", 'run /etc/<wbr><span class="whole">twostage-servo/</span><wbr>x'),
        ("&lt;a-b&gt;", '<span class="whole">&lt;a-b&gt;</span>'),
    ],
)
def test_code_in_a_sentence_is_broken_behind_a_slash_alone(code: str, shown: str) -> None:
    assert breakable(code) == shown
