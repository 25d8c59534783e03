"""The report of one recording: what was run, what arrived, how far off the estimates were, who sent what to whom."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from math import nan, sqrt
from pathlib import Path

import numpy as np

from zfusion.drivers.meters import PARTS
from zfusion.errors import InputError
from zfusion.model.types import Array, NodeId
from zfusion.recording.info import RecordingInfo
from zfusion.recording.info import info as information
from zfusion.recording.paths import refuse_to_replace
from zfusion.recording.reader import Recording
from zfusion.report.figures import latency, over_time, space_time, topology
from zfusion.report.figures.quantities import Quantity, in_seconds, shown
from zfusion.report.figures.style import Picture
from zfusion.report.page import Page, Section, Table, save_pictures
from zfusion.report.run_facts import Errors, RunFacts, event_words

ROUNDS = 12
"""Steps that the space-time diagram shows, unless others are asked for."""

MOST_ENVELOPES = 6
"""Components of the state whose errors are drawn one by one."""

MOST_TOPICS = 20
"""Topics that a warning names."""

STATE = "units of x"


def write_report(recording: Path, output: Path, steps: range | None = None, figures: Path | None = None) -> Path:
    """Write the report of a recording to `output`; its path. Its pictures also as SVG and PNG files in `figures`.

    `steps` are those of the space-time diagram; by default a dozen in which the most went wrong. InputError for steps
    that are not on the recording and for a place that cannot be written; otherwise as `Recording.open` and
    `recorded_scenario`.
    """
    with Recording.open(recording) as opened:
        refuse_to_replace(output, opened.not_to_replace)
        facts = RunFacts(opened)
        page = _page(facts, information(opened), _there(facts, steps))
    if figures is not None:
        save_pictures(page, figures)
    return page.write(output)


def _there(facts: RunFacts, steps: range | None) -> range | None:
    """Of the steps that were asked for, those that there are; InputError if there is none."""
    if steps is None:
        return None
    found = range(max(steps.start, 1), min(steps.stop, facts.last_step + 1))
    if not found:
        expected = f"expected some of steps 1 to {facts.last_step}, which are on the recording"
        raise InputError(f"{facts.recording.path}: {expected} (are {_range(steps)})")
    return found


def _page(facts: RunFacts, told: RecordingInfo, steps: range | None) -> Page:
    sections = (
        _what_was_run(facts, told),
        _completeness(facts, told),
        _errors(facts),
        _latencies(facts),
        _network(facts),
        _messages(facts, steps),
        _events(facts),
        Section("scenario", "The scenario", texts=[("scenario.toml", facts.recording.scenario_toml)]),
    )
    world = told.facts.get("world", "live")
    summary = (
        f"{len(facts.network.ids)} nodes, method {told.method}, {facts.last_step} steps, {told.messages} messages "
        f"({world} world, seed {told.seed})."
    )
    return Page(f"Run {told.run}", summary, sections)


def _what_was_run(facts: RunFacts, told: RecordingInfo) -> Section:
    scenario = facts.scenario
    timing = scenario.timing
    pace = "free running" if timing.period_ns is None else f"{1e9 / timing.period_ns:g} steps a second"
    lives = Counter(node for node, _ in facts.lives)
    rows = [
        ("run", told.run),
        ("scenario", f"{scenario.name}, fingerprint {scenario.fingerprint[:16]}"),
        ("method", told.method),
        ("world", told.facts.get("world", "live")),
        ("seed", str(told.seed)),
        ("nodes", str(len(facts.network.ids))),
        ("steps", f"{facts.last_step} of {scenario.steps}, {pace}"),
        ("recording", f"{Path(told.path).name}, {told.size_bytes} bytes, {told.duration_ns / 1e9:.3f} s"),
        ("messages", f"{told.messages} on the recording, {told.lost} missing on it, {facts.unreadable} unreadable"),
        ("restarts", str(sum(count - 1 for count in lives.values()))),
        ("made with", ", ".join(f"{name} {version}" for name, version in told.versions.items())),
    ]
    rows += [(name, told.facts[name]) for name in ("host", "cpu", "machine", "platform") if name in told.facts]
    warnings = [f"The recording was {told.note}."] if told.note else []
    return Section("run", "What was run", tables=[Table(("", ""), rows)], warnings=warnings)


def _completeness(facts: RunFacts, told: RecordingInfo) -> Section:
    """The verdict on every edge."""
    counters = _last_words(facts)
    has_latencies = facts.has_latencies
    headings = ["edge", "stage", "messages", "used", "share", "not used", "late", "lost"]
    headings += ["latency, median", "99 %"] if has_latencies else []
    rows = []
    for ((j, i), stage), channel in facts.channels.items():
        of_edge = counters.get((j, i), {})
        row = [f"{j} → {i}", stage, str(channel.expected), str(channel.used)]
        row += [f"{channel.used / channel.expected:.2%}" if channel.expected else "–", str(len(channel.unused))]
        row += [str(of_edge[kind].get(stage, 0)) if kind in of_edge else "–" for kind in ("late", "lost")]
        row += _quantiles(list(channel.latencies_ns.values())) if has_latencies else []
        rows.append(row)
    expected = sum(channel.expected for channel in facts.channels.values())
    used = sum(channel.used for channel in facts.channels.values())
    verdict = (
        "Every message that a neighbour could use was used."
        if used == expected
        else f"{expected - used} of {expected} messages ({(expected - used) / expected:.2%}) were not used in time."
    )
    reading = (
        "A row for each edge and stage: how many messages there were for rounds that the receiver took, and how many "
        "of them it used in time, as its own messages say. Late and lost are the receiver's own counters, told when it "
        "stopped; a dash where it did not tell them."
    )
    missing = [topic for topic in told.topics if topic.gaps.lost]
    names = ", ".join(f"{topic.topic} ({topic.gaps.lost})" for topic in missing[:MOST_TOPICS])
    warnings = [f"The recorder itself missed messages: {names}."] if missing else []
    table = Table(headings, rows, frozenset(range(2, len(headings))))
    return Section("arrived", "What arrived", [verdict, reading], [table], warnings=warnings)


def _last_words(facts: RunFacts) -> dict[tuple[NodeId, NodeId], Mapping[str, Mapping[str, int]]]:
    """What receivers told of their in-edges when they stopped: late, missed, lost by stage; all lives together."""
    found: dict[tuple[NodeId, NodeId], dict[str, Counter[str]]] = {}
    for event in facts.events:
        edges = event.data.get("edges") if event.kind == "stopped" else None
        for name, counters in edges.items() if isinstance(edges, Mapping) else ():
            sender = next((j for j in facts.network.ids if str(j) == name), None)
            if sender is None or not isinstance(counters, Mapping):
                continue
            total = found.setdefault((sender, event.node), {})
            for kind, by_stage in counters.items():
                if isinstance(by_stage, Mapping):
                    whole = {stage: n for stage, n in by_stage.items() if isinstance(n, int)}
                    total.setdefault(kind, Counter()).update(whole)
    return dict(found)


def _quantiles(latencies_ns: Sequence[int]) -> list[str]:
    if not latencies_ns:
        return ["–", "–"]
    seconds = np.quantile(np.array(latencies_ns) / 1e9, [0.5, 0.99])
    return [_duration(float(s)) for s in seconds]


def _duration(seconds: float) -> str:
    quantity = in_seconds("", abs(seconds))
    return f"{shown(seconds * quantity.scale)} {quantity.unit}"


def _errors(facts: RunFacts) -> Section:
    if not facts.errors:
        why = "The truth is not on the recording, so errors are not known."
        return Section("errors", "Errors", [why])
    headings = ("node", "estimates", "rmse", "predicted", "ratio", "NEES / nx")
    rows = []
    for node, errors in facts.errors.items():
        rmse, predicted = _rmse(errors), sqrt(float(errors.predicted.mean()))
        nees = errors.nees
        ratio = f"{rmse / predicted:.3f}" if predicted else "–"
        rows.append(
            (str(node), str(len(errors.steps)), f"{rmse:.5g}", f"{predicted:.5g}", ratio,
             "–" if nees is None else f"{nees:.3f}")
        )  # fmt: skip
    table = Table(headings, rows, frozenset(range(1, 6)), f"Errors of the final estimates, in {STATE}")
    reading = (
        "Root mean squared errors over the steps, beside what the nodes themselves predicted for the messages that "
        "they used. In one run they agree only roughly: errors of neighbouring steps are correlated. NEES / nx is the "
        "mean squared error in units of the predicted one; well above 1, the nodes are too sure of themselves."
    )
    return Section("errors", "Errors", [reading], [table], [*_error_pictures(facts)])


def _error_pictures(facts: RunFacts) -> Iterator[Picture]:
    steps = np.arange(1.0, facts.last_step + 1)
    mean, best, worst = (np.sqrt(of) for of in _by_step(facts.errors.values(), len(steps), "squared"))
    predicted = np.sqrt(_by_step(facts.errors.values(), len(steps), "predicted")[0])
    course = over_time.Course("", steps, mean, best, worst, predicted)
    yield Picture(
        "error-over-time",
        "Error over time",
        "At every step, the root of the mean over the nodes of the squared error of their final estimates (line), the "
        "best and the worst node (shaded), and the root of the mean of what the nodes predicted (dashed). The line "
        "should scatter about the dashed one, with no trend away from it.",
        over_time.draw([course], f"error [{STATE}]", "root mean square over the nodes; best to worst", "predicted"),
    )
    node, errors = max(facts.errors.items(), key=lambda item: _rmse(item[1]))
    components = range(min(errors.error.shape[1], MOST_ENVELOPES))
    sd = errors.sd
    envelopes = [
        over_time.Envelope(f"node {node}, component {c + 1}", errors.steps, errors.error[:, c], sd[:, c])
        for c in components
    ]
    yield Picture(
        "error-components",
        f"Errors of node {node} by component",
        f"Node {node} has the largest errors. Each panel is one component of x̂ − x, with the band of two standard "
        "deviations that the node predicted: about 95 % of the line should be inside, if errors are Gaussian.",
        over_time.draw_envelopes(envelopes, f"error [{STATE}]"),
    )


def _by_step(errors: Iterable[Errors], last: int, what: str) -> tuple[Array, Array, Array]:
    """Mean, least and largest over the nodes of a series, at steps 1..last; NaN where there is none."""
    total, count = np.zeros(last), np.zeros(last)
    least, most = np.full(last, np.inf), np.full(last, -np.inf)
    for of_node in errors:
        at, values = of_node.steps.astype(np.int64) - 1, getattr(of_node, what)
        np.add.at(total, at, values)
        np.add.at(count, at, 1)
        np.minimum.at(least, at, values)
        np.maximum.at(most, at, values)
    there = count > 0
    mean = np.divide(total, count, out=np.full(last, nan), where=there)
    return mean, np.where(there, least, nan), np.where(there, most, nan)


def _rmse(errors: Errors) -> float:
    return sqrt(float(errors.squared.mean()))


def _latencies(facts: RunFacts) -> Section:
    budget = _budget(facts)
    pictures = [*_latency_pictures(facts)] if facts.has_latencies else [*_to_recorder(facts)]
    if budget:
        pictures.append(
            Picture(
                "latency-budget",
                "Where the time of a round goes",
                "One bar for each edge, sender → receiver, seen from the receiver: computed, its own work; behind, the "
                "sender had not sent yet; on the wire; injected by link emulation; queued at the receiver until it "
                "looked; waited, for others after this one's message was there; missing, it never came; finished, "
                "after the last stage. The parts add up to the mean of the rounds of which they were kept.",
                latency.draw_budget(budget),
            )
        )
    note = (
        "One-way latencies as the receivers measured them: from the sender's stamp to the receiver's clock. Between "
        "machines whose clocks differ they are off by that difference."
        if facts.has_latencies
        else "The nodes of this run did not tell how long messages took to them. What is shown instead, unless it is "
        "all zero, is how long they took to the recorder: from the sender's stamp to the recorder's clock."
    )
    return Section("latency", "Latencies", [note], pictures=pictures)


def _latency_pictures(facts: RunFacts) -> Iterator[Picture]:
    for stage in facts.stages:
        samples = [
            latency.Sample(
                f"{j} → {i}",
                np.array(list(channel.latencies_ns.values()), dtype=float) / 1e9,
                len(channel.unused - channel.latencies_ns.keys()),
            )
            for ((j, i), name), channel in facts.channels.items()
            if name == stage
        ]
        yield Picture(
            f"latency-{stage}",
            f"One-way latency by edge, {stage}",
            f"For each edge, sender → receiver, the fraction of the {stage} messages that took at most so long. A line "
            "that ends below 1 lost the rest. The further to the left and the steeper, the better.",
            latency.draw_distributions(samples),
        )


def _to_recorder(facts: RunFacts) -> Iterator[Picture]:
    if not any(any(taken) for taken in facts.to_recorder_ns.values()):
        return  # a simulation records everything at once
    samples = [
        latency.Sample(f"{i} → recorder", np.array(taken, dtype=float) / 1e9)
        for i, taken in facts.to_recorder_ns.items()
        if taken
    ]
    yield Picture(
        "latency-recorder",
        "Latency to the recorder, by sender",
        "For each node, the fraction of its messages that took at most so long to the recorder: log time less publish "
        "time. It tells of the senders and of the recorder, not of the links between nodes.",
        latency.draw_distributions(samples),
    )


def _budget(facts: RunFacts) -> dict[str, dict[str, float]]:
    """Edge -> part -> microseconds of a mean round, from what the nodes told when they stopped; all lives together."""
    totals: dict[str, Counter[str]] = {}
    rounds: Counter[NodeId] = Counter()
    for event in facts.events:
        told = event.data.get("budget") if event.kind == "stopped" else None
        with suppress(AttributeError, KeyError, TypeError, ValueError):  # another version's
            for sender, stages in told["edges"].items() if told else ():
                total = totals.setdefault(f"{sender} → {event.node}", Counter())
                for parts in stages.values():
                    total.update(dict(zip(PARTS, parts, strict=True)))
            rounds[event.node] += told["rounds"] if told else 0
    kept = {str(node): count for node, count in rounds.items() if count}
    return {
        edge: {part: ns / 1e3 / kept[edge.rpartition(" ")[2]] for part, ns in total.items()}
        for edge, total in totals.items()
        if edge.rpartition(" ")[2] in kept
    }


def _network(facts: RunFacts) -> Section:
    if facts.errors:
        values, what = {node: _rmse(errors) for node, errors in facts.errors.items()}, "root mean squared error"
    else:
        values = {n: sqrt(float(np.mean([np.trace(P) for P in e.P]))) for n, e in facts.estimates.items() if e.P}
        what = "predicted root mean squared error"
    graph = facts.scenario.network_spec.model_dump(by_alias=True, exclude_none=True)
    same = facts.network == facts.scenario.network
    at = topology.place(facts.network.ids, graph if same else {})
    picture = Picture(
        "network",
        "The network, with the nodes coloured by their error",
        "An arrow leads from a node to one that receives from it; a plain line leads both ways. The brighter a node, "
        f"the larger its {what} over the run; grey ones told nothing. Places are those of the graph's generator where "
        "it has any, otherwise on a circle.",
        topology.draw(facts.network, at, values, Quantity(what, STATE)),
    )
    return Section("network", "Network", pictures=[picture])


def _messages(facts: RunFacts, steps: range | None) -> Section:
    chosen = steps or facts.interesting(ROUNDS)
    if not facts.last_step:
        return Section("messages", "Who sent what to whom", ["No node sent anything."])
    flights = facts.flights(chosen)
    marks = facts.marks()
    worst = max(chosen, key=lambda step: (facts.trouble.get(step, 0), -step))
    pictures = [
        _space_time(facts, flights, marks, chosen, "space-time", f"Messages of steps {_range(chosen)}"),
        _space_time(facts, flights, marks, range(worst, worst + 1), "space-time-round", f"Messages of step {worst}"),
    ]
    why = (
        "The steps were asked for."
        if steps
        else "These are the steps in which the most went wrong: messages that were not used, restarts, faults."
        if facts.trouble
        else "Nothing went wrong in this run; these are the steps around the largest error."
    )
    how = (
        "Arrival times are those that the receivers told."
        if facts.has_latencies
        else "The nodes did not tell when messages came: a used one is drawn to the time at which the recorder had it, "
        "and of one that was not used nobody knows whether it was late or lost."
    )
    return Section("messages", "Who sent what to whom", [f"{why} {how}"], pictures=pictures[: 1 + (len(chosen) > 1)])


def _space_time(
    facts: RunFacts, flights: Sequence[space_time.Flight], marks: Sequence[space_time.Mark], steps: range,
    name: str, title: str,
) -> Picture:  # fmt: skip
    of_steps = [flight for flight in flights if flight.step in steps]
    rounds = facts.rounds(steps, of_steps)
    diagram = space_time.Diagram(facts.network.ids, facts.stages, rounds, of_steps, marks, lives=facts.presence())
    reading = (
        "Time goes to the right and every node is a line. An arrow is a message from its sending to its arrival, in "
        "the colour of its stage. Dashed red: it came when its stage was over; dashed violet: late, and taken in "
        "afterwards; dotted with a cross: it never came. Ticks on the lines are the stages' deadlines, diamonds "
        "events; thin lines from top to bottom say when a step was due."
    )
    return Picture(name, title, reading, space_time.draw(diagram))


def _events(facts: RunFacts) -> Section:
    shown_events = [event for event in facts.events if event_words(event)]
    if not shown_events:
        return Section("events", "Events", ["Nothing out of the ordinary was told by any node."])
    origin = facts.recording.start_ns
    rows = [(f"{(e.t_ns - origin) / 1e9:.3f}", str(e.node), str(e.step), e.kind, event_words(e)) for e in shown_events]
    table = Table(("time [s]", "node", "step", "event", "in words"), rows, frozenset({0, 2}))
    counts = Counter(event.kind for event in shown_events)
    told = ", ".join(f"{count} × {kind}" for kind, count in sorted(counts.items()))
    return Section("events", "Events", [f"What the nodes told, out of the ordinary: {told}."], [table])


def _range(steps: range) -> str:
    return f"{steps.start} to {steps.stop - 1}" if len(steps) != 1 else str(steps.start)
