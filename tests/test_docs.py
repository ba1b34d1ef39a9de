"""What the README and the docs say is what the programs do."""

import re
import shlex
import tomllib
from pathlib import Path
from typing import get_args

import pytest
from can import Message

from twostage_servo.api.requests import OPERATIONS
from twostage_servo.app.build import build_parts
from twostage_servo.app.service_harness import ServiceHarness
from twostage_servo.axis.messages import Feedback
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.cli.main import build_parser
from twostage_servo.config.loader import load
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.drives.dbc.settings import ProtocolSettings
from twostage_servo.faults.table import PROCESS_FAULTS, TABLE
from twostage_servo.paper.errata import errata_table
from twostage_servo.service.runtime import Runtime
from twostage_servo.service.settings import ServiceSettings
from twostage_servo.service.status_line import WORDS
from twostage_servo.timing.ticks import Ticks

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
CONTROL_SOCKET = (ROOT / "docs" / "control-socket.md").read_text(encoding="utf-8")
OPERATING = (ROOT / "docs" / "operations.md").read_text(encoding="utf-8")
SYMPTOMS = sorted((ROOT / "docs" / "symptoms").glob("*.md"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md")), *SYMPTOMS]

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
 SG_ RightSwitch : 34|1@1+ (1,0) [0|1] "" Controller
 SG_ LeftSwitch : 35|1@1+ (1,0) [0|1] "" Controller
"""


def blocks(text: str, language: str) -> list[str]:
    return [block.strip() for block in re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)]


def section(title: str) -> str:
    """A section of the page on the control socket."""
    return CONTROL_SOCKET.partition(f"\n## {title}\n")[2].partition("\n## ")[0]


def test_the_readme_opens_with_the_two_commands_on_a_line_each() -> None:
    first, second, *_ = blocks(README, "sh")
    assert first.endswith("twostage-servo demo")
    assert "python -m pytest" in second
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


def test_every_request_state_and_field_is_in_the_page_on_the_control_socket() -> None:
    assert set(re.findall(r'`\{"op": "(\w+)"', CONTROL_SOCKET)) == set(OPERATIONS)
    for state in State:
        assert f"`{state}`" in CONTROL_SOCKET
    parts = build_parts(load(None))
    snapshot = ServiceHarness(parts, Runtime(Ticks(parts.period_s))).snapshot()
    groups = {name for name, value in snapshot.items() if isinstance(value, dict)} | {"move", "trip", "realtime"}
    assert set(re.findall(r"^\| `(\w+)` \|", section("The snapshot"), re.MULTILINE)) == groups
    for name in (*snapshot["inputs"], *snapshot["authority"], "rejected_by_reason", "file_error", "escalation"):
        assert f"`{name}`" in CONTROL_SOCKET


def test_every_refusal_is_in_the_page_on_the_control_socket() -> None:
    documented = {
        code
        for row in re.findall(r"^\| (`.*?) \|", section("Refusals"), re.MULTILINE)
        for code in re.findall(r"`(\w+)`", row)
    }
    assert documented == set(RefusalCode)
    sources = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "twostage_servo").rglob("*.py"))
    raised = {RefusalCode[name] for name in re.findall(r"\bRefusalCode\.([A-Z_]+)", sources)}
    # The rest would trip an armed axis at once, and is made of the trip's code.
    assert {str(code) for code in set(RefusalCode) - raised} <= set(TripCode)


def test_every_trip_and_every_word_of_the_status_leads_the_operator_to_a_page() -> None:
    rows = re.findall(r"^\| (`.*?) \| \[.*?\]\((symptoms/[\w-]+\.md)\)", OPERATING, re.MULTILINE)
    pages = {code: page for codes, page in rows for code in re.findall(r"`(\w+)`", codes)}
    assert set(pages) == set(TripCode)
    for code, page in pages.items():
        seen_as = (ROOT / "docs" / page).read_text(encoding="utf-8").partition("\n1. ")[0]
        assert f"`{code}`" in seen_as, f"{page} does not say that it is about {code}"
    linked = set(re.findall(r"\((symptoms/[\w-]+\.md)\)", OPERATING))
    assert linked == {f"symptoms/{path.name}" for path in SYMPTOMS}
    table = OPERATING.partition("## What the status says")[2].partition("## What a trip means")[0]
    for words in {*WORDS.values(), "no bus", "the drive is silent", "error-passive", "error-warning", "late", "ending"}:
        assert f"`{words}" in table


def test_the_policies_for_a_lost_holder_are_all_explained() -> None:
    policies = get_args(ServiceSettings.model_fields["holder_lost"].annotation)
    explained = re.findall(r'^\| `"(\w+)"` \|', CONTROL_SOCKET, re.MULTILINE)
    assert explained == list(policies)


def test_the_shipped_configurations_are_listed() -> None:
    listed = set(re.findall(r"`(\w+\.toml)`", README[README.index("| shipped configuration") :]))
    assert listed == {path.name for path in (ROOT / "config").glob("*.toml")}


def test_the_faults_are_counted() -> None:
    count = len({fault.number for fault in TABLE} | set(PROCESS_FAULTS))
    (verbs,) = [action.choices for action in build_parser()._actions if action.dest == "verb"]
    assert isinstance(verbs, dict)
    texts = [README, (ROOT / "docs" / "faults.md").read_text(encoding="utf-8"), verbs["faults"].description]
    assert [re.findall(r"\b(\d+) faults\b", text) for text in texts] == [[str(count)]] * 3


def test_links_and_pictures_lead_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_the_example_of_another_drive_compiles(tmp_path: Path) -> None:
    (tmp_path / "my_drive.dbc").write_text(ANOTHER_DRIVE, encoding="utf-8")
    examples = blocks((ROOT / "docs" / "protocol.md").read_text(encoding="utf-8"), "toml")
    (example,) = (one for one in examples if "my_drive.dbc" in one)
    settings = ProtocolSettings.model_validate(tomllib.loads(example)["protocol"])
    profile = DriveProfile.compile(settings, tmp_path, "mm")
    assert profile.encode_command(-1.5, enable=True, counter=0).hex() == "6aff0104"
    assert (profile.index_id, profile.heartbeat_id) == (None, None)
    assert profile.traits.sampling == "cyclic"
    assert profile.traits.position_period == pytest.approx(2**32 * 0.001)
    status = Message(arbitration_id=257, is_extended_id=False, data=bytes.fromhex("18fcffff 05"))
    expected = Feedback(-1.0, None, True, False, None, positive_limit=True, negative_limit=False)
    assert profile.decode_feedback(status) == expected


def test_the_derivation_holds_the_list_of_errata() -> None:
    page = (ROOT / "docs" / "law.md").read_text(encoding="utf-8")
    table = page[page.index("<!-- errata: begin -->\n") : page.index("<!-- errata: end -->")]
    assert table == f"<!-- errata: begin -->\n{errata_table()}\n", "run python -m tools.write_tables"
