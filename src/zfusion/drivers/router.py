"""A Zenoh router as a process of zfusion's, for where there is no zenohd."""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path

os.environ.setdefault("ZENOH_RUNTIME", "(rx: (worker_threads: 2), tx: (worker_threads: 2))")
# Threads of their own, unlike in a node, and before Zenoh is imported: what comes in on one link goes out on another,
# and where one thread does both, a full link waits for ever for the thread that waits for it.

from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.inbox import Inbox
from zfusion.drivers.transport import never_linger, open_session

log = logging.getLogger(__name__)

LOOK_NS = 1_000_000_000
"""How often it is seen to that no link holds up the others when it is closed."""


class Router:
    """Passes on what its clients may say to each other, until `stop`."""

    def __init__(self, config_file: Path) -> None:
        """InputError where the configuration is none, or its endpoints cannot be had."""
        self._session = open_session(Endpoints(), config_file=config_file)
        self._inbox = Inbox(self._session)

    def run(self) -> None:
        """Until `stop`."""
        with self._session:
            try:
                log.info("routing")
                while self._inbox.rest(time.time_ns() + LOOK_NS):
                    never_linger()
            finally:
                self._inbox.close()

    def stop(self) -> None:
        """End. For signal handlers."""
        self._inbox.notify(None)
