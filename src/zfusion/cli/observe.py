"""Commands that look at a running swarm: status, top, echo, hz, metrics."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from zfusion.cli.common import Connect, Json, err, finish, out
from zfusion.cli.quitting import Quitting

if TYPE_CHECKING:
    from zfusion.drivers.observer import Observer, Ring, Swarm
    from zfusion.drivers.rhythm import Rhythm

ENTERED = "ZFUSION_ENTERED"
"""Set where this process has entered the namespace in which the nodes can be reached."""

QUIET_S = 3.0
"""After so long without a message it is said who is there."""

Observed = Annotated[
    Path | None,
    typer.Argument(metavar="[SCENARIO]", help="Scenario file (TOML).", show_default="what runs on this machine"),
]
ObservedRun = Annotated[str | None, typer.Option("--run", help="Name of the run.", show_default="the only one")]
ZenohConfig = Annotated[Path | None, typer.Option(help="Zenoh configuration of the observer.", show_default=False)]
ScenarioOption = Annotated[
    Path | None, typer.Option("--scenario", help="Scenario file (TOML).", show_default="what runs on this machine")
]
KeyText = Annotated[
    str,
    typer.Argument(
        metavar="KEY", help="Stage (estimate), 1/estimate, node/*/estimate, truth, or a whole Zenoh key expression."
    ),
]
Once = Annotated[bool, typer.Option("--once", help="Look once, then end.")]
Interval = Annotated[float, typer.Option(help="Seconds from one look to the next.", min=0.1)]


def status(
    scenario: Observed = None,
    run: ObservedRun = None,
    connect: Connect = None,
    zenoh_config: ZenohConfig = None,
    as_json: Json = False,
) -> None:
    """How the nodes of a running swarm are doing, and who is missing."""
    from zfusion.drivers.observer import Observer
    from zfusion.report.swarm_table import seen_swarm, swarm_table

    with Observer(reachable(scenario, run, connect, zenoh_config)) as observer:
        observer.settle()
        observer.expect_somebody()
        finish(seen_swarm(observer), as_json, lambda: out.print(swarm_table(observer, out.width)))
    if observer.missing:
        raise typer.Exit(1)


def top(
    scenario: Observed = None,
    run: ObservedRun = None,
    connect: Connect = None,
    zenoh_config: ZenohConfig = None,
    interval: Interval = 1.0,
    once: Once = False,
    as_json: Json = False,
) -> None:
    """Watch a running swarm; q quits. With --json, a line for every look."""
    from zfusion.drivers.observer import Observer
    from zfusion.report.swarm_table import seen_swarm, swarm_table

    with Observer(reachable(scenario, run, connect, zenoh_config)) as observer, Quitting() as quitting:
        observer.settle()
        show: Callable[[], Any] = lambda: swarm_table(observer, out.width, out.height)  # noqa: E731
        if once:
            observer.expect_somebody()
            quitting.rest(interval)  # a rate needs two looks
        watch(observer.ask, lambda: seen_swarm(observer), show, quitting, interval, once, as_json)
    if once and observer.missing:
        raise typer.Exit(1)


def echo(
    key: KeyText,
    scenario: ScenarioOption = None,
    run: ObservedRun = None,
    connect: Connect = None,
    zenoh_config: ZenohConfig = None,
    count: Annotated[int | None, typer.Option(help="End after so many messages.", min=1, show_default=False)] = None,
    raw: Annotated[bool, typer.Option("--raw", help="The bytes as they came, in hexadecimal.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="A JSON object a message, on a line each.")] = False,
) -> None:
    """Print the messages on a key of a running swarm, decoded."""
    from zfusion.drivers.observer import Observer
    from zfusion.report.messages_shown import as_data, as_raw, as_text

    shown = 0
    with Observer(reachable(scenario, run, connect, zenoh_config)) as observer, Quitting() as quitting:
        ring = listen(observer, key)
        quiet = Quiet(observer)
        told_drops = 0
        while not quitting.look() and (count is None or shown < count):
            for letter in ring.take(0.1):
                text = json.dumps(as_data(letter)) if as_json else as_raw(letter) if raw else as_text(letter)
                sys.stdout.write(text + "\n")
                shown += 1
                if shown == count:
                    break
            sys.stdout.flush()
            quiet.look(shown)
            if ring.dropped > told_drops:
                err.print(f"{ring.dropped - told_drops} messages dropped here: they come faster than they are shown")
                told_drops = ring.dropped


def hz(
    key: KeyText,
    scenario: ScenarioOption = None,
    run: ObservedRun = None,
    connect: Connect = None,
    zenoh_config: ZenohConfig = None,
    window: Annotated[int, typer.Option(help="Messages over which is measured.", min=2)] = 10_000,
    interval: Interval = 1.0,
    once: Once = False,
    as_json: Json = False,
) -> None:
    """Measure how often messages come on a key: rate, intervals, bytes and gaps, for every key by itself."""
    from zfusion.drivers.observer import Observer
    from zfusion.report.rhythms import rhythm_table, rhythms_told

    rhythms: dict[str, Rhythm] = {}
    with Observer(reachable(scenario, run, connect, zenoh_config)) as observer, Quitting() as quitting:
        ring, quiet = listen(observer, key), Quiet(observer)

        def measure() -> None:
            """Take in what comes, for an interval that begins, the first time, with a message."""
            end = None if not rhythms else time.monotonic() + interval
            while not quitting.look() and (end is None or time.monotonic() < end):
                take_in(ring, rhythms, window)
                quiet.look(len(rhythms))
                end = time.monotonic() + interval if end is None and (rhythms or not once) else end
                if once and quiet.over:
                    return

        told: Callable[[], Mapping[str, Any]] = lambda: rhythms_told(rhythms, ring.dropped)  # noqa: E731
        watch(measure, told, lambda: rhythm_table(rhythms, ring.dropped, out.width), quitting, 0.0, once, as_json)
    if not rhythms:
        raise typer.Exit(1)


def metrics(
    scenario: Observed = None,
    run: ObservedRun = None,
    connect: Connect = None,
    zenoh_config: ZenohConfig = None,
    host: Annotated[str, typer.Option(help="Address to serve on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to serve on.", min=0, max=65535)] = 9464,
    otlp: Annotated[
        str | None, typer.Option("--otlp", help="Push to this OTLP collector (HTTP), too.", show_default=False)
    ] = None,
    interval: Annotated[float, typer.Option(help="Seconds from one question to the nodes to the next.", min=0.1)] = 5.0,
) -> None:
    """Serve a running swarm's metrics to Prometheus."""
    from zfusion.drivers.observer import Observer
    from zfusion.report.exporters import push, serve
    from zfusion.report.metrics import families

    swarm = reachable(scenario, run, connect, zenoh_config)
    with Observer(swarm) as observer, Quitting() as quitting, ExitStack() as ends:
        observer.settle()
        seen = list(families(observer))
        port, end = serve(lambda: seen, host, port)
        ends.callback(end)
        if otlp is not None:
            ends.callback(push(lambda: seen, otlp, interval))
        err.print(f"http://{host}:{port}/metrics", markup=False)
        while not quitting.rest(interval):
            observer.ask()
            seen = list(families(observer))


