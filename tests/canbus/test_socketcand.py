import asyncio
import select
import socket
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import Any

import can
import pytest

from twostage_servo.canbus import socketcand
from twostage_servo.canbus.hub import Hub
from twostage_servo.canbus.identifier import Identifier
from twostage_servo.canbus.link import BusSettings, Link, LinkError

FEEDBACK = Identifier(0x181, extended=False)
COMMAND = Identifier(0x201, extended=False)


def link_to(port: int, accepted: Identifier = FEEDBACK, **options: Any) -> Link:
    return Link(BusSettings(interface="socketcand", channel="can0", options={"port": port} | options), [accepted])


@contextmanager
def server(behaviour: Callable[[socket.socket], None], receive_buffer: int | None = None) -> Iterator[int]:
    """Serve one connection in a thread, as ``behaviour`` says; gives the port."""
    failures = []
    with socket.create_server(("127.0.0.1", 0)) as listening:
        if receive_buffer is not None:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)

        def serve() -> None:
            connection, _ = listening.accept()
            with connection:
                connection.settimeout(30)
                try:
                    behaviour(connection)
                except Exception as error:  # noqa: BLE001 - handed to the test's thread
                    failures.append(error)

        thread = threading.Thread(target=serve)
        thread.start()
        yield listening.getsockname()[1]
        thread.join(30)
    assert failures == []


def greet(connection: socket.socket, then: bytes = b"") -> None:
    connection.sendall(b"< hi >")
    for expected in (b"< open can0 >", b"< rawmode >"):
        assert connection.recv(100) == expected
        connection.sendall(b"< ok >" + (then if expected == b"< rawmode >" else b""))


def refused_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port: int = listening.getsockname()[1]
    return port


def first_frames(link: Link) -> list[can.Message]:
    while not (messages := link.drain()):
        pass
    return messages


def first_failure(link: Link) -> LinkError:
    while True:
        try:
            link.drain()
        except LinkError as error:
            return error


# With the hub ---------------------------------------------------------------------------------------------------------


@asynccontextmanager
async def two_links() -> AsyncIterator[tuple[Hub, Link, Link]]:
    hub = Hub(port=0)
    await hub.start()
    controller, drive = link_to(hub.port), link_to(hub.port, COMMAND)
    try:
        async with asyncio.timeout(30):
            await asyncio.to_thread(controller.open)
            await asyncio.to_thread(drive.open)
            yield hub, controller, drive
    finally:
        controller.close()
        drive.close()
        await hub.stop()


def test_two_links_talk_through_the_hub() -> None:
    async def scenario() -> None:
        async with two_links() as (_, controller, drive):
            for number in range(20):
                assert controller.send(controller.prepare(COMMAND, bytes((number,))))
                (command,) = await asyncio.to_thread(first_frames, drive)
                assert (command.arbitration_id, command.is_extended_id, bytes(command.data)) == (
                    *COMMAND,
                    bytes((number,)),
                )
                assert drive.send(drive.prepare(FEEDBACK, bytes(range(8))))
                (feedback,) = await asyncio.to_thread(first_frames, controller)
                assert bytes(feedback.data) == bytes(range(8))
            assert controller.counters.sent == controller.counters.received == 20
            assert controller.drain() == []

    asyncio.run(scenario())


def test_an_extended_identifier_passes_through_the_hub() -> None:
    async def scenario() -> None:
        async with two_links() as (_, controller, drive):
            assert controller.send(controller.prepare(Identifier(0x201, extended=True), b""))
            (message,) = await asyncio.to_thread(first_frames, drive)
            assert (message.is_extended_id, bytes(message.data)) == (True, b"")

    asyncio.run(scenario())


def test_a_hub_that_ends_fails_the_link_which_can_open_again() -> None:
    async def scenario() -> None:
        async with two_links() as (hub, controller, drive):
            await hub.stop()
            error = await asyncio.to_thread(first_failure, controller)
            assert f"Start what serves can0 on 127.0.0.1 port {hub.port}" in str(error)
            assert error.__cause__ is not None
            controller.close()
            drive.close()
            await hub.start()
            await asyncio.to_thread(controller.open)
            await asyncio.to_thread(drive.open)
            assert controller.send(controller.prepare(COMMAND, b"\1"))
            assert len(await asyncio.to_thread(first_frames, drive)) == 1

    asyncio.run(scenario())


# With servers that misbehave ------------------------------------------------------------------------------------------


def test_a_refused_connection_says_so_at_once() -> None:
    port = refused_port()
    with pytest.raises(LinkError, match=f"refused.* Start what serves can0 on 127.0.0.1 port {port}") as caught:
        link_to(port).open()
    assert isinstance(caught.value.__cause__, ConnectionRefusedError)


