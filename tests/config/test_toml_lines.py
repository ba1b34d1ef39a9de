"""The scanner against tomllib: the same keys, on the lines where a writer of its own has put them."""

import json
import tomllib
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twostage_servo.config.toml_lines import Clash, Path, find_clash, key_lines, split_key

SCALARS = st.sampled_from(
    [
        *("1", "-1.5e3", "+inf", "0xff_ff", "true", "1979-05-27 07:32:00", "07:32:00.5", "1979-05-27T07:32:00-08:00"),
        *("''", '""', '\'# = [ ] { } """\'', r'"\" # ] } \\"', "''''''", '""""""', "'''it''s'''", '"""""quoted"""""'),
        *("''''quoted'''''", '"""\n# no comment\n[no.header]\nno = "key"\n"""', "'''\n[no]\nno = 1 # '\n'''"),
        *(r'"""a \""" b = 1"""', '"""\\\n   folded"""'),
    ]
)
BLANKS = st.sampled_from(["", " ", "\t"])
BREAKS = st.sampled_from(["", " ", "\n", " # comment ]}=[{\n", "\n\n  "])


class Writer:
    """Writes a random TOML text and notes the line of every key."""

    def __init__(self, draw: st.DrawFn) -> None:
        self.draw = draw
        self.text = ""
        self.lines: dict[Path, int] = {}
        self.names = 0

    def name(self) -> str:
        self.names += 1
        return self.draw(st.sampled_from(["a", "a-b", "é", "a.b", 'q"', "\\", "x y", "# [", "=", ""])) + str(self.names)

    def key(self, parts: list[str]) -> None:
        texts = [part if part.isascii() and part.replace("-", "").isalnum() else json.dumps(part) for part in parts]
        if self.draw(st.booleans()):
            texts = [
                text if "'" in part or '"' in part else f"'{part}'" for text, part in zip(texts, parts, strict=True)
            ]
        self.text += f"{self.draw(BLANKS)}.{self.draw(BLANKS)}".join(texts)

    def note(self, path: Path) -> None:
        self.lines[path] = self.text.count("\n") + 1

    def pair(self, table: Path, depth: int) -> None:
        parts = [self.name() for _ in range(self.draw(st.integers(1, 3)))]
        path = (*table, *parts)
        for length in range(len(table) + 1, len(path) + 1):
            self.note(path[:length])
        self.key(parts)
        self.text += f"{self.draw(BLANKS)}={self.draw(BLANKS)}"
        self.value(path, depth)

    def value(self, path: Path, depth: int) -> None:
        kind = self.draw(st.sampled_from(["scalar", "list", "table"])) if depth else "scalar"
        count = self.draw(st.integers(0, 3))
        if kind == "scalar":
            self.text += self.draw(SCALARS)
        elif kind == "list":
            self.text += "["
            for index in range(count):
                self.text += ("," if index else "") + self.draw(BREAKS)
                self.note((*path, index))
                self.value((*path, index), depth - 1)
                self.text += self.draw(BREAKS)
            self.text += "]"
        else:
            self.text += "{" + self.draw(BLANKS)
            for index in range(count):
                self.text += f",{self.draw(BLANKS)}" if index else ""
                self.pair(path, depth - 1)
                self.text += self.draw(BLANKS)
            self.text += "}"

    def pairs(self, table: Path) -> None:
        for _ in range(self.draw(st.integers(0, 3))):
            self.text += self.draw(st.sampled_from(["", "\n", "# x = 1\n", "\t"]))
            self.pair(table, 3)
            self.text += self.draw(st.sampled_from(["\n", " # [x]\n", "\t\n\n"]))

    def header(self, written: list[str], path: Path) -> None:
        """Write ``[a.b]`` or ``[[a.b]]``; ``path`` has the index of the list's entry at its end in the second case."""
        is_array = isinstance(path[-1], int)
        self.note(path)
        self.text += "[[" if is_array else "["
        self.key(written)
        self.text += ("]]" if is_array else "]") + self.draw(st.sampled_from(["\n", " # ] x = 1\n"]))
        self.pairs(path)

    def document(self) -> None:
        self.pairs(())
        for _ in range(self.draw(st.integers(0, 3))):
            outer = self.name()
            if self.draw(st.booleans()):
                self.header([outer], (outer,))
                inner = self.name()
                self.header([outer, inner], (outer, inner))
                continue
            self.note((outer,))
            for index in range(self.draw(st.integers(1, 2))):
                self.header([outer], (outer, index))
                inner, innermost = self.name(), self.name()
                self.header([outer, inner], (outer, index, inner))
                self.note((outer, index, innermost))
                for inner_index in range(2):
                    self.header([outer, innermost], (outer, index, innermost, inner_index))


