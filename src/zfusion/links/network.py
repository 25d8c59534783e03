"""The links of a scenario: what becomes of each message on its way.

    line, if it has a bandwidth   →   lost?   →   delay   →   twice?   →   order kept, unless reorder   →   arrival

What is drawn for a message is a function of the scenario's seed, the edge, the stage and the step. What depends on
other messages (the line, and that none overtakes) depends on those of the same edge alone.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence

from zfusion.links.lanes import Lane, Lanes, Measured
from zfusion.links.line import Line
from zfusion.links.measured import MeasuredLinks
from zfusion.links.packets import PacketModel
from zfusion.links.protocol import CUT, DUPLICATED, LOST, QUEUE_FULL, Edge, Link, ideal
from zfusion.links.timeline import Timeline
from zfusion.messages import encode
from zfusion.model.scenario import Scenario
from zfusion.recording.reader import Recording
from zfusion.stages import Message


class LinkNetwork:
    """The links of a scenario, `Link` of them all.

    Raises InputError for a trace that cannot be read.
    """

    def __init__(self, scenario: Scenario, measured: Measured | None = None) -> None:
        self._makes = Lanes(scenario, measured)
        self.counters: dict[Edge, Counter[str]] = defaultdict(Counter)
        """By edge, of messages: lost, cut (the link did not carry anything), queue_full, duplicated."""
        self._lanes: dict[tuple[Edge, str], Lane] = {}
        self._lines: defaultdict[Edge, Line] = defaultdict(Line)
        self._latest: dict[Edge, int] = {}
        """The last arrival of each edge that keeps the order."""
        self._keeps_order = measured is None  # what was measured has its order already
        self._sized: tuple[Message | None, int] = (None, 0)

    def __call__(self, edge: Edge, message: Message, sent_ns: int, /) -> Sequence[int]:
        """See `Link`."""
        lane = self._lane(edge, message.stage)
        fate = lane.fate(message.step)
        if fate is None:
            self.counters[edge][CUT] += 1
            return ()
        rules = lane.rules
        if rules.bandwidth is not None:
            left_ns = self._lines[edge].send(sent_ns, self._size(message), rules.bandwidth)
            if left_ns is None:
                self.counters[edge][QUEUE_FULL] += 1
                return ()
            sent_ns = left_ns
        if not fate:
            self.counters[edge][LOST] += 1
            return ()
        if len(fate) > 1:
            self.counters[edge][DUPLICATED] += 1
        if not self._keeps_order or rules.reorder:
            return [sent_ns + delay for delay in fate]
        arrivals, latest = [], self._latest.get(edge, 0)
        for delay in fate:
            latest = max(latest, sent_ns + delay)
            arrivals.append(latest)
        self._latest[edge] = latest
        return arrivals

    def injected_ns(self, edge: Edge, message: Message) -> int | None:
        """The delay that is drawn for a message (for the first copy, without waiting for the line or for others).

        None if it is lost or the link is cut.
        """
        fate = self._lane(edge, message.stage).fate(message.step)
        return fate[0] if fate else None

    def packet_model(self, edge: Edge, step_at: Callable[[int], int]) -> PacketModel:
        """The same edge for packets. `step_at` a time (ns): which step it is, for cuts and topologies; 0: none yet."""
        makes = self._makes
        cuts = bool(makes.timeline.cuts(edge)) or makes.topology.switches

        def is_cut(now_ns: int) -> bool:
            step = step_at(now_ns)
            return step > 0 and (makes.timeline.cut(edge, step) or not makes.topology.carries(edge, step))

        return PacketModel(makes.packets(edge), is_cut if cuts else None)

    def _lane(self, edge: Edge, stage: str) -> Lane:
        lane = self._lanes.get((edge, stage))
        if lane is None:
            lane = self._lanes[edge, stage] = self._makes.lane(edge, stage)
        return lane

    def _size(self, message: Message) -> int:
        """Bytes of the message on the wire; it goes to all listeners in turn."""
        if self._sized[0] is not message:
            self._sized = (message, len(encode(message)))
        return self._sized[1]


def links_of(scenario: Scenario, measured: Measured | None = None) -> Link:
    """The scenario's links; `ideal` where it has neither links nor faults of links.

    `measured`: latencies in the place of those of the recording that `[links.recorded]` may name. InputError for a
    recording or a trace that cannot be read.
    """
    spec = scenario.links
    if spec.recorded is not None and measured is None:
        with Recording.open(scenario.absolute(spec.recorded.recording)) as recording:
            measured = MeasuredLinks.of(recording)
    timeline = Timeline(scenario)
    cut = any(timeline.cuts((j, i)) for i in scenario.ids for j in scenario.network.neighbours(i) if j != i)
    return LinkNetwork(scenario, measured) if spec.model_fields_set or measured is not None or cut else ideal
