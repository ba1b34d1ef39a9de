"""What the kernel tells about an opened SocketCAN socket and the network interface that it is bound to."""

import errno
import fcntl
import os
import socket
import struct
from typing import Final

_SIOCGIFFLAGS: Final = 0x8913  # linux/sockios.h
_SIOCGIFMTU: Final = 0x8921
_IFF_UP: Final = 0x1  # linux/if.h
_IFF_RUNNING: Final = 0x40
_SO_MEMINFO: Final = 55  # asm-generic/socket.h, since Linux 4.12
_MEMINFO: Final = struct.Struct("=9I")  # linux/sock_diag.h
_WMEM_ALLOC: Final = 2  # SK_MEMINFO_WMEM_ALLOC
_DROPS: Final = 8  # SK_MEMINFO_DROPS
_LONGEST_NAME: Final = 15  # IFNAMSIZ without its end
_CANFD_MTU: Final = 72  # linux/can.h


class NetworkInterface:
    """A network interface, asked through a socket that is bound to it.

    Parameters
    ----------
    opened
        The socket. It stays its owner's.
    name
        Name of the interface, such as ``can0``.
    fd
        Whether CAN FD frames have to fit.
    """

    __slots__ = ("_fd", "_name", "_socket")

    def __init__(self, opened: socket.socket, name: str, *, fd: bool = False) -> None:
        self._socket = opened
        self._name = name
        self._fd = fd

    def check(self) -> None:
        """See whether frames can be sent and received: the kernel lets a socket be bound all the same.

        Raises
        ------
        OSError
            ``ENODEV`` when there is no such interface, ``ENETDOWN`` when it is down, ``ENOLINK`` when it has no carrier
            as after bus-off: the kernel then discards what is sent and says nothing. ``EPROTONOSUPPORT`` when CAN FD
            frames are wanted and it takes classic ones only.
        """
        flags = self._ask(_SIOCGIFFLAGS, "H")
        if not flags & _IFF_UP:
            raise OSError(errno.ENETDOWN, os.strerror(errno.ENETDOWN))
        if not flags & _IFF_RUNNING:
            raise OSError(errno.ENOLINK, "there is no carrier, the controller is bus-off")
        if self._fd and (mtu := self._ask(_SIOCGIFMTU, "i")) < _CANFD_MTU:
            text = f"bus.fd is set, and the interface takes classic frames only (MTU {mtu}, CAN FD needs {_CANFD_MTU})"
            raise OSError(errno.EPROTONOSUPPORT, text)

    def is_sending(self) -> bool:
        """Whether a frame that was sent through the socket still waits in the interface's queue; costs 1 us.

        One that the controller has taken and cannot put on the bus is not seen: SJA1000 and its like hold one. Nor are
        those that a queue discipline has taken off the socket's account (netem does). The kernel cannot be asked to
        give any of them back.
        """
        return self._memory()[_WMEM_ALLOC] > 0

    def overflowed(self) -> int:
        """Return the number of frames that the socket has lost since it was made, because nobody read them in time."""
        return self._memory()[_DROPS]

    def _memory(self) -> tuple[int, ...]:
        return _MEMINFO.unpack(self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size))

    def _ask(self, request: int, form: str) -> int:
        name = self._name.encode()
        if not 0 < len(name) <= _LONGEST_NAME:
            raise OSError(errno.ENODEV, f"{os.strerror(errno.ENODEV)}: {self._name!r} cannot be an interface's name")
        answer = fcntl.ioctl(self._socket, request, struct.pack("16s24x", name))
        value: int = struct.unpack_from(f"={form}", answer, 16)[0]
        return value
