"""Nodes of the swarm that run already: whether this machine's would be let in, and whether the clocks agree."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from zfusion.doctor.finding import Finding, Topic
from zfusion.doctor.ground import Ground
from zfusion.drivers.clock_watch import REMEDY
from zfusion.drivers.clocks import Clock, ClockOffset, machine
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.inquiry import Answer, Answers, ask
from zfusion.drivers.meeting import check_identity
from zfusion.errors import InputError
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
    yield from judge(ground, answers, clock, limit_ns)


def judge(ground: Ground, answers: Answers, clock: Clock, limit_ns: int | None) -> Iterator[Finding]:
    """What the answers mean."""
    if answers.unread:
        why = "nodes of different versions refuse each other"
        yield TOPIC.error(f"{answers.unread} nodes answer in a way that this version does not know", why, SAME)
    if not answers.of:
        yield TOPIC.ok(f"no node of run {ground.run} answers: it does not run yet, or has another name (--run)")
    for node, answer in answers.of.items():
        status = answer.status
        own = Status(node, ground.scenario.fingerprint, Phase.JOINING, 0, 0, None, {})
        if status.identity != own.identity:
            try:
                check_identity("doctor", own.identity, status)
            except InputError as error:
                yield TOPIC.error(str(error), "such nodes refuse each other", SAME)
        yield from _clock(answer, clock, limit_ns)


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
    said = f"{said}; its clock is {ahead / 1e6:+.3g} ms ahead, to within {uncertainty / 1e6:.2g} ms"
    if limit_ns is not None and abs(ahead) - uncertainty > limit_ns:
        why = f"{limit_ns / 1e6:g} ms are allowed: nodes refuse to start, or messages are late"
        yield TOPIC.error(said, why, REMEDY.removeprefix(": "))
    else:
        yield TOPIC.ok(said)
