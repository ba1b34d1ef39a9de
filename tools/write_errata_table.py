"""Write the table of errata into docs/law.md, from twostage_servo/paper/errata.py: run it after a change there."""

from pathlib import Path

from twostage_servo.paper.errata import errata_table

_PAGE = Path(__file__).parents[1] / "docs" / "law.md"
_BEGIN, _END = "<!-- errata: begin -->\n", "<!-- errata: end -->\n"


def main() -> None:
    """Replace what stands between the two marks."""
    before, _, rest = _PAGE.read_text("utf-8").partition(_BEGIN)
    _, _, after = rest.partition(_END)
    _PAGE.write_text(f"{before}{_BEGIN}{errata_table()}\n{_END}{after}", "utf-8")


if __name__ == "__main__":
    main()
