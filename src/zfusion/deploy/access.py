"""Who may say what to whom, derived from the adjacency matrix; whatever is not said here is denied.

`Speech.of` is all there is to it: what one process may say to another. A process lets in what the others may say to it
and lets out what it may say to them, each known by the common name of its certificate; a router, which speaks for
others, may say to somebody what any of them may.

    node i -> node j        its messages if j hears i; its token, status and history; that it hears j, and questions
    node i -> recorder      all its messages, its token, and whether they have come
    recorder -> node i      that it reads everything, its token, and that they have come; no message
    node i -> observer      what observers are given
    observer -> node i      that it reads what it is given, and questions about it
    sensor i -> node i      readings
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from itertools import product
from typing import Any

from zfusion import keys
from zfusion.deploy.plan import Kind, Plan, Process
from zfusion.drivers.endpoints import linked
from zfusion.methods import chosen
from zfusion.model.schema import ZenohSource
from zfusion.model.types import NodeId
from zfusion.stages import ARRIVALS, ESTIMATE, EVENT, REVISED, TRUTH

PUT = "put"
READ = "declare_subscriber"
ANSWERS = "declare_queryable"
ASK = "query"
ANSWER = "reply"
TOKEN = "liveliness_token"
WATCH = "declare_liveliness_subscriber"
LOOK = "liveliness_query"
"""What Zenoh calls the messages that its rules are about. Its own sessions need no other."""

Said = Mapping[str, set[str]]
"""Kind of message to the key expressions that it may be about."""


class Speech:
    """What the processes of a plan may say to each other."""

    def __init__(self, plan: Plan) -> None:
        self._plan, self._run, self._scenario = plan, plan.run, plan.scenario
        method = chosen(plan.scenario)
        self._graph = method.network(plan.scenario.network)
        self._exchanged = [stage.name for stage in method.stages]
        self._published = [*self._exchanged, *(stage.name for stage in (ESTIMATE, EVENT, ARRIVALS, REVISED))]
        self._given = frozenset(plan.hosts.security.observer_reads)
        self._linked = {i: frozenset(linked(plan.scenario, i)) for i in plan.scenario.ids}
        self._hears = {i: frozenset(self._graph.neighbours(i)) - {i} for i in plan.scenario.ids}

    def of(self, speaker: Process, listener: Process) -> Said:
        """What one process may say to another; no keys where it may say nothing."""
        if speaker.kind == "router" or listener.kind == "router":
            return self._through_routers(speaker, listener)
        said = self._between.get((speaker.kind, listener.kind))
        return {} if said is None else said(speaker.node, listener.node)

    @cached_property
    def _between(self) -> Mapping[tuple[Kind, Kind], Callable[[Any, Any], Said]]:
        """By what they are; each is given the nodes that they are, None for those that are none."""
        return {
            ("node", "node"): self._node_to_node,
            ("node", "recorder"): lambda i, _: self._node_to_recorder(i),
            ("recorder", "node"): lambda *_: self._recorder_to_node(),
            ("node", "observer"): lambda i, _: self._node_to_observer(i),
            ("observer", "node"): lambda _, i: self._observer_to_node(i),
            ("recorder", "observer"): lambda *_: self._recorder_to_observer(),
            ("observer", "recorder"): lambda *_: self._observer_to_recorder(),
            ("sensor", "node"): lambda i, j: {PUT: self._readings(i)} if i == j else {},
            ("node", "sensor"): lambda i, j: {READ: self._readings(i)} if i == j else {},
        }

    @cached_property
    def _ends(self) -> tuple[Process, ...]:
        """All that speak for themselves, observers as one."""
        return tuple({process.name: process for process in self._plan.processes if process.kind != "router"}.values())

    def _through_routers(self, speaker: Process, listener: Process) -> Said:
        speakers = self._ends if speaker.kind == "router" else (speaker,)
        listeners = self._ends if listener.kind == "router" else (listener,)
        found: defaultdict[str, set[str]] = defaultdict(set)
        for one, other in product(speakers, listeners):
            if one.name != other.name:
                for message, about in self.of(one, other).items():
                    found[message] |= about
        return found

    def _node_to_node(self, i: NodeId, j: NodeId) -> Said:
        said: dict[str, set[str]] = {}
        own, their = {keys.status_key(self._run, i)}, {keys.status_key(self._run, j)}
        if j not in self._linked[i]:
            return said
        if i in self._hears[j]:
            said[PUT] = self._keys_of(i, self._exchanged)
            own.add(keys.history_key(self._run, i))
        if j in self._hears[i]:
            said[READ] = self._keys_of(j, self._exchanged)
            their.add(keys.history_key(self._run, j))
        tokens = {TOKEN: {keys.node_token(self._run, i)}, WATCH: {keys.node_token(self._run, "*")}}
        return said | {ANSWERS: own, ANSWER: own, ASK: their} | tokens

    def _node_to_recorder(self, i: NodeId) -> Said:
        tells_truth = self._scenario.truth_known and i == self._graph.ids[0]
        return {
            PUT: self._keys_of(i, self._published) | ({keys.truth_key(self._run)} if tells_truth else set()),
            ASK: {keys.recorder_status_key(self._run)},
            TOKEN: {keys.node_token(self._run, i)},
            WATCH: {keys.recorder_token(self._run)},
        }

    def _recorder_to_node(self) -> Said:
        answers = {keys.recorder_status_key(self._run)}
        return {
            READ: {keys.whole_run(self._run)},
            ANSWERS: answers,
            ANSWER: answers,
            TOKEN: {keys.recorder_token(self._run)},
            WATCH: {keys.node_token(self._run, "*")},
        }

    def _node_to_observer(self, i: NodeId) -> Said:
        answers = self._given_of(i, ("status", "history"))
        tells_truth = TRUTH.name in self._given and i == self._graph.ids[0]
        return {
            PUT: self._given_of(i, self._published) | ({keys.truth_key(self._run)} if tells_truth else set()),
            ANSWERS: answers,
            ANSWER: answers,
            TOKEN: {keys.node_token(self._run, i)},
        }

    def _observer_to_node(self, i: NodeId) -> Said:
        truth = {keys.truth_key(self._run)} if TRUTH.name in self._given else set()
        tokens = {keys.node_token(self._run, "*"), keys.node_token(self._run, i)}
        return {
            READ: self._given_of(i, self._published) | self._given_of("*", self._published) | truth,
            ASK: self._given_of(i, ("status", "history")) | self._given_of("*", ("status", "history")),
            WATCH: tokens,
            LOOK: tokens,
        }

    def _recorder_to_observer(self) -> Said:
        answers = {keys.recorder_status_key(self._run)} if "status" in self._given else set()
        return {ANSWERS: answers, ANSWER: answers, TOKEN: {keys.recorder_token(self._run)}}

    def _observer_to_recorder(self) -> Said:
        tokens = {keys.recorder_token(self._run)}
        asks = {keys.recorder_status_key(self._run)} if "status" in self._given else set()
        return {ASK: asks, WATCH: tokens, LOOK: tokens}

    def _keys_of(self, i: NodeId, stages: Iterable[str]) -> set[str]:
        return {keys.stage_key(self._run, i, stage) for stage in stages}

    def _given_of(self, i: NodeId, names: Iterable[str]) -> set[str]:
        return self._keys_of(i, self._given.intersection(names))

    def _readings(self, i: NodeId) -> set[str]:
        source = self._scenario.source_of(i)
        assert isinstance(source, ZenohSource)  # the plan has sensors for these only
        return {source.key}


def access_control(plan: Plan, process: Process, speech: Speech) -> dict[str, Any]:
    """Zenoh's ``access_control`` of one process: what it lets in and out, by the others' common names."""
    others = {other.name: other for other in plan.processes if other.name != process.name}
    rules, subjects, policies = [], [], []
    for name, other in others.items():
        own: list[str] = []
        for flow, said in (("ingress", speech.of(other, process)), ("egress", speech.of(process, other))):
            for about, messages in _by_keys(said).items():
                own.append(f"{name} {flow} {len(own)}")
                rules.append(
                    {
                        "id": own[-1],
                        "messages": messages,
                        "flows": [flow],
                        "permission": "allow",
                        "key_exprs": list(about),
                    }
                )
        if own:
            subjects.append({"id": name, "cert_common_names": [name]})
            policies.append({"rules": own, "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _by_keys(said: Said) -> dict[tuple[str, ...], list[str]]:
    """The messages that may be about the same keys, together."""
    found: defaultdict[tuple[str, ...], list[str]] = defaultdict(list)
    for message, about in sorted(said.items()):
        if about:
            found[tuple(sorted(about))].append(message)
    return found
