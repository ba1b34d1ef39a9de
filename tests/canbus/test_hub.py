import asyncio
import functools
import logging
import socket
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from typing import Any, ParamSpec

import can
import pytest
from can.interfaces.socketcand import SocketCanDaemonBus

from twostage_servo.canbus.hub import Hub

Arguments = ParamSpec("Arguments")


def on_a_loop(test: Callable[Arguments, Coroutine[Any, Any, None]]) -> Callable[Arguments, None]:
    """Run an async test to its end."""

    @functools.wraps(test)
    def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> None:
        asyncio.run(test(*args, **kwargs))

    return run


Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]


@asynccontextmanager
async def running_hub() -> AsyncIterator[Hub]:
    hub = Hub(port=0)
    await hub.start()
    try:
        async with asyncio.timeout(30):
            yield hub
    finally:
        await hub.stop()


@asynccontextmanager
async def raw_client(hub: Hub, channel: str = "can0", receive_buffer: int | None = None) -> AsyncIterator[Streams]:
    """Join with bare streams, to say what no well-behaved client says."""
    connection = socket.socket()
    connection.setblocking(False)
    if receive_buffer is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
    await asyncio.get_running_loop().sock_connect(connection, (hub.host, hub.port))
    reader, writer = await asyncio.open_connection(sock=connection)
    try:
        assert await reader.readuntil(b">") == b"< hi >"
        for command in (f"< open {channel} >", "< rawmode >"):
            writer.write(command.encode())
            assert await reader.readuntil(b">") == b"< ok >"
        yield reader, writer
    finally:
        writer.transport.abort()


@asynccontextmanager
async def python_can(hub: Hub, channel: str = "can0") -> AsyncIterator[can.BusABC]:
    """python-can's own client: the independent judge of the protocol."""
    bus: can.BusABC = await asyncio.to_thread(SocketCanDaemonBus, channel, hub.host, hub.port, tcp_tune=True)
    try:
        yield bus
    finally:
        bus.shutdown()


def contents(message: can.Message | None) -> tuple[int, bool, bytes]:
    assert message is not None
    return message.arbitration_id, message.is_extended_id, bytes(message.data)


def words_without_time(frame: bytes) -> list[str]:
    words = frame.decode().split()
    assert float(words[3]) > 0
    return words[:3] + words[4:]


@pytest.mark.parametrize(
    "sent",
    [
        can.Message(arbitration_id=0x181, is_extended_id=False, data=bytes(range(8))),
        can.Message(arbitration_id=0x7, is_extended_id=False, data=b"\xff"),
        can.Message(arbitration_id=0x181, is_extended_id=True, data=b"\x01\x02"),
        can.Message(arbitration_id=0x1FFFFFFF, is_extended_id=True, data=b""),
    ],
    ids=["11 bits, 8 bytes", "small identifier", "29 bits, small number", "no data"],
)
@on_a_loop
async def test_a_frame_goes_to_all_others_unchanged_and_not_back(sent: can.Message) -> None:
    async with running_hub() as hub, python_can(hub) as one, python_can(hub) as two, python_can(hub) as three:
        await asyncio.to_thread(one.send, sent)
        for other in (two, three):
            assert contents(await asyncio.to_thread(other.recv, 10.0)) == contents(sent)
        # What two sends next is the first that one hears: its own frame, sent before, never came back.
        answer = can.Message(arbitration_id=0x55, is_extended_id=False, data=b"\x05")
        await asyncio.to_thread(two.send, answer)
        assert contents(await asyncio.to_thread(one.recv, 10.0)) == contents(answer)


@on_a_loop
async def test_frames_keep_their_order() -> None:
    async with running_hub() as hub, python_can(hub) as one, python_can(hub) as two:
        for number in range(100):
            await asyncio.to_thread(one.send, can.Message(arbitration_id=number, is_extended_id=False, data=[number]))
        received = [contents(await asyncio.to_thread(two.recv, 10.0)) for _ in range(100)]
        assert received == [(number, False, bytes((number,))) for number in range(100)]


@on_a_loop
async def test_every_channel_is_a_bus_of_its_own() -> None:
    async with (
        running_hub() as hub,
        raw_client(hub, "can0") as (_, sender),
        raw_client(hub, "can1") as (stranger, _),
        raw_client(hub, "can1") as (_, neighbour),
        raw_client(hub, "can0") as (listener, _),
    ):
        sender.write(b"< send 201 1 11 >")
        assert words_without_time(await listener.readuntil(b">")) == ["<", "frame", "201", "11", ">"]
        neighbour.write(b"< send 202 1 22 >")
        assert words_without_time(await stranger.readuntil(b">")) == ["<", "frame", "202", "22", ">"]


@on_a_loop
async def test_segments_may_be_split_and_merged_anywhere() -> None:
    async with running_hub() as hub, raw_client(hub) as (_, sender), raw_client(hub) as (listener, _):
        text = b"< send 201 2 1 a0 >< send 00000123 0  >\n< send 7FF 1 0F >"
        for index in range(len(text)):
            sender.write(text[index : index + 1])
            await sender.drain()
        sender.write(text)
        expected = [
            ["<", "frame", "201", "01A0", ">"],
            ["<", "frame", "00000123", ">"],
            ["<", "frame", "7FF", "0F", ">"],
        ]
        for frame in expected * 2:
            assert words_without_time(await listener.readuntil(b">")) == frame


