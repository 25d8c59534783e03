"""What every Zenoh session of zfusion is set to: those it opens itself, and those it writes configurations for.

Explicit endpoints, no multicast, no gossip: a process is linked to whom it is told and to nobody else.
"""

from __future__ import annotations

from typing import Any

RETRY = {"period_init_ms": 20, "period_max_ms": 250, "period_increase_factor": 1.5}
"""A neighbour that comes up soon is linked within 20 ms, one that was away for long within a quarter of a second."""

LEASE_MS = 2000
"""A peer that neither closes nor answers (stopped, cut off) counts as gone after this; one that dies, at once."""

BLOCK_US = 60_000_000
"""How long a put may wait for a full link before Zenoh closes it and drops what is queued. Links are full when a peer
is slower than we are, which is no reason to lose its messages."""

MAX_RECEIVED = 16 << 20
"""Bytes of the largest message that a session puts together: what is larger is dropped piece by piece. Sixteen times
what zfusion's messages may have: too large ones are to be counted, but not to fill the memory."""

LOOK = {"transport/unicast/open_timeout": LEASE_MS}
"""Of a session that only looks. Zenoh does not close one while it dials somebody who takes the connection and says
nothing, as a process that is stopped does; by itself it waits ten seconds for him to speak."""

LOW_LATENCY = {"transport/unicast/qos/enabled": False, "transport/unicast/lowlatency": True}
"""About a third off a round trip. Both ends must have it, messages of 48 KiB and more vanish, priorities do too."""


def base_settings(mode: str = "peer", *, low_latency: bool = False) -> dict[str, Any]:
    """Zenoh's settings by their paths (``scouting/gossip/enabled``); `mode` is peer, client or router."""
    settings = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 1,  # nothing is scouted: do not wait for it
        "listen/endpoints": [],
        "connect/endpoints": [],
        # Keep trying, in the background. A client cannot: it tries each router once, and the session is opened again.
        "connect/timeout_ms": 0 if mode == "client" else -1,
        "connect/exit_on_failure": False,
        "connect/retry": RETRY,
        "timestamping/enabled": True,
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": BLOCK_US,
        "transport/link/rx/max_message_size": MAX_RECEIVED,
        "transport/shared_memory/enabled": False,
    }
    return settings | (LOW_LATENCY if low_latency else {})
