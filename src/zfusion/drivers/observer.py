"""A look at a running swarm from outside: a Zenoh session that reads, and that nobody waits for.

    find_swarm     which run, and where its nodes are dialled
    Observer       who is there, by their tokens; how they are doing, by asking; what they publish, by listening

An observer publishes nothing. What it listens to comes into a ring of bounded size in which the oldest gives way, so
that nothing waits for it at the senders; a process that stands still is, for its peers, gone when its lease is over.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import zenoh

from zfusion import keys
from zfusion.drivers import registry
from zfusion.drivers.credentials import OBSERVER_NAME
from zfusion.drivers.endpoints import Endpoints, listens_at
from zfusion.drivers.inbox import Wake
from zfusion.drivers.transport import closing, on_zenoh_thread, open_session, subscribable
from zfusion.errors import InputError, MessageError, RunError
from zfusion.messages import MAX_MESSAGE_BYTES, encode_any
from zfusion.model.scenario import load_scenario
from zfusion.status import Phase, RecorderStatus, Status

SETTLE_S = 3.0
"""How long it may take until all that are there have been found: a link is tried again after a quarter of a second."""

ANSWER_S = 1.0
"""How long a question may take; nodes answer between two messages."""

GLANCE_S = 0.05
"""How often it is looked whether more have come, while they are being found."""

PACE_S = 10.0
"""Time over which a pace is taken: slow swarms make a step a second."""

SHORTEST_PACE_S = 1.0
"""Over less than that a pace is chance: a slow node makes no step meanwhile, and one that catches up makes many."""

PACES = 64
"""Answers that are kept for that."""

RING = 8192
"""Messages that wait to be looked at: a second of a fast swarm."""

RING_BYTES = 64 << 20
"""Bytes of them."""

MOST_NODES = 4096
"""Nodes that are looked at; what claims to be yet another one is counted among the strangers."""


@dataclass(frozen=True, slots=True)
class Swarm:
    """Which run to look at, and how to get there."""

    run: str | None
    """None: whichever is there."""
    endpoints: Endpoints
    nodes: tuple[str, ...] = ()
    """Who is expected, where that is known."""
    recorder: bool = False
    """Whether a recorder is expected."""
    low_latency: bool = False
    config: Path | None = None
    enter: tuple[str, ...] = ()
    """As in `registry.Entry`."""


def find_swarm(
    scenario: Path | None = None,
    run: str | None = None,
    connect: Sequence[str] | None = None,
    config: Path | None = None,
) -> Swarm:
    """What an observer is to look at: what is given, or else what runs on this machine.

    InputError where several runs could be meant, and where there is none.
    """
    if run is not None:
        keys.check_run(run)
    if connect or config is not None:
        nodes = () if scenario is None else tuple(map(str, load_scenario(scenario).ids))
        return Swarm(run, Endpoints(connect=tuple(connect or ())), nodes, config=config)
    found = registry.entries()
    if scenario is None:
        entry = registry.the_one(found, run, "on this machine")
        if entry is None:
            named = "no swarm" if run is None else f"no run {run!r}"
            raise InputError(
                f"{named} is known on this machine: give the scenario, --connect ENDPOINT or --zenoh-config FILE"
            )
        return _noted(entry)
    loaded = load_scenario(scenario)
    entry = registry.the_one([e for e in found if e.scenario == loaded.name], run, f"of {loaded.name} on this machine")
    if entry is not None:
        return _noted(entry)
    transport = loaded.transport
    own = loaded.zenoh_config
    endpoints = Endpoints() if own else Endpoints(connect=tuple(listens_at(loaded).values()))
    low_latency = transport.preset == "lowlatency"
    return Swarm(run or loaded.name, endpoints, tuple(map(str, loaded.ids)), low_latency=low_latency, config=own)


def _noted(entry: registry.Entry) -> Swarm:
    if entry.own_configs:
        raise InputError(
            f"run {entry.run}: each of its processes has a Zenoh configuration of its own: give --zenoh-config FILE, "
            f"an observer's (zfusion deploy writes it as zenoh/observer.json5), and --run {entry.run}"
        )
    nodes = {**entry.elsewhere, **entry.endpoints}
    dialled = filter(None, [*nodes.values(), entry.recorder])
    return Swarm(
        entry.run,
        Endpoints(connect=() if entry.config else tuple(map(registry.dialled_here, dialled))),
        tuple(sorted(nodes, key=order)),
        entry.recorder is not None,
        entry.low_latency,
        None if entry.config is None else Path(entry.config),
        entry.enter,
    )


@dataclass(slots=True)
class SeenNode:
    """What is known of one node. Who is gone stays, with the last that was heard of it."""

    present: bool = False
    """Whether its token is shown."""
    seen: bool = False
    """Whether it ever was."""
    status: Status | None = None
    """The last that it told."""
    answered: bool = False
    """Whether it answered the last time it was asked."""
    problem: str | None = None
    """What was wrong with its answer."""
    _paces: deque[tuple[float, int, int]] = field(default_factory=lambda: deque(maxlen=PACES))
    """(time in s, born, steps completed)."""

    @property
    def state(self) -> str:
        """joining, running, done; silent: there, and does not answer; missing, or gone, or left: after its end."""
        if not self.present:
            if not self.seen:
                return "missing"
            return "left" if self.status is not None and self.status.phase is Phase.DONE else "gone"
        return str(self.status.phase) if self.answered and self.status is not None else "silent"

    @property
    def rate_hz(self) -> float | None:
        """Steps a second: between the answers of the last seconds, or, where they say too little, over its life."""
        if self.status is None or not self.present:
            return None
        paces = [pace for pace in self._paces if pace[1] == self.status.born]
        if paces:
            (began, _, first), (ended, _, last) = paces[0], paces[-1]
            if ended - began >= SHORTEST_PACE_S:
                return (last - first) / (ended - began)
        counts = self.status.counts
        return self.status.completed / counts.elapsed_s if counts is not None and counts.elapsed_s > 0 else None

    def answer(self, status: Status, at_s: float) -> None:
        """It told how it is doing."""
        self.status, self.answered, self.problem = status, True, None
        self._paces.append((at_s, status.born, status.completed))
        while at_s - self._paces[0][0] > PACE_S and len(self._paces) > 2:
            self._paces.popleft()


@dataclass(slots=True)
class SeenRecorder:
    """What is known of the recorder."""

    present: bool = False
    seen: bool = False
    status: RecorderStatus | None = None
    answered: bool = False

    @property
    def state(self) -> str:
        """recording, silent, missing or gone."""
        if self.present:
            return "recording" if self.answered else "silent"
        return "gone" if self.seen else "missing"


class Letter(NamedTuple):
    """A message that came."""

    key: str
    data: bytes
    """Empty where it was larger than any message is."""
    size: int
    received_ns: int


class Ring:
    """What is published on a key expression; when it is full the oldest goes, and is counted."""

    def __init__(self, capacity: int = RING) -> None:
        self.dropped = 0
        """Messages that came and were never looked at."""
        self._letters: deque[Letter] = deque()
        self._capacity, self._bytes = capacity, 0
        self._lock = threading.Lock()
        self._wake = Wake()

    def post(self, sample: Any) -> None:
        """A message came. For Zenoh's thread."""
        payload = sample.payload
        size = len(payload)
        data = payload.to_bytes() if size <= MAX_MESSAGE_BYTES else b""
        letter = Letter(str(sample.key_expr), data, size, time.time_ns())
        with self._lock:
            self._letters.append(letter)
            self._bytes += len(data)
            while len(self._letters) > self._capacity or self._bytes > RING_BYTES:
                self._bytes -= len(self._letters.popleft().data)
                self.dropped += 1
        self._wake.set()

    def take(self, seconds: float) -> Iterator[Letter]:
        """What is there; waits so long for it if nothing is."""
        if not self._letters:
            self._wake.wait(seconds)
        for _ in range(len(self._letters)):
            with self._lock:
                if not self._letters:
                    return
                letter = self._letters.popleft()
                self._bytes -= len(letter.data)
            yield letter