@on_a_loop
async def test_a_client_gets_no_frames_before_rawmode() -> None:
    async with running_hub() as hub, raw_client(hub) as (_, sender), raw_client(hub) as (listener, _):
        reader, writer = await asyncio.open_connection(hub.host, hub.port)
        writer.write(b"< open can0 >")
        assert await reader.readexactly(12) == b"< hi >< ok >"
        sender.write(b"< send 201 1 11 >")
        await listener.readuntil(b">")  # the hub has passed the frame on
        writer.write(b"< rawmode >")
        assert await reader.readexactly(6) == b"< ok >"
        writer.transport.abort()


def test_no_frame_is_read_with_the_last_answer_and_none_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    @on_a_loop
    async def script() -> None:
        async with running_hub() as hub, raw_client(hub) as (_, sender), raw_client(hub) as (listener, _):
            for node in hub._nodes:
                node._catch_up()
            monkeypatch.setattr("twostage_servo.canbus.hub._SETTLING_S", 1e6)
            reader, writer = await asyncio.open_connection(hub.host, hub.port)
            writer.write(b"< open can0 >< rawmode >")
            assert await reader.readexactly(18) == b"< hi >< ok >< ok >"
            sender.write(b"< send 201 1 11 >< send 201 1 12 >")
            for _ in range(2):
                await listener.readuntil(b">")  # the hub has passed them on to who joined before
            (node,) = (node for node in hub._nodes if node._early is not None)
            assert len(node._early or []) == 2
            node._catch_up()
            assert [(await reader.readuntil(b">")).split()[-2] for _ in range(2)] == [b"11", b"12"]
            writer.transport.abort()

    script()


@pytest.mark.parametrize(
    "nonsense",
    [
        b"< send 201 1 >",
        b"< send 201 9 0 0 0 0 0 0 0 0 0 >",
        b"< send 201 1 100 >",
        b"< send 201 1 -1 >",
        b"< send 800 1 00 >",
        b"< send 20000000 1 00 >",
        b"< send 2011 1 00 >",
        b"< send xyz 1 00 >",
        b"< open can1 >",
        b"< sendfd 201 1 00 >",
        b"GET / HTTP/1.1\r\n\r\n<html>",
        b"\xff\xfe >",
        b">",
        b"x" * 101,
    ],
)
@on_a_loop
async def test_nonsense_is_answered_and_the_client_closed_while_the_others_go_on(
    nonsense: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    async with (
        running_hub() as hub,
        raw_client(hub) as (reader, writer),
        raw_client(hub) as (_, sender),
        raw_client(hub) as (listener, _),
    ):
        writer.write(nonsense + (b"< send 201 1 66 >" if b">" in nonsense else b""))
        answer = await reader.read()  # up to the end of the connection
        assert answer.startswith(b"< error ")
        assert answer.endswith(b" >")
        assert answer.count(b">") == 1
        assert "sent invalid data" in caplog.text
        sender.write(b"< send 202 1 77 >")
        assert words_without_time(await listener.readuntil(b">")) == ["<", "frame", "202", "77", ">"]


@on_a_loop
async def test_a_client_that_never_reads_is_dropped(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    async with running_hub() as hub, raw_client(hub) as (_, sender), raw_client(hub) as (listener, _):
        async with raw_client(hub, receive_buffer=2048) as (_, sleeper):
            sleeper.transport.pause_reading()  # type: ignore[attr-defined]
            batch = b"< send 201 8 0 1 2 3 4 5 6 7 >" * 100
            while "does not read" not in caplog.text:
                sender.write(batch)
                await sender.drain()
                for _ in range(100):
                    await listener.readuntil(b">")
        sender.write(b"< send 202 1 77 >")
        assert words_without_time(await listener.readuntil(b">")) == ["<", "frame", "202", "77", ">"]


@on_a_loop
async def test_stop_closes_every_client() -> None:
    hub = Hub(port=0)
    await hub.start()
    async with raw_client(hub) as (reader, _):
        await hub.stop()
        with pytest.raises((asyncio.IncompleteReadError, ConnectionResetError)):
            await reader.readexactly(1)
    with pytest.raises(ConnectionRefusedError):
        await asyncio.open_connection(hub.host, hub.port)
    await hub.stop()


@on_a_loop
async def test_a_hub_can_start_again_on_its_port() -> None:
    hub = Hub(port=0)
    await hub.start()
    port = hub.port
    async with raw_client(hub):
        await hub.stop()
    await hub.start()
    assert hub.port == port
    async with raw_client(hub):
        await hub.stop()


@on_a_loop
async def test_a_port_in_use_is_an_os_error() -> None:
    async with running_hub() as hub:
        second = Hub(port=hub.port)
        with pytest.raises(OSError, match="in use"):
            await second.start()
        await second.stop()


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.1", "", "::", "example.org"])  # noqa: S104 - refused
@on_a_loop
async def test_only_the_loopback_interface_is_served(host: str) -> None:
    with pytest.raises(ValueError, match="not a loopback address"):
        await Hub(host, 0).start()