@st.composite
def written(draw: st.DrawFn) -> tuple[str, dict[Path, int]]:
    writer = Writer(draw)
    writer.document()
    return writer.text, writer.lines


def paths(node: Any, path: Path = ()) -> Iterator[Path]:
    entries = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for part, entry in entries:
        yield (*path, part)
        yield from paths(entry, (*path, part))


@pytest.mark.long
@settings(max_examples=300, deadline=None)
@given(written())
def test_every_key_that_tomllib_yields_is_found_on_the_line_that_defines_it(
    document: tuple[str, dict[Path, int]],
) -> None:
    text, lines = document
    found = key_lines(text)
    assert set(found) == set(paths(tomllib.loads(text)))
    assert found == lines


def test_an_implied_table_has_the_line_that_implies_it_until_its_own_header_comes() -> None:
    assert key_lines("\n[a.b]\n[c.d]\n[a]\n") == {("a",): 4, ("a", "b"): 2, ("c",): 3, ("c", "d"): 3}


@pytest.mark.parametrize(
    ("text", "clash"),
    [
        ("a = 1\nb = 2\na = 3", Clash(("a",), 3, 1)),
        ("a = [\n1]\na = [\n2\n]", Clash(("a",), 3, 1)),
        ("a = 1\n[a]", Clash(("a",), 2, 1)),
        ("[a]\n[b]\n[a]", Clash(("a",), 3, 1)),
        ("a.b = 1\n[a]", Clash(("a",), 2, 1)),
        ("[a]\nb = 1\nc = 2\nb.d = 3", Clash(("a", "b", "d"), 4, 2)),
        ("a = {\tb = 1, c = 2, b = 3}", Clash(("a", "b"), 1, 1)),
        ("[[a]]\n[[a]]\nb = 1\nb = 2", Clash(("a", 1, "b"), 4, 3)),
        ("a = [1]\n[[a]]", Clash(("a", 0), 2, 1)),
        ("[a.b]\n[a]\nb = 1", Clash(("a", "b"), 3, 1)),
    ],
)
def test_a_clash_names_both_lines(text: str, clash: Clash) -> None:
    with pytest.raises(tomllib.TOMLDecodeError, match=r"Cannot|Duplicate"):
        tomllib.loads(text)
    assert find_clash(text) == clash


@pytest.mark.parametrize(
    ("key", "parts"),
    [
        ("a", ("a",)),
        ("a.b-c._1", ("a", "b-c", "_1")),
        ("a.\"b.c\" . 'd e'", ("a", "b.c", "d e")),
        ('"\\u00e9"', ("é",)),
    ],
)
def test_a_dotted_key_is_taken_apart(key: str, parts: tuple[str, ...]) -> None:
    assert split_key(key) == parts


@pytest.mark.parametrize("key", ["", ".", "a.", "a b", "a = 1\nb", "[a]\nb", "a = {b = 1} #", "a = 1 #", "# x\na"])
def test_what_is_not_one_key_is_refused(key: str) -> None:
    with pytest.raises(tomllib.TOMLDecodeError):
        split_key(key)
