"""What the README and the docs say is what the programs do."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest

from twostage_servo.canbus.profile import DriveProfile
from twostage_servo.canbus.protocol import ProtocolSettings
from twostage_servo.cli.main import build_parser
from twostage_servo.paper.errata import errata_table

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]

ANOTHER_DRIVE = """
VERSION ""
BU_: Controller Drive
BO_ 256 TorqueCommand: 4 Controller
 SG_ TargetTorque : 0|16@1- (0.01,0) [-300|300] "%" Drive
 SG_ ControlEnable : 16|1@1+ (1,0) [0|1] "" Drive
 SG_ Mode : 24|4@1+ (1,0) [0|15] "" Drive
BO_ 257 EncoderStatus: 5 Drive
 SG_ ActualPosition : 0|32@1- (1,0) [-2147483648|2147483647] "count" Controller
 SG_ OperationEnabled : 32|1@1+ (1,0) [0|1] "" Controller
 SG_ Fault : 33|1@1+ (1,0) [0|1] "" Controller
"""


def blocks(text: str, language: str) -> list[str]:
    return [block.strip() for block in re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)]


def test_the_readme_opens_with_the_two_commands_on_a_line_each() -> None:
    first, second, *_ = blocks(README, "sh")
    assert first.endswith("twostage-servo demo")
    assert second.endswith("python -m pytest")
    assert "\n" not in first + second
    assert re.match(r"# twostage-servo\n\n```sh\n", README)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_that_is_shown_parses(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    shown = [line for block in blocks(text, "sh") for line in block.splitlines()]
    shown += re.findall(r"`(?:twostage-servo )?(demo --[^`]*)`", text)
    parser = build_parser()
    for line in shown:
        for command in line.split(" && "):
            program, *arguments = shlex.split(command)
            if program.endswith("twostage-servo"):
                parser.parse_args(arguments)
            elif program == "demo":
                parser.parse_args([program, *arguments])


def test_every_verb_is_in_the_readme_and_every_one_takes_json() -> None:
    parser = build_parser()
    (verbs,) = [action.choices for action in parser._actions if action.dest == "verb"]
    assert isinstance(verbs, dict)
    table = README[README.index("## Commands") : README.index("## Your own axis")]
    for verb, verb_parser in verbs.items():
        assert f"`{verb}`" in table
        assert "--json" in verb_parser.format_help()


def test_the_shipped_configurations_are_listed() -> None:
    listed = set(re.findall(r"`(\w+\.toml)`", README[README.index("| shipped configuration") :]))
    assert listed == {path.name for path in (ROOT / "config").glob("*.toml")}


def test_links_and_pictures_lead_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_the_example_of_another_drive_compiles(tmp_path: Path) -> None:
    (tmp_path / "my_drive.dbc").write_text(ANOTHER_DRIVE, encoding="utf-8")
    (example,) = blocks((ROOT / "docs" / "protocol.md").read_text(encoding="utf-8"), "toml")
    settings = ProtocolSettings.model_validate(tomllib.loads(example)["protocol"])
    profile = DriveProfile.compile(settings, tmp_path, "mm")
    assert profile.encode_command(-1.5, enable=True, counter=0).hex() == "6aff0104"
    assert profile.heartbeat_id is None


def test_the_derivation_holds_the_list_of_errata() -> None:
    page = (ROOT / "docs" / "law.md").read_text(encoding="utf-8")
    table = page[page.index("<!-- errata: begin -->\n") : page.index("<!-- errata: end -->")]
    assert table == f"<!-- errata: begin -->\n{errata_table()}\n", "run tools/write_errata_table.py"