class Observer:
    """An open session that looks at a swarm. For one thread; use it in a `with`."""

    def __init__(self, swarm: Swarm) -> None:
        """InputError where Zenoh does not open."""
        self.run = swarm.run
        self.nodes = {node: SeenNode() for node in swarm.nodes}
        self.recorder: SeenRecorder | None = SeenRecorder() if swarm.recorder else None
        self.strangers = 0
        """Tokens and answers that were none of zfusion's."""
        self._swarm = swarm
        self._runs: set[str] = set()
        self._news: queue.SimpleQueue[tuple[bool, str]] = queue.SimpleQueue()
        self._listening: list[Any] = []
        self._session = open_session(
            swarm.endpoints, low_latency=swarm.low_latency, config_file=swarm.config, name=OBSERVER_NAME, looks=True
        )
        liveliness, hear = self._session.liveliness(), on_zenoh_thread(self._hear_token)
        run = swarm.run or "*"
        self._tokens = [
            liveliness.declare_subscriber(token, hear, history=True)
            for token in (keys.node_token(run, "*"), keys.recorder_token(run))
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Look no more."""
        with closing(self._session):
            for declared in (*self._listening, *self._tokens):
                declared.undeclare()

    def settle(self, patience_s: float = SETTLE_S) -> None:
        """Wait until all that are expected are there, or none has come for a while, and ask them.

        InputError where no run was named and several are there; RunError where none was and nobody is.
        """
        end = time.monotonic() + patience_s
        while True:
            self.look()
            if self.run is not None and self._complete():
                self.ask()
                if self._complete():  # answers name others that there should be
                    return
            if time.monotonic() >= end:
                break
            time.sleep(GLANCE_S)
        if self.run is None:
            self.expect_somebody()
        self.ask()

    def expect_somebody(self) -> None:
        """RunError where nobody is there, and nobody is known who should be."""
        if self.run is None or (not self.nodes and self.recorder is None):
            of = "" if self.run is None else f" of run {self.run}"
            raise RunError(f"nobody{of} is there: {self._where()}")

    def look(self) -> None:
        """Note who has come and gone. InputError where no run was named and there are several."""
        while not self._news.empty():
            there, key = self._news.get()
            try:
                token = keys.parse_token(key)
            except MessageError:
                self.strangers += 1
                continue
            if there:
                self._runs.add(token.run)
            if self.run in (None, token.run):
                self._note_token(token, there)
        if self.run is None and self._runs:
            if len(self._runs) > 1:
                raise InputError(f"--run: expected one of the runs that are there: {', '.join(sorted(self._runs))}")
            [self.run] = self._runs

    def ask(self) -> None:
        """Ask all that are there how they are doing, and note what they say."""
        self.look()
        if self.run is None:
            return
        for node in self.nodes.values():
            node.answered = False
        status_key = keys.status_key(self.run, "*")
        for key, data in self._get(status_key, encode_any({"counts": True})):
            self._note_status(key, data)
        recorder = self.recorder
        if recorder is not None and recorder.present:
            recorder.answered = False
            for _, data in self._get(keys.recorder_status_key(self.run), None):
                try:
                    recorder.status, recorder.answered = RecorderStatus.decode(data), True
                except MessageError:
                    self.strangers += 1

    def listen(self, key: str) -> Ring:
        """Have what is published on a key expression, as far as it is given to this session, come into a ring.

        InputError for what is no key expression, and where rules give nothing of it.
        """
        ring = Ring()
        try:
            wanted = zenoh.KeyExpr(key)
        except zenoh.ZError as error:
            raise InputError(f"KEY: expected a Zenoh key expression (is {key!r}): {error}".split(" at /")[0]) from None
        for given in self._given_of(wanted):
            self._listening.append(self._session.declare_subscriber(given, on_zenoh_thread(ring.post)))
        return ring

    def _given_of(self, wanted: zenoh.KeyExpr) -> list[zenoh.KeyExpr]:
        """What to subscribe to: Zenoh drops, without a word, a subscription to more than its rules allow."""
        rules = None if self._swarm.config is None else subscribable(self._swarm.config)
        if rules is None:
            return [wanted]
        given = widest(map(zenoh.KeyExpr, rules))
        if any(allowed.includes(wanted) for allowed in given):
            return [wanted]
        within = widest(allowed for allowed in map(zenoh.KeyExpr, rules) if wanted.includes(allowed))
        if not within:
            said = f"{self._swarm.config}: its rules (security.observer_reads) give nothing of {wanted}"
            raise InputError(f"{said}, but of {', '.join(map(str, given)) or 'nothing at all'}")
        return within

    @property
    def missing(self) -> list[str]:
        """Who is expected and not there, in words."""
        absent = [f"node {name}" for name, node in self.nodes.items() if not node.present]
        return absent + (["the recorder"] if self.recorder is not None and not self.recorder.present else [])

    def _hear_token(self, sample: Any) -> None:
        """For Zenoh's thread."""
        self._news.put((sample.kind == zenoh.SampleKind.PUT, str(sample.key_expr)))

    def _note_token(self, token: keys.Token, there: bool) -> None:
        if token.node is None:
            self.recorder = self.recorder or SeenRecorder()
            seen: SeenNode | SeenRecorder = self.recorder
        else:
            seen = self._node(token.node)
        seen.present, seen.seen = there, seen.seen or there

    def _node(self, name: str) -> SeenNode:
        if name not in self.nodes:
            if len(self.nodes) >= MOST_NODES:
                self.strangers += 1
                return SeenNode()
            self.nodes[name] = SeenNode()
            self.nodes = dict(sorted(self.nodes.items(), key=lambda item: order(item[0])))
        return self.nodes[name]

    def _complete(self) -> bool:
        """Whether all that are expected, or as many as are dialled, are there."""
        enough = 1 if self._swarm.nodes else len(self._swarm.endpoints.connect)
        return len(self.nodes) + (self.recorder is not None) >= max(1, enough) and not self.missing

    def _get(self, key: str, question: bytes | None) -> Iterable[tuple[str, bytes]]:
        """The answers to a question: on which key, and what."""
        replies = self._session.get(
            key,
            zenoh.handlers.FifoChannel(2 * MOST_NODES),
            payload=question,
            timeout=ANSWER_S,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        for reply in replies:
            if reply.ok is not None and len(reply.ok.payload) <= MAX_MESSAGE_BYTES:
                yield str(reply.ok.key_expr), reply.ok.payload.to_bytes()

    def _note_status(self, key: str, data: bytes) -> None:
        try:
            name = keys.parse(key).node or ""
            node = self._node(name)
        except MessageError:
            self.strangers += 1
            return
        try:
            status = Status.decode(data)
            if str(status.node) != name:
                raise MessageError("wrong_node", f"{status.node} answers for {name}")
        except MessageError as error:
            node.problem = str(error)
            return
        node.answer(status, time.monotonic())
        for other in map(str, status.ready):
            self._node(other)

    def _where(self) -> str:
        if self._swarm.config is not None:
            return str(self._swarm.config)
        return ", ".join(self._swarm.endpoints.connect)


def widest(expressions: Iterable[zenoh.KeyExpr]) -> list[zenoh.KeyExpr]:
    """Those that no other one of them includes."""
    found = list(expressions)
    return [one for one in found if not any(other != one and other.includes(one) for other in found)]


def order(name: str) -> tuple[bool, int, str]:
    """Sorts ids that are text as the nodes' own are sorted: numbers by size."""
    return (not name.isdecimal(), int(name) if name.isdecimal() else 0, name)
