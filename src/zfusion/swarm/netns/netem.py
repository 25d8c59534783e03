"""A network of veth pairs on a bridge, whose links are `tc netem`'s, where the kernel has it.

    node's namespace   zfusion ═══ p<n>   hub's namespace: all p<n> on a bridge
                                    └─ htb: a class for each sender, with a netem for a leaf

What goes to a node is sorted by its sender as it leaves the hub. Everything is in anonymous namespaces: there is
nothing to clean up.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from zfusion.errors import InputError
from zfusion.links.rules import Rules
from zfusion.model.network import Edge
from zfusion.model.schema.links import BurstLoss, NormalDelay, UniformDelay
from zfusion.model.types import NodeId
from zfusion.swarm.netns import kernel
from zfusion.swarm.netns.addresses import Place
from zfusion.swarm.netns.wires import run, veth

IDEAL_RATE = "100gbit"
"""Of classes that only sort: htb wants a rate."""

HELD = 100_000
"""Packets that a netem may hold back: not to be its limit, where the link has none."""

IDEAL_CLASS = 1
"""Of what is no IP: ARP."""

PROBE = "qdisc add dev lo root netem delay 0ms"


def missing() -> str | None:
    """Why there can be no netem in this thread's namespace, which must be a new one; None where there can."""
    try:
        run("tc", [PROBE])
    except InputError as error:
        return str(error)
    return None


def inexpressible(rules: Rules) -> Iterator[str]:
    """What of a link netem cannot do, or would do otherwise than the scenario says.

    Its jitter reorders; its Pareto table is of one shape and has no tail; its queue holds what is under way, too.
    """
    delay = rules.delay
    if not isinstance(delay, float | UniformDelay | NormalDelay):
        yield f"a delay by {getattr(delay, 'distribution', 'mixture or trace')}"
    elif not isinstance(delay, float) and not rules.reorder:
        yield "random delays that keep the order"
    if rules.bandwidth is not None and delay != 0.0:
        yield "a bandwidth with a queue of its own before a delay"


def leaf(rules: Rules) -> str:
    """The netem for a link that it can express.

    A uniform delay is given by its middle and half width; loss by Gilbert and Elliott as `gemodel` has it, with the
    probabilities of loss, in percent: to the bad state, to the good one, in the bad one, in the good one.
    """
    words = ["netem", f"limit {HELD if rules.bandwidth is None else rules.bandwidth.queue + 1}"]
    match rules.delay:
        case UniformDelay(low=low, high=high, shift=shift):
            words.append(f"delay {_time(shift + (low + high) / 2)} {_time((high - low) / 2)}")
        case NormalDelay(mean=mean, sd=sd, shift=shift):
            words.append(f"delay {_time(shift + mean)} {_time(sd)} distribution normal")
        case float(seconds) if seconds:
            words.append(f"delay {_time(seconds)}")
    if isinstance(rules.loss, BurstLoss):
        burst = rules.loss.gilbert_elliott
        chances = (burst.to_bad, burst.to_good, burst.loss_bad, burst.loss_good)
        words.append(f"loss gemodel {' '.join(map(_percent, chances))}")
    elif rules.loss:
        words.append(f"loss random {_percent(rules.loss)}")
    if rules.bandwidth is not None:
        words.append(f"rate {round(rules.bandwidth.rate_bps)}bit")
    return " ".join(words)


def shaping(places: Sequence[Place], leaf_of: Callable[[Edge], str]) -> Iterator[str]:
    """The commands for `tc`, in the hub's namespace."""
    for to in places:
        port = _port(to)
        yield f"qdisc add dev {port} root handle 1: htb default {IDEAL_CLASS}"
        yield f"class add dev {port} parent 1: classid 1:{IDEAL_CLASS} htb rate {IDEAL_RATE} quantum 60000"
        for sender in places:
            if sender == to:
                continue
            minor = f"{IDEAL_CLASS + 1 + sender.number:x}"
            yield f"class add dev {port} parent 1: classid 1:{minor} htb rate {IDEAL_RATE} quantum 60000"
            yield f"qdisc add dev {port} parent 1:{minor} {leaf_of((sender.node, to.node))}"
            match = f"u32 match ip src {sender.address.ip}/32"
            yield f"filter add dev {port} parent 1: protocol ip prio 1 {match} flowid 1:{minor}"


def hub(places: Sequence[Place], namespaces: Mapping[NodeId, int]) -> Iterator[str]:
    """The commands for `ip`, in the hub's namespace."""
    yield "link add name bridge type bridge"
    yield "link set dev bridge up"
    for place in places:
        yield veth(_port(place), kernel.INTERFACE, namespaces[place.node])
        yield f"link set dev {_port(place)} master bridge"
        yield f"link set dev {_port(place)} up"


class NetemNetwork:
    """Namespaces joined in the kernel."""

    def __init__(
        self, places: Sequence[Place], namespaces: Mapping[NodeId, int], leaf_of: Callable[[Edge], str]
    ) -> None:
        """OSError or InputError where the kernel refuses."""
        self.hub = kernel.new_namespace()  # this thread stays in it
        run("ip", list(hub(places, namespaces)))
        for place in places:
            with kernel.inside(namespaces[place.node]):
                kernel.set_address(kernel.INTERFACE, place.address)
        run("tc", list(shaping(places, leaf_of)))
        self._stopped = threading.Event()

    def carry(self) -> None:
        """Wait until `stop`: the kernel carries the packets."""
        self._stopped.wait()

    def stop(self) -> None:
        """End `carry`, from any thread."""
        self._stopped.set()

    def report(self) -> Mapping[str, Any]:
        """Nothing that the kernel counted is told."""
        return {}


def _time(seconds: float) -> str:
    return f"{seconds * 1e6:.3f}us"


def _percent(probability: float) -> str:
    return f"{100 * probability:.9g}%"


def _port(place: Place) -> str:
    return f"p{place.number}"
