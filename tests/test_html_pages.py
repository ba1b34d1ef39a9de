"""The HTML reports' environment: values are escaped, and none may be missing."""

from pathlib import Path

import jinja2
import pytest

import twostage_servo
from twostage_servo.faults.cell import Cell
from twostage_servo.faults.report import as_page
from twostage_servo.faults.runner import Result
from twostage_servo.html_pages import page
from twostage_servo.paper.report import typeset

PACKAGE = Path(twostage_servo.__file__).parent


def test_every_value_is_escaped() -> None:
    cell = Cell(2, "<script>alert(1)</script>", "cruising", "Q", "Q", "stale_feedback", 5.4, 12.8, axis="x")
    shown = as_page(Result([cell], [], {"x": "mm"}), 1, 'axis "x" of <b>demo</b>')
    assert "<script>" not in shown
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in shown
    assert "&lt;b&gt;demo&lt;/b&gt;" in shown


def test_a_symbol_has_its_index_and_the_rest_is_escaped() -> None:
    assert typeset("x_o1 < A_o & x_12_b") == "x<sub>o1</sub> &lt; A<sub>o</sub> &amp; x<sub>12</sub>_b"


def test_a_value_that_is_missing_is_an_error() -> None:
    with pytest.raises(jinja2.UndefinedError):
        page("faults/report.html.jinja", what="x")


def test_each_template_stands_in_the_package_and_is_filled_by_a_module_beside_it() -> None:
    templates = sorted(PACKAGE.rglob("*.jinja"))
    assert [path.relative_to(PACKAGE).as_posix() for path in templates] == [
        "faults/report.html.jinja",
        "paper/report.html.jinja",
    ]
    for path in templates:
        source = path.with_name("report.py").read_text("utf-8")
        assert f'"{path.relative_to(PACKAGE).as_posix()}"' in source
