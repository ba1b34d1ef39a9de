"""Whose a control socket is. Owners are made up, so that no test needs to be root."""

import json
import os
import socket
import stat
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from twostage_servo.api import address, socket_trust
from twostage_servo.api.address import find_socket
from twostage_servo.api.socket_trust import UntrustedSocketError, check_folder, check_server, find_distrust
from twostage_servo.client.blocking import connect
from twostage_servo.client.errors import Reason, Unreachable

ME, SERVICE, EVIL, GROUP = 1000, 999, 1001, 500

Owned = Callable[..., Path]


class Peer(socket.socket):
    """A connection whose other side is run by a user of our choice."""

    server = SERVICE

    def getsockopt(self, *_: Any) -> Any:
        return struct.pack("3i", 4711, self.server, GROUP)


def peer(server: int) -> Peer:
    made = Peer(socket.AF_UNIX)
    made.server = server
    return made


@pytest.fixture
def owned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Owned:
    """Make a folder, or a socket, that belongs to a user; what is above it is root's."""
    owners: dict[str, tuple[int, int, int]] = {}
    lstat = Path.lstat

    def lie(path: Path) -> os.stat_result:
        true = lstat(path)
        user, mode, group = owners.get(str(path), (0, 0o755, 0))
        fields = list(true)
        fields[stat.ST_MODE] = stat.S_IFMT(true.st_mode) | mode
        fields[stat.ST_UID], fields[stat.ST_GID] = user, group
        return os.stat_result(fields)

    def make(name: str, user: int, mode: int = 0o755, group: int | None = None, link: Path | None = None) -> Path:
        path = tmp_path / name
        if link is not None:
            path.symlink_to(link)
        elif path.suffix == ".sock":
            os.mknod(path, stat.S_IFSOCK | 0o660)
        else:
            path.mkdir()
        owners[str(path)] = (user, mode, user if group is None else group)
        return path

    monkeypatch.setattr(Path, "lstat", lie)
    monkeypatch.setattr(os, "geteuid", lambda: ME)
    return make


def accepted(server: int, path: Path) -> bool:
    """Whether a client believes a server, of the given user, at a path."""
    with peer(server) as connection:
        try:
            check_server(connection, path)
        except UntrustedSocketError:
            return False
    return True


# The client -----------------------------------------------------------------------------------------------------------


def test_the_services_own_folder_below_one_of_root_is_believed(owned: Owned) -> None:
    """As the service manager makes it: /run/twostage-servo is the service's user's, and open to its group."""
    owned("run", 0)
    owned("run/servo", SERVICE, 0o750, GROUP)
    path = owned("run/servo/control.sock", SERVICE)
    assert accepted(SERVICE, path)
    assert not accepted(EVIL, path)
    assert not accepted(ME, path)


@pytest.mark.parametrize(("owner", "believed"), [(ME, True), (0, True), (EVIL, False), (SERVICE, False)])
def test_in_a_shared_temporary_folder_only_the_own_folder_is_believed(
    owned: Owned, owner: int, *, believed: bool
) -> None:
    owned("tmp", 0, 0o1777)
    owned("tmp/servo", owner, 0o777 if owner == EVIL else 0o700)
    path = owned("tmp/servo/control.sock", owner)
    assert accepted(owner, path) is believed


