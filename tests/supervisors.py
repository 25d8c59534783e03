"""A service manager's end of sd_notify, for tests."""

from __future__ import annotations

import socket
from types import TracebackType
from typing import Self


class Systemd:
    """Listens at a notify socket: a path, or ``@`` and a name."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._heard: list[str] = []
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self.socket.setblocking(False)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.socket.close()

    def heard(self) -> list[str]:
        """All datagrams so far."""
        while True:
            try:
                self._heard.append(self.socket.recv(65_536).decode())
            except BlockingIOError:
                return self._heard

    def said(self, words: str) -> bool:
        """Whether a datagram had these words in it."""
        return any(words in one for one in self.heard())
