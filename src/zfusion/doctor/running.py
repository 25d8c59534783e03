"""Nodes of the swarm that run already: whether this machine's would be let in, and whether the clocks agree."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

from zfusion.doctor.finding import Finding, Topic
from zfusion.doctor.ground import Ground
from zfusion.drivers.clock_watch import REMEDY
from zfusion.drivers.clocks import Clock, ClockOffset, machine
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.inquiry import Answer, Answers, ask
from zfusion.drivers.meeting import check_identity
from zfusion.errors import InputError
from zfusion.model.types import NodeId, sorted_ids
from zfusion.status import Phase, Status

TOPIC = Topic("running")


def check_running(ground: Ground, reachable: Collection[str], limit_ns: int | None) -> Iterator[Finding]:
    """`reachable`: endpoints at which somebody listens; nobody else is dialled.

    Where links are TLS, it takes a Zenoh configuration that is let in (an observer's).
    """
    secured = ground.plan is not None and ground.plan.secured
    config: Path | None = ground.zenoh_config
    if not reachable or (secured and config is None):
        if reachable:
            why = "versions, scenarios and clocks of nodes that run are compared by asking them"
            yield TOPIC.warning("nobody was asked: links are TLS", why, "--zenoh-config with an observer's file")
        return
    clock = Clock()
    endpoints = Endpoints() if config is not None else Endpoints(connect=tuple(reachable))
    try:
        answers = ask(ground.run, ground.scenario.ids, endpoints, clock, config)
    except InputError as error:
        yield TOPIC.warning(str(error), "nodes that run could not be asked", "correct what it names")
        return
    yield from judge(ground, reachable, answers, clock, limit_ns)


def judge(
    ground: Ground, reachable: Collection[str], answers: Answers, clock: Clock, limit_ns: int | None
) -> Iterator[Finding]:
    """What the answers mean."""
    if answers.unread:
        why = "nodes of different versions refuse each other"
        yield TOPIC.error(f"{_nodes(answers.unread)}: answered what this version does not know", why, SAME)
    if answers.unasked:
        why = "versions, scenarios and clocks of nodes that run are compared by asking them"
        remedy = "status among security.observer_reads in the hosts file, and deploy again"
        said = f"{_nodes(answers.unasked)}: there, and may not be asked by {ground.zenoh_config}"
        yield TOPIC.warning(said, why, remedy)
    if answers.silent:
        yield TOPIC.error(f"{_nodes(answers.silent)}: there, and does not answer", STANDS, LOOK)
    hidden = list(_hidden(ground, reachable, answers))
    yield from hidden
    if not hidden and not answers.present:
        reasons = "it does not run yet, stands still, or has another name (--run)"
        yield TOPIC.ok(f"no node of run {ground.run} shows itself: {reasons}")
    for node, answer in answers.of.items():
        status = answer.status
        own = Status(node, ground.scenario.fingerprint, Phase.JOINING, 0, 0, None, {})
        if status.identity != own.identity:
            try:
                check_identity("doctor", own.identity, status)
            except InputError as error:
                yield TOPIC.error(str(error), "such nodes refuse each other", SAME)
        yield from _clock(answer, clock, limit_ns)


def _hidden(ground: Ground, reachable: Collection[str], answers: Answers) -> Iterator[Finding]:
    """Nodes at whose endpoint somebody listens, and that do not show themselves.

    Where none does, ports of this machine that are taken are told of as such already.
    """
    told = () if answers.present else ground.listens
    doors = {ground.doors[endpoint]: endpoint for endpoint in reachable if endpoint in ground.doors.keys() - told}
    hidden = {node: endpoint for node, endpoint in doors.items() if node not in answers.present}
    if not hidden:
        return
    said = f"{_nodes(hidden)} of run {ground.run}: not seen, though somebody listens at {', '.join(hidden.values())}"
    if answers.present:
        yield TOPIC.error(said, STANDS, LOOK)
        return
    why = "what is there stands still, is of a run of another name, is no node, or does not let this process in"
    yield TOPIC.warning(said, why, "--run where the run has another name; else look at the processes there")


def _nodes(nodes: Iterable[NodeId]) -> str:
    return ", ".join(f"node {node}" for node in sorted_ids(nodes))


STANDS = "it stands still, or is cut off: those that hear it wait for it, or go on without what it measures"

LOOK = "look at the process there, which may be something else, and at its log"

SAME = "install the same version of zfusion, and the same scenario, everywhere"


def _clock(answer: Answer, clock: Clock, limit_ns: int | None) -> Iterator[Finding]:
    status = answer.status
    offset = ClockOffset(same_machine=machine() is not None and status.machine == machine())
    offset.lines_apart_ns = status.line_ns - clock.line_ns
    offset.read(answer.asked_ns, status.heard_ns, status.told_ns, answer.answered_ns)
    said = f"node {status.node}: {status.phase}, step {status.step}"
    if offset.found is None:
        yield TOPIC.warning(
            f"{said}; its clock could not be read", "nobody knows whether deadlines are met", "try again"
        )
        return
    ahead, uncertainty = offset.found
    where = "behind" if ahead < 0 else "ahead"
    said = f"{said}; its clock is {_in_words(abs(ahead))} {where}, to within {_in_words(uncertainty)}"
    if limit_ns is not None and abs(ahead) - uncertainty > limit_ns:
        why = f"{limit_ns / 1e6:g} ms are allowed: nodes refuse to start, or messages are late"
        yield TOPIC.error(said, why, REMEDY.removeprefix(": "))
    else:
        yield TOPIC.ok(said)


def _in_words(duration_ns: float) -> str:
    """In milliseconds, or in seconds to the millisecond."""
    return f"{duration_ns / 1e6:.3g} ms" if duration_ns < 999.5e6 else f"{duration_ns / 1e9:.3f} s"