def test_a_server_that_never_greets_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socketcand, "_CONNECT_TIMEOUT_S", 0.01)
    answer = pytest.raises(LinkError, match="expected < hi >, but no answer came")
    with server(assert_closed) as port, answer:
        link_to(port).open()


def assert_closed(connection: socket.socket) -> None:
    assert connection.recv(1) == b""


@pytest.mark.parametrize(
    ("greeting", "text"),
    [(b"SSH-2.0-OpenSSH_9.2\r\n" * 20, "not the socketcand protocol"), (b"< no >", "expected < hi >"), (b"", "closed")],
)
def test_a_server_of_another_protocol_is_refused(greeting: bytes, text: str) -> None:
    with server(lambda connection: connection.sendall(greeting)) as port, pytest.raises(LinkError, match=text):
        link_to(port).open()


def test_an_unknown_option_is_refused() -> None:
    with pytest.raises(LinkError, match="hots"):
        link_to(1, hots="127.0.0.1").open()


def test_frames_right_behind_the_greeting_are_not_lost() -> None:
    def behaviour(connection: socket.socket) -> None:
        greet(connection, b"< frame 181 1.5 0102 >< frame 182 1.5  >< frame 0000")
        connection.sendall(b"0181 2.000001 >\n< frame 181 3.0 03 >")
        assert_closed(connection)

    with server(behaviour) as port:
        link = link_to(port)
        link.open()
        messages: list[can.Message] = []
        while len(messages) < 3:
            messages += link.drain()
        link.close()
    assert [(message.is_extended_id, bytes(message.data)) for message in messages] == [
        (False, b"\1\2"),
        (True, b""),
        (False, b"\3"),
    ]
    assert [message.timestamp for message in messages] == [1.5, 2.000001, 3.0]


@pytest.mark.parametrize(
    ("sent", "text"),
    [
        (b"< error 20000040 12.5 >", "went bus-off"),
        (b"< error could not open bus >", "could not open bus"),
        (b"< frame 181 1.0 010203040506070809 >", "says"),
        (b"< frame 181 1.0 0102 03 >", "says"),
        (b"< frame 181 1.0 zz >", "says"),
        (b"< frame >", "says"),
        (b"\xff\xff>", "says"),
        (b"x" * 500, "not the socketcand protocol"),
        (b"", "closed the connection"),
    ],
)
def test_what_a_server_cannot_mean_fails_the_link(sent: bytes, text: str) -> None:
    with server(lambda connection: greet(connection, sent)) as port:
        link = link_to(port)
        link.open()
        assert text in str(first_failure(link))
        link.close()


def test_a_bus_error_that_is_not_bus_off_is_counted() -> None:
    def behaviour(connection: socket.socket) -> None:
        greet(connection, b"< error 20000004 12.5 >< frame 181 1.0 01 >")
        assert_closed(connection)

    with server(behaviour) as port:
        link = link_to(port)
        link.open()
        assert len(first_frames(link)) == 1
        assert link.counters.errors == 1
        link.close()


def test_a_server_that_stops_reading_costs_whole_frames_and_never_blocks() -> None:
    may_read = threading.Event()
    received = bytearray()

    def behaviour(connection: socket.socket) -> None:
        greet(connection)
        assert may_read.wait(30)
        while data := connection.recv(65536):
            received.extend(data)

    with server(behaviour, receive_buffer=4096) as port:
        link = link_to(port)
        link.open()
        for _ in range(100_000):
            if not link.send(link.prepare(COMMAND, bytes(range(8)))):
                break
        else:
            pytest.fail("the send buffer never filled")
        assert link.send(link.prepare(COMMAND, b"\1")) is False
        counters = link.counters
        may_read.set()
        while not link.send(link.prepare(COMMAND, b"\xee")):
            pass
        link.close()
    text = b"< send 201 8 00 01 02 03 04 05 06 07 >"
    assert bytes(received) == text * (counters.sent - 1) + b"< send 201 1 ee >"


def test_a_client_may_wait_for_a_frame_and_for_its_descriptor() -> None:
    def behaviour(connection: socket.socket) -> None:
        greet(connection)
        assert connection.recv(100) == b"< send 00000201 1 07 >"
        connection.sendall(b"< frame 181 1.0 01 >")
        assert_closed(connection)

    with server(behaviour) as port, socketcand.SocketcandBus("can0", port=port) as bus:
        bus.send(can.Message(arbitration_id=0x201, is_extended_id=True, data=b"\7"))
        message = bus.recv(30)
        assert message is not None
        assert message.arbitration_id == 0x181
        assert bus.fileno() >= 0
        bus.shutdown()
        assert bus.fileno() == -1
        with pytest.raises(can.CanOperationError, match="cannot send"):
            bus.send(can.Message(arbitration_id=0x201))


