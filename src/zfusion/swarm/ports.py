"""Ports of this machine that a swarm may have: free, and nobody else's to give away."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from itertools import count

from zfusion.errors import InputError

PORTS = range(20_000, 32_000)
"""Where free ports are looked for: below those that the system gives to whoever dials, who might get one of them
between our finding it free and the node's listening on it."""

BLOCK = 200
"""Ports that one process at a time takes from."""


def free_endpoints(number: int) -> list[str]:
    """Endpoints on the loopback interface that nobody listens on now. InputError if there are not so many."""
    sockets: list[socket.socket] = []
    try:
        for _ in PORTS:
            if len(sockets) == number:
                break
            sockets.append(socket.socket())
            try:
                sockets[-1].bind(("127.0.0.1", next(_ports)))
            except OSError:
                sockets.pop().close()
        if len(sockets) < number:
            raise InputError(f"there are not {number} free ports between {PORTS.start} and {PORTS.stop}")
        return [f"tcp/127.0.0.1:{s.getsockname()[1]}" for s in sockets]
    finally:
        for s in sockets:
            s.close()


def _own_ports() -> Iterator[int]:
    """Ports, without end, of blocks that no other process takes ports from meanwhile.

    What is free for one launcher is free for another, too, until the node listens: both would give it away. So a
    block is his who holds its first port; one that somebody else holds is passed over, after a port that is not free.
    """
    blocks = [PORTS[first : first + BLOCK] for first in range(0, len(PORTS), BLOCK)]
    for n in count(os.getpid()):
        mark, *ports = blocks[n % len(blocks)]
        with socket.socket() as holder:
            try:
                holder.bind(("127.0.0.1", mark))
            except OSError:
                ports = [mark]
            yield from ports


_ports = _own_ports()
