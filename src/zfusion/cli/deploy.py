"""Commands for swarms on many machines: deploy, router."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from zfusion.cli.common import Json, ScenarioFile, finish, load, on_signals, out
from zfusion.cli.supervision import supervised


def deploy(
    scenario: ScenarioFile,
    hosts: Annotated[Path, typer.Option(help="Hosts file (TOML).", show_default=False)],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Directory for the hosts' folders.", show_default=False)
    ],
    renew: Annotated[bool, typer.Option("--renew", help="Make all certificates anew, under the same CA.")] = False,
    as_json: Json = False,
) -> None:
    """Write a folder for every host: scenario, Zenoh configurations, certificates and keys, access control, units."""
    from zfusion.deploy.compose import write_compose
    from zfusion.deploy.folders import write, write_readmes
    from zfusion.deploy.hosts import HostsFile
    from zfusion.deploy.kubernetes import write_component
    from zfusion.deploy.plan import Plan
    from zfusion.deploy.systemd import write_units
    from zfusion.keys import check_run

    loaded = load(scenario)
    placed = HostsFile.load(hosts, loaded)
    written = write(
        Plan(loaded, placed, check_run(placed.run or scenario.stem)),
        output,
        renew=renew,
        more=(write_component,) if placed.kubernetes else (write_readmes, write_units, write_compose),
    )

    def show() -> None:
        for name in written.folders:
            out.print(f"{output / name}")
        made, kept = len(written.certificates_made), len(written.certificates_kept)
        out.print(f"run {written.run}: {made} certificates made, {kept} kept")
        for name in written.removed:
            out.print(f"{output / name}: removed: its process is not on this host any more")
        for name in written.stale:
            out.print(f"{output / name}: no host of this deployment any more; left as it is")

    finish(written.told(), as_json, show)


def router(
    zenoh_config: Annotated[Path, typer.Option(help="Zenoh configuration of the router.", show_default=False)],
) -> None:
    """Run a Zenoh router, where there is no zenohd: the same configuration works with either. Ends with Ctrl-C."""
    from zfusion.drivers.router import Router

    with supervised() as supervisor:
        running = Router(zenoh_config)
        on_signals(running.stop)
        supervisor.ready("routing")
        running.run()
