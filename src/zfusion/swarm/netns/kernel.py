"""What is asked of the Linux kernel: anonymous network namespaces, TUN devices, timers.

Nothing here has a name that outlives it. A namespace lives as long as a process is in it or a descriptor of it is open,
a device as long as its namespace or its descriptor: when the processes are gone, however they went, all of it is gone.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from ipaddress import IPv4Interface
from pathlib import Path

from zfusion.errors import InputError

CLONE_NEWUSER = 0x1000_0000
CLONE_NEWNET = 0x4000_0000

TUN = Path("/dev/net/tun")
TUNSETIFF = 0x4004_54CA
IFF_TUN, IFF_NO_PI = 0x0001, 0x1000

SIOCGIFFLAGS, SIOCSIFFLAGS, SIOCSIFADDR, SIOCSIFNETMASK = 0x8913, 0x8914, 0x8916, 0x891C
IFF_UP = 0x1

INTERFACE = "zfusion"
"""The device of every node; each is in a namespace of its own."""

NO_IPV6 = Path("/proc/sys/net/ipv6/conf/all/disable_ipv6")

TFD_NONBLOCK, TFD_TIMER_ABSTIME = os.O_NONBLOCK, 1
CLOCK_REALTIME = 0

_libc = ctypes.CDLL(None, use_errno=True)


def unshare(flags: int) -> None:
    """Put this thread into new namespaces. OSError where the kernel refuses."""
    _checked(_libc.unshare(flags))


def own_user_namespace() -> None:
    """Become, for this process, the administrator of a user namespace of its own. OSError where that is not allowed.

    Processes that enter it keep their user: it is the only one there is in it.
    """
    user, group = os.geteuid(), os.getegid()
    unshare(CLONE_NEWUSER)
    Path("/proc/self/setgroups").write_text("deny")
    Path("/proc/self/uid_map").write_text(f"0 {user} 1")
    Path("/proc/self/gid_map").write_text(f"0 {group} 1")


def new_namespace() -> int:
    """Put this thread into a new, empty network namespace; a descriptor of it. OSError where that is not allowed.

    Its loopback is up; IPv6 is off, whose neighbour discovery would be packets that nobody has sent.
    """
    unshare(CLONE_NEWNET)
    with suppress(OSError):  # a kernel without IPv6
        NO_IPV6.write_text("1")
    bring_up("lo")
    return here()


def here() -> int:
    """A descriptor of the network namespace that this thread is in."""
    return os.open("/proc/thread-self/ns/net", os.O_RDONLY)


@contextmanager
def inside(namespace: int) -> Iterator[None]:
    """For a while, have this thread in another network namespace."""
    outside = here()
    try:
        _checked(_libc.setns(namespace, CLONE_NEWNET))
        yield
    finally:
        _checked(_libc.setns(outside, CLONE_NEWNET))
        os.close(outside)


def open_tun(address: IPv4Interface) -> int:
    """A TUN device in this thread's namespace, up: the descriptor gives and takes IP packets, without waiting.

    InputError where there is no such thing as TUN, or it may not be used.
    """
    try:
        descriptor = os.open(TUN, os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(descriptor, TUNSETIFF, struct.pack("16sH22x", INTERFACE.encode(), IFF_TUN | IFF_NO_PI))
    except OSError as error:
        raise InputError(f"{TUN}, the kernel's TUN devices: {error.strerror}") from None
    set_address(INTERFACE, address)
    return descriptor


def set_address(interface: str, address: IPv4Interface) -> None:
    """Give a device of this thread's namespace an address, with the route to its network, and set it going."""
    name = interface.encode()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        for request, value in ((SIOCSIFADDR, address.ip), (SIOCSIFNETMASK, address.netmask)):
            fcntl.ioctl(control, request, struct.pack("16sHH4s16x", name, socket.AF_INET, 0, value.packed))
    bring_up(interface)


def bring_up(interface: str) -> None:
    """Set a device of this thread's namespace going."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        told = fcntl.ioctl(control, SIOCGIFFLAGS, struct.pack("16sH22x", interface.encode(), 0))
        (flags,) = struct.unpack_from("H", told, 16)
        fcntl.ioctl(control, SIOCSIFFLAGS, struct.pack("16sH22x", interface.encode(), flags | IFF_UP))


def dropped(interface: str) -> int:
    """Packets that a device of this thread's namespace could not pass on to whoever reads it."""
    for line in Path("/proc/thread-self/net/dev").read_text().splitlines():
        name, _, counts = line.partition(":")
        if name.strip() == interface:
            return int(counts.split()[11])  # of what was sent, after bytes, packets and errors
    return 0


class _Interval(ctypes.Structure):
    """struct itimerspec: first a period, which we never have, then a time."""

    _fields_ = [(name, ctypes.c_long) for name in ("period_s", "period_ns", "s", "ns")]


class Timer:
    """A descriptor that becomes readable at a time of the wall clock, to the microsecond (epoll alone: millisecond)."""

    def __init__(self) -> None:
        self.descriptor = _checked(_libc.timerfd_create(CLOCK_REALTIME, TFD_NONBLOCK | os.O_CLOEXEC))
        self.at_ns: int | None = None
        """What it is set to."""
        self._at = _Interval(0, 0, 0, 0)

    def set(self, at_ns: int) -> None:
        """Have it readable from `at_ns` on."""
        self.at_ns = at_ns
        self._at.s, self._at.ns = divmod(at_ns, 1_000_000_000)
        _checked(_libc.timerfd_settime(self.descriptor, TFD_TIMER_ABSTIME, ctypes.byref(self._at), None))

    def clear(self) -> None:
        """Have it not readable any more."""
        self.at_ns = None
        with suppress(BlockingIOError):  # set anew since it became so
            os.read(self.descriptor, 8)

    def close(self) -> None:
        """Close the descriptor."""
        os.close(self.descriptor)


def _checked(result: int) -> int:
    """What a C function returned, or its errno as OSError."""
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result