def test_root_is_no_exception_in_a_shared_temporary_folder(owned: Owned, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    owned("tmp", 0, 0o1777)
    owned("tmp/servo", EVIL)
    assert not accepted(EVIL, owned("tmp/servo/control.sock", EVIL))
    owned("run", 0)
    owned("run/user", ME)
    assert accepted(ME, owned("run/user/control.sock", ME))  # elsewhere nobody but that user can have put it there


def test_a_socket_in_the_shared_temporary_folder_itself_is_its_owners(owned: Owned) -> None:
    owned("tmp", 0, 0o1777)
    assert accepted(ME, owned("tmp/mine.sock", ME))
    assert not accepted(EVIL, owned("tmp/theirs.sock", EVIL))
    assert not accepted(EVIL, owned("tmp/swapped.sock", ME))


def test_a_socket_that_another_user_has_put_into_the_services_folder_is_not_believed(owned: Owned) -> None:
    owned("servo", SERVICE, 0o770, GROUP)  # open to members of the group for writing
    assert accepted(SERVICE, owned("servo/control.sock", SERVICE))
    assert not accepted(EVIL, owned("servo/evil.sock", EVIL))


def test_a_folder_of_root_in_which_the_service_is_not_root_is_not_believed(owned: Owned) -> None:
    owned("servo", 0, 0o770, GROUP)
    assert not accepted(SERVICE, owned("servo/control.sock", SERVICE))


def test_a_folder_of_a_third_user_on_the_way_is_not_believed(owned: Owned) -> None:
    owned("theirs", EVIL)
    owned("theirs/servo", SERVICE)
    assert not accepted(SERVICE, owned("theirs/servo/control.sock", SERVICE))


def test_a_group_that_may_write_into_a_folder_on_the_way_could_exchange_what_is_below(owned: Owned) -> None:
    owned("srv", 0, 0o775, GROUP)
    owned("srv/servo", SERVICE)
    assert not accepted(SERVICE, owned("srv/servo/control.sock", SERVICE))
    owned("srv/mine", ME)
    assert accepted(ME, owned("srv/mine/control.sock", ME))


def test_a_users_private_group_is_nobody_else(owned: Owned) -> None:
    owned("home", SERVICE, 0o775)
    owned("home/servo", SERVICE, 0o775)
    assert accepted(SERVICE, owned("home/servo/control.sock", SERVICE))


def test_a_folder_that_everybody_may_change_is_not_believed(owned: Owned) -> None:
    owned("open", 0, 0o777)
    owned("open/servo", ME)
    path = owned("open/servo/control.sock", ME)
    assert not accepted(ME, path)
    distrust = find_distrust(path)
    assert distrust is not None
    assert f"chmod o-w {path.parent.parent}" in str(distrust)


@pytest.mark.parametrize("owner", [EVIL, ME, 0])
def test_no_symbolic_link_in_a_shared_temporary_folder_is_followed(owned: Owned, owner: int) -> None:
    owned("mine", ME)
    target = owned("mine/control.sock", ME)
    owned("tmp", 0, 0o1777)
    assert accepted(ME, target)
    owned("tmp/folder", owner, 0o777, link=target.parent)
    link = owned("tmp/link", owner, 0o777, link=target)
    assert not accepted(ME, link)
    assert not accepted(ME, link.parent / "folder" / "control.sock")


def test_a_symbolic_link_elsewhere_is_followed_and_what_it_leads_to_is_looked_at(owned: Owned) -> None:
    """/var/run is one, and so is a runtime folder that the service manager preserves."""
    owned("private", 0)
    owned("private/servo", SERVICE)
    target = owned("private/servo/control.sock", SERVICE)
    owned("run", 0)
    absolute = owned("run/absolute", 0, 0o777, link=target.parent)
    relative = owned("run/relative", 0, 0o777, link=Path("../private/./servo"))
    for folder in (absolute, relative):
        assert accepted(SERVICE, folder / "control.sock")
        assert not accepted(EVIL, folder / "control.sock")
    owned("tmp", 0, 0o1777)
    owned("tmp/evil", EVIL)
    owned("tmp/evil/control.sock", EVIL)
    astray = owned("run/astray", 0, 0o777, link=target.parents[2] / "tmp" / "evil")
    assert not accepted(EVIL, astray / "control.sock")


def test_links_without_an_end_are_refused(owned: Owned, tmp_path: Path) -> None:
    owned("round", 0, 0o777, link=tmp_path / "round")
    assert not accepted(SERVICE, tmp_path / "round" / "control.sock")


def test_a_socket_that_is_made_again_just_now_is_its_folders_owners(owned: Owned) -> None:
    folder = owned("servo", SERVICE)
    assert accepted(SERVICE, folder / "control.sock")
    assert not accepted(EVIL, folder / "control.sock")
    owned("tmp", 0, 0o1777)
    assert not accepted(EVIL, folder.parent / "tmp" / "control.sock")


def test_a_folder_that_is_gone_is_no_trust(owned: Owned, tmp_path: Path) -> None:
    with peer(SERVICE) as connection, pytest.raises(FileNotFoundError):
        check_server(connection, tmp_path / "gone" / "control.sock")
    assert find_distrust(tmp_path / "gone" / "control.sock") is None


def test_in_a_user_namespace_the_hosts_folders_on_the_way_belong_to_nobody_it_knows(
    owned: Owned, monkeypatch: pytest.MonkeyPatch
) -> None:
    nobody = 65534
    owned("run", nobody)
    owned("run/servo", SERVICE)
    path = owned("run/servo/control.sock", SERVICE)
    assert not accepted(SERVICE, path)  # nobody is a user like any other, outside of one
    monkeypatch.setattr(socket_trust, "_unmapped", lambda: {nobody})
    assert accepted(SERVICE, path)
    owned("tmp", nobody, 0o1777)
    owned("tmp/servo", nobody)
    assert not accepted(nobody, owned("tmp/servo/control.sock", nobody))


def test_what_stands_for_the_users_outside_of_a_namespace(monkeypatch: pytest.MonkeyPatch) -> None:
    files = {"/proc/self/uid_map": b"         0          0 4294967295\n", "/proc/sys/kernel/overflowuid": b"65534\n"}
    monkeypatch.setattr(Path, "read_bytes", lambda path: files[str(path)])
    assert socket_trust._unmapped() == set()
    files["/proc/self/uid_map"] = b"         0       1000          1\n"
    assert socket_trust._unmapped() == {65534}

    def hidden(path: Path) -> bytes:  # as ProcSubset=pid of the service's unit hides it
        if str(path) != "/proc/self/uid_map":
            raise FileNotFoundError(path)
        return files[str(path)]

    monkeypatch.setattr(Path, "read_bytes", hidden)
    assert socket_trust._unmapped() == {65534}

    def unreadable(_: Path) -> bytes:
        raise PermissionError

    monkeypatch.setattr(Path, "read_bytes", unreadable)
    assert socket_trust._unmapped() == set()


# The service ----------------------------------------------------------------------------------------------------------


def refusal(path: Path) -> str:
    with pytest.raises(UntrustedSocketError) as refused:
        check_folder(path)
    return str(refused.value)


def test_a_service_starts_in_a_folder_of_its_own(owned: Owned) -> None:
    owned("run", 0)
    owned("run/servo", ME, 0o750, GROUP)
    check_folder(owned("run/servo/control.sock", ME).parent / "control.sock")
    owned("tmp", 0, 0o1777)
    check_folder(owned("tmp/servo", ME) / "control.sock")
    check_folder(owned("tmp/again.sock", ME))


def test_a_service_refuses_a_folder_that_is_not_its_own_and_says_what_to_do(owned: Owned) -> None:
    for user, whose in ((EVIL, f"user {EVIL}'s"), (0, "root's")):
        folder = owned(f"of{user}", user, 0o770, GROUP)
        said = refusal(folder / "control.sock")
        assert whose in said
        assert f"chown {ME} {folder}" in said
    assert "writable by everybody" in refusal(owned("open", ME, 0o777) / "control.sock")
    owned("theirs", EVIL)
    assert f"is user {EVIL}'s, who could" in refusal(owned("theirs/servo", ME) / "control.sock")


def test_a_service_refuses_what_another_user_has_made_in_a_shared_folder(owned: Owned, tmp_path: Path) -> None:
    owned("tmp", 0, 0o1777)
    assert "others may make entries" in refusal(owned("tmp/evil", EVIL, 0o777) / "control.sock")
    assert "others may make entries" in refusal(owned("tmp/evil.sock", EVIL))
    owned("mine", ME)
    assert "symbolic link" in refusal(owned("tmp/link", ME, 0o777, link=tmp_path / "mine") / "control.sock")


# Where an operator looks ----------------------------------------------------------------------------------------------


def test_what_another_user_has_put_in_the_place_of_the_own_socket_does_not_hide_the_systems(
    owned: Owned, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(address.ENVIRONMENT_VARIABLE, raising=False)
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    owned("tmp", 0, 0o1777)
    runtime = owned("tmp/runtime", EVIL)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    owned("tmp/runtime/twostage-servo", EVIL)
    own = owned("tmp/runtime/twostage-servo/control.sock", EVIL)
    owned("run", SERVICE)
    system = owned("run/control.sock", SERVICE)
    monkeypatch.setattr(address, "SYSTEM_SOCKET", system)
    assert find_socket() == system
    monkeypatch.setenv(address.ENVIRONMENT_VARIABLE, str(own))
    assert find_socket() == own  # which was named: the client says what is wrong with it
    monkeypatch.delenv(address.ENVIRONMENT_VARIABLE)
    monkeypatch.setattr(address, "SYSTEM_SOCKET", system.parent / "none.sock")
    assert find_socket() == own


def test_an_impostor_is_sent_nothing(owned: Owned, tmp_path: Path) -> None:
    owned("tmp", 0, 0o1777)
    folder = owned("tmp/servo", EVIL)
    with socket.socket(socket.AF_UNIX) as impostor:
        impostor.bind(str(folder / "control.sock"))
        impostor.listen(1)
        with pytest.raises(Unreachable, match=f"is user {EVIL}'s") as refused:
            connect(folder / "control.sock")
        heard, _ = impostor.accept()
        with heard:
            assert heard.recv(100) == b""
    assert refused.value.code is Reason.UNTRUSTED
    with pytest.raises(Unreachable, match=f"is user {EVIL}'s") as refused:
        connect(folder / "control.sock")  # whose owner has gone
    assert refused.value.code is Reason.UNTRUSTED


HIJACK = """
import json, os, shutil, socket, sys, tempfile
from pathlib import Path
import encodings.idna, encodings.ascii, encodings.utf_8
import twostage_servo.cli.main as main, twostage_servo.cli.operator_verbs
import twostage_servo.api.address as address
main.build_parser()
shared, operator, evil = Path(sys.argv[1]), 54321, 54322
folder = shared / "servo"
address.SYSTEM_SOCKET = Path("/nowhere/system.sock")
made, told = os.pipe()
if not (child := os.fork()):
    os.setresgid(evil, evil, evil)
    os.setresuid(evil, evil, evil)
    os.umask(0)
    folder.mkdir(0o777)
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(folder / "control.sock"))
    listener.listen()
    if "lock" in sys.argv:
        folder.chmod(0o700)
    os.write(told, b"!")
    connection, _ = listener.accept()
    os.write(told, b"heard:" + connection.recv(1000) + b".")
    os._exit(0)
os.read(made, 1)
if not (asking := os.fork()):
    os.environ.clear()
    os.setresgid(operator, operator, operator)
    os.setresuid(operator, operator, operator)
    if "variable" in sys.argv:
        os.environ["TWOSTAGE_SERVO_SOCKET"] = str(folder / "control.sock")
        os._exit(main.main(["stop"]))
    os._exit(main.main(["stop", "--socket", str(folder / "control.sock")]))
code = os.waitstatus_to_exitcode(os.waitpid(asking, 0)[1])
os.kill(child, 9)
os.waitpid(child, 0)
os.close(told)
print(json.dumps({"exit_code": code, "heard": os.read(made, 1000).decode()}))
"""


@pytest.mark.skipif(os.getuid() != 0, reason="only root can be two other users")
@pytest.mark.parametrize("how", ["option", "variable", "lock"])
def test_a_stop_does_not_go_to_another_users_socket(tmp_path: Path, how: str) -> None:
    with tempfile.TemporaryDirectory() as shared:  # not below a folder of the tests, which is closed to others
        Path(shared).chmod(0o1777)
        command = [sys.executable, "-c", HIJACK, shared, how]
        done = subprocess.run(command, capture_output=True, text=True, check=True)  # noqa: S603 - our own program
    seen = json.loads(done.stdout.splitlines()[-1])
    assert seen["exit_code"] == 4
    assert seen["heard"] in {"", "heard:."}
    assert "is user 54322's" in done.stderr
