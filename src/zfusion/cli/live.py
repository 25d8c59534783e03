"""Commands that run swarms: launch, node, record, simulate."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from zfusion.cli import logs
from zfusion.cli.common import (
    Connect,
    ControlFd,
    FreeRun,
    Json,
    Links,
    Listen,
    Loss,
    MethodName,
    NoRecord,
    Rate,
    Record,
    Restart,
    RunName,
    ScenarioFile,
    Seed,
    Steps,
    ToldTo,
    ZenohConfig,
    control_of,
    default_directory,
    epoch_ns,
    err,
    finish,
    given_run,
    keep_what_is_read,
    load,
    node_named,
    on_signals,
    out,
    recording_path,
    run_name,
    unused,
)
from zfusion.cli.progress import design_first
from zfusion.cli.supervision import supervised, teller
from zfusion.errors import InputError
from zfusion.model.scenario import Scenario, load_scenario
from zfusion.model.types import NodeId

if TYPE_CHECKING:
    from zfusion.swarm.child import Child
    from zfusion.swarm.launch import Launcher

    WatchedBy = Callable[[Launcher, Mapping[NodeId, Child], Child | None], None]

NetnsKind = Literal["tun", "netem"]


def launch(
    scenario: ScenarioFile,
    steps: Steps = None,
    rate: Rate = None,
    free_run: FreeRun = False,
    seed: Seed = None,
    method: MethodName = None,
    links: Links = None,
    loss: Loss = None,
    record: Record = None,
    no_record: NoRecord = False,
    restart: Restart = False,
    netns: Annotated[bool, typer.Option("--netns", help="Every node in a network namespace of its own.")] = False,
    netns_with: Annotated[
        NetnsKind | None,
        typer.Option(help="What joins them; implies --netns.", show_default="netem where it is, or tun"),
    ] = None,
    run: RunName = None,
    as_json: Json = False,
) -> None:
    """Run a swarm on this machine: a process for every node, and the recorder."""
    from zfusion.report.summary import show_summary

    loaded = load(scenario, steps, rate, free_run, seed, method, links, loss)
    name = run_name(run, loaded)
    recording = recording_path(loaded, name, record, no_record, (scenario, links))
    joined = netns_with or ("auto" if netns else None)
    summary = launched(loaded, name, recording, restart=restart, netns=joined, quiet=as_json)
    finish(summary, as_json, lambda: show_summary(out, summary))
    if summary["failures"]:
        raise typer.Exit(1)


def launched(
    scenario: Scenario,
    run: str,
    recording: Path | None,
    *,
    restart: bool = False,
    netns: str | None = None,
    quiet: bool = False,
    directory: Path | None = None,
    watch: WatchedBy | None = None,
    health_s: float = 0.0,
) -> dict[str, Any]:
    """Launch a swarm, show how it goes unless `quiet`, and summarise it.

    The logs go to `directory`, by default where the recording does. `watch` is called about ten times a second with the
    launcher and its processes, of which the nodes tell their health every `health_s`.
    """
    from zfusion.report.summary import summarize
    from zfusion.report.table import LiveTable
    from zfusion.swarm.launch import Launcher, LaunchOptions

    if directory is None:
        directory = recording.parent if recording is not None else default_directory(scenario)
    logs.about(run)
    design_first(scenario)
    with LiveTable(err, scenario, run, enabled=not quiet) as table:
        say = logs.log.warning if logs.as_json() else table.message

        def update(nodes: Mapping[NodeId, Child], recorder: Child | None) -> None:
            table.update(nodes, recorder)
            if watch is not None:
                watch(launcher, nodes, recorder)

        options = LaunchOptions(run, directory / f"{run}.logs", recording, restart, netns, health_s, update, say)
        launcher = Launcher(scenario, options)
        on_signals(launcher.interrupt)
        result = launcher.run()
    return summarize(
        run,
        scenario,
        result.reports,
        result.recorder,
        failures=result.failures,
        interrupted=result.interrupted,
        logs=str(result.logs),
        network=result.network,
    )


def simulate(
    scenario: ScenarioFile,
    steps: Steps = None,
    rate: Rate = None,
    free_run: FreeRun = False,
    seed: Seed = None,
    method: MethodName = None,
    links: Links = None,
    loss: Loss = None,
    record: Record = None,
    no_record: NoRecord = False,
    run: RunName = None,
    as_json: Json = False,
) -> None:
    """Run the same swarm in virtual time: same nodes, same recording, same summary."""
    from zfusion.drivers.metrics import RecorderReport
    from zfusion.drivers.simulated import simulate as run_simulation
    from zfusion.recording import Recording
    from zfusion.report.summary import show_summary, summarize

    loaded = load(scenario, steps, rate, free_run, seed, method, links, loss)
    name = run_name(run, loaded)
    path = recording_path(loaded, name, record, no_record, (scenario, links))
    design_first(loaded)
    with err.status(f"simulating {loaded.steps} steps of {len(loaded.ids)} nodes"):
        reports = run_simulation(loaded, run=name, output=path)
    recorded = None
    if path is not None:
        with Recording.open(path) as recording:
            recorded = RecorderReport.of(recording)
    summary = summarize(name, loaded, reports, recorded, simulated=True)
    finish(summary, as_json, lambda: show_summary(out, summary))


def node(
    scenario: ScenarioFile,
    node_id: Annotated[str, typer.Option("--id", help="Which node of the scenario this is.")],
    steps: Steps = None,
    rate: Rate = None,
    free_run: FreeRun = False,
    seed: Seed = None,
    method: MethodName = None,
    run: RunName = None,
    listen: Listen = None,
    connect: Connect = None,
    zenoh_config: ZenohConfig = None,
    epoch: Annotated[str | None, typer.Option(help="When step 0 is (RFC 3339).", show_default="agreed on")] = None,
    await_recorder: Annotated[bool, typer.Option(help="Begin only when a recorder is there.")] = False,
    forever: Annotated[bool, typer.Option("--forever", help="Take steps until stopped.")] = False,
    emulation: Annotated[
        bool, typer.Option("--emulation/--no-emulation", help="Do to messages what the scenario's links say.")
    ] = True,
    first_step: Annotated[int, typer.Option(hidden=True)] = 1,
    health: Annotated[float, typer.Option(hidden=True)] = 0.0,
    as_json: Json = False,
    control_fd: ControlFd = None,
) -> None:
    """Run one node: the same swarm on many machines, without the launcher."""
    from zfusion.drivers.endpoints import endpoints_of
    from zfusion.drivers.live import LiveNode, LiveOptions
    from zfusion.report.summary import show_node_report

    control = control_of(control_fd, deadly=True)
    with ToldTo(control), supervised(control) as supervisor:
        loaded = load(scenario, steps, rate, free_run, seed, method, zenoh_config=zenoh_config)
        own = node_named(loaded, node_id)
        options = LiveOptions(
            run=given_run(run, loaded),
            endpoints=endpoints_of(loaded, own, listen, connect),
            recorder=await_recorder,
            epoch_ns=None if epoch is None else epoch_ns(epoch),
            first_step=first_step,
            steps=None if forever else loaded.steps,
            emulate=emulation,
            health_s=0.0 if control is None else health,
        )
        tell = teller(control, supervisor, supervisor.node)

        def announce(blow: Any) -> None:
            """Tell the launcher what fells the node, with its last report: it may not live to make another one."""
            control.tell(blow=asdict(blow), report=asdict(live.report()) if blow.kind == "kill" else None)

        def tell_health(told: Any) -> None:
            """Tell the launcher, for whoever watches."""
            control.tell(health=told)

        logs.about(options.run, own)
        live = LiveNode(loaded, own, options, tell, None if control is None else announce, tell_health)
        logs.about(options.run, own, lambda: None if live.node is None else live.node.step)
        on_signals(live.stop)
        if control is not None:
            control.on_stop(live.stop, lambda told: live.keep_to(told["epoch_ns"]))
        with noted(control, loaded, options.run, options.endpoints.listen, own, own_config=zenoh_config is not None):
            report = asdict(live.run())
    if control is not None:
        control.tell(report=report)
        return
    finish(report, as_json, lambda: show_node_report(out, report))


def record(
    scenario: ScenarioFile,
    output: Annotated[Path, typer.Option("--output", "-o", help="Recording to write.", show_default=False)],
    run: RunName = None,
    connect: Connect = None,
    listen: Listen = None,
    zenoh_config: ZenohConfig = None,
    keep: Annotated[
        bool, typer.Option("--keep", help="Replace no recording: the new one's name gets a number.")
    ] = False,
    network: Annotated[NetnsKind | None, typer.Option(hidden=True)] = None,
    as_json: Json = False,
    control_fd: ControlFd = None,
) -> None:
    """Record a run: the recorder alone, for swarms on many machines. Ends with Ctrl-C, or when all nodes have left."""
    from zfusion.drivers.designs import content_of
    from zfusion.drivers.endpoints import recorder_endpoints
    from zfusion.drivers.recorder import Recorder
    from zfusion.methods import chosen
    from zfusion.recording import Keeping, RecordingWriter

    control = control_of(control_fd, deadly=False)
    with ToldTo(control), supervised(control) as supervisor:
        as_written = load_scenario(scenario)
        loaded = as_written.with_overrides(zenoh_config=zenoh_config)
        name = given_run(run, loaded)
        logs.about(name)
        method = loaded.method.name
        target = unused(output) if keep else output
        keep_what_is_read(loaded, target, (scenario, zenoh_config))
        output.parent.mkdir(parents=True, exist_ok=True)
        writer = RecordingWriter(
            target,
            scenario_toml=as_written.anchored().to_toml(),  # where keys are kept is nobody's business
            run=name,
            method=method,
            seed=loaded.seed,
            stages=chosen(loaded).stages,
            design=content_of(loaded) if loaded.method.design is not None else None,
            facts=None if network is None else {"network": network},
            keeping=Keeping.of(loaded.recording),
        )
        tell = teller(control, supervisor, supervisor.recorder)
        endpoints = recorder_endpoints(loaded, connect, listen)
        recorder = Recorder(loaded, name, endpoints, writer, until_all_gone=control is None, tell=tell)
        on_signals(recorder.stop)
        if control is not None:
            control.on_stop(recorder.stop)
        with noted(control, loaded, name, endpoints.listen, own_config=zenoh_config is not None):
            report = asdict(recorder.run())
    if control is not None:
        control.tell(report=report)
        return
    finish(report, as_json, lambda: out.print(f"{report['messages']} messages in {report['path']}"))
    if report["stopped"]:
        err.print(f"{report['stopped']}: {report['unrecorded']} messages are not on the recording", soft_wrap=True)
        raise typer.Exit(1)


def noted(
    control: Any,
    scenario: Scenario,
    run: str,
    listens: Sequence[str],
    node: NodeId | None = None,
    *,
    own_config: bool,
) -> AbstractContextManager[None]:
    """Have observers on this machine find a process that was started by hand: a node, or the recorder.

    `own_config` says that the Zenoh configuration is this process' alone, not the scenario's.
    """
    from zfusion.drivers.endpoints import listens_at
    from zfusion.drivers.registry import Entry, registered

    if control is not None:  # the launcher does it for all
        return nullcontext()
    transport = scenario.transport
    own = transport.zenoh_config if not listens else None
    own_endpoint = {str(node): listens[0]} if node is not None and listens else {}
    entry = Entry(
        run=run,
        scenario=scenario.name,
        endpoints=own_endpoint,
        elsewhere={} if own else {str(i): endpoint for i, endpoint in listens_at(scenario).items()},
        recorder=listens[0] if node is None and listens else None,
        low_latency=transport.preset == "lowlatency",
        config=str(scenario.absolute(own)) if own and not own_config else None,
        own_configs=bool(own) and own_config,
    )
    return registered(entry)


def network(
    scenario: ScenarioFile,
    run: RunName = None,  # noqa: ARG001 - for whoever looks at the processes
    kind: Annotated[NetnsKind | None, typer.Option()] = None,
    control_fd: ControlFd = None,
) -> None:
    """The network between the namespaces of a swarm's nodes; for `launch --netns`."""
    from zfusion.swarm.netns.network import Network

    control = control_of(control_fd, deadly=True)
    if control is None:
        raise InputError("the network between namespaces is started by launch --netns")
    with ToldTo(control):
        joined = Network(load_scenario(scenario), kind)
        control.on_stop(joined.stop, joined.hear)
        control.tell(status=joined.status())
        joined.carry()
        control.tell(report=joined.report())