def take_in(ring: Ring, rhythms: dict[str, Rhythm], window: int) -> None:
    """Count what is there."""
    from zfusion.drivers.rhythm import MOST_KEYS, Rhythm

    for letter in ring.take(0.1):
        if letter.key not in rhythms and len(rhythms) < MOST_KEYS:
            rhythms[letter.key] = Rhythm(window)
        if letter.key in rhythms:
            rhythms[letter.key].add(letter.received_ns, letter.data, letter.size)


def watch(
    look: Callable[[], None],
    told: Callable[[], Mapping[str, Any]],
    table: Callable[[], Any],
    quitting: Quitting,
    interval: float,
    once: bool,
    as_json: bool,
) -> None:
    """Look again and again, and show what is seen: on a terminal in one place, elsewhere one below the other."""
    from rich.live import Live

    live = Live(console=out, auto_refresh=False, vertical_overflow="crop")
    in_place = out.is_terminal and not as_json and not once
    if in_place:
        live.start()
    try:
        while True:
            look()
            if as_json:
                sys.stdout.write(json.dumps(told()) + "\n")
                sys.stdout.flush()
            elif in_place:
                live.update(table(), refresh=True)
            else:
                out.print(table())
            if once or quitting.rest(interval):
                return
    finally:
        live.stop()


class Quiet:
    """Says who is there, where nothing comes for a while."""

    def __init__(self, observer: Observer) -> None:
        self._observer, self._since = observer, time.monotonic()
        self.over = False
        """Whether it was said."""

    def look(self, seen: int) -> None:
        """`seen`: what has come so far."""
        if seen or self.over or time.monotonic() < self._since + QUIET_S:
            return
        self.over = True
        self._observer.look()
        there = [name for name, node in self._observer.nodes.items() if node.present]
        err.print(f"nothing so far; nodes that are there: {', '.join(there) or 'none'}", markup=False)


def listen(observer: Observer, key: str) -> Ring:
    """What is published on the key that a person named."""
    from zfusion import keys

    whole = key.startswith(("/", f"{keys.ROOT}/"))
    if observer.run is None and not whole:
        observer.settle()
    return observer.listen(keys.expression(observer.run or "*", key))


def reachable(scenario: Path | None, run: str | None, connect: list[str] | None, config: Path | None) -> Swarm:
    """The swarm that is meant. Where its nodes have a network of their own this process begins anew in that."""
    from zfusion.drivers.observer import find_swarm

    swarm = find_swarm(scenario, run, connect, config)
    if swarm.enter and ENTERED not in os.environ:
        sys.stdout.flush()
        command = [*swarm.enter, sys.executable, "-m", "zfusion", *sys.argv[1:]]
        os.execvpe(command[0], command, {**os.environ, ENTERED: "1"})
    return swarm