def test_only_classic_data_frames_are_sent() -> None:
    def behaviour(connection: socket.socket) -> None:
        greet(connection)
        assert_closed(connection)  # nothing was sent

    refused = pytest.raises(can.CanOperationError, match="classic data frames")
    with server(behaviour) as port, socketcand.SocketcandBus("can0", port=port) as bus, refused:
        bus.send(can.Message(arbitration_id=1, is_remote_frame=True))


def test_a_frame_that_was_prepared_is_sent_only_as_itself() -> None:
    received = bytearray()

    def behaviour(connection: socket.socket) -> None:
        greet(connection)
        while data := connection.recv(100):
            received.extend(data)

    one, other, wider = (
        can.Message(arbitration_id=0x201, is_extended_id=wide, data=data)
        for wide, data in ((False, b"\1"), (False, b"\2"), (True, b"\3"))
    )
    with server(behaviour) as port, socketcand.SocketcandBus("can0", port=port) as bus:
        bus.prepare(one)
        for message in (other, one, wider):
            bus.send(message)
        bus.prepare(one)
        bus.prepare(other)
        bus.send(one)
        bus.send(other)
        with pytest.raises(can.CanOperationError, match="classic data frames"):
            bus.prepare(can.Message(arbitration_id=1, is_fd=True))
    frames = [f"< send {number} 1 {data:02x} >" for number, data in
              (("201", 2), ("201", 1), ("00000201", 3), ("201", 1), ("201", 2))]  # fmt: skip
    assert received.decode("ascii") == "".join(frames)


@pytest.mark.parametrize("prepared", [True, False])
def test_a_connection_that_is_closed_is_gone_and_not_full(prepared: bool) -> None:
    with server(greet) as port:
        bus = socketcand.SocketcandBus("can0", port=port)
        bus.shutdown()
        message = can.Message(arbitration_id=1, is_extended_id=False)
        if prepared:
            bus.prepare(message)
        with pytest.raises(can.CanOperationError, match="cannot send"):
            bus.send(message)


def test_who_drains_the_bus_asks_the_kernel_once(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = b"< frame 181 1.0 01 >< frame 181 1.0 02 >", b"< frame 181 1.0 03 >"

    class Recorded:
        def __init__(self, connection: socket.socket) -> None:
            self.asked = 0
            self._connection = connection

        def recv(self, size: int) -> bytes:
            self.asked += 1
            return self._connection.recv(size)

        def fileno(self) -> int:
            return self._connection.fileno()

    go_on = threading.Event()

    def behaviour(connection: socket.socket) -> None:
        greet(connection)
        connection.sendall(first)
        assert go_on.wait(30)
        connection.sendall(second)
        assert_closed(connection)

    def drained(bus: can.BusABC) -> list[int]:
        return [message.data[0] for message in iter(lambda: bus.recv(0), None)]

    with server(behaviour) as port, socketcand.SocketcandBus("can0", port=port) as bus:
        select.select([bus.fileno()], [], [])
        recorded = Recorded(bus._socket)
        with monkeypatch.context() as patch:
            patch.setattr(bus, "_socket", recorded)
            assert drained(bus) == [1, 2]
            assert recorded.asked == 1
            assert drained(bus) == []
            assert recorded.asked == 2
            go_on.set()
            select.select([bus.fileno()], [], [])
            assert drained(bus) == [3]
            assert drained(bus) == []
            assert recorded.asked == 4


def test_a_drain_that_ends_at_its_bound_does_not_let_the_next_one_take_the_bus_for_empty() -> None:
    go_on = threading.Event()

    def behaviour(connection: socket.socket) -> None:
        greet(connection)
        connection.sendall(b"< frame 181 1.0 01 >< frame 181 1.0 02 >")
        assert go_on.wait(30)
        connection.sendall(b"< frame 181 1.0 03 >")
        assert_closed(connection)

    with server(behaviour) as port:
        link = link_to(port)
        link.open()
        assert isinstance(link._bus, socketcand.SocketcandBus)
        select.select([link._bus.fileno()], [], [])
        assert len(link.drain(2)) == 2
        go_on.set()
        select.select([link._bus.fileno()], [], [])
        assert [message.data[0] for message in link.drain(2)] == [3]
        assert link.is_behind
        link.close()
