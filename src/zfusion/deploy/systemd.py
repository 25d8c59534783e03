"""Service units for a host: its nodes, its recorder and its router under systemd, with as few rights as they need.

A unit is started as ``plan`` says, in the host's folder, which is copied to ``PLACE/RUN``. Of the folder's keys each
process sees its own only; nothing can be written but the recordings.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from shlex import join

from zfusion.deploy.plan import RECORDINGS, Plan, Process
from zfusion.deploy.zenoh_file import AUTHORITY

DIRECTORY = "systemd"
"""In a host's folder."""

PLACE = "/var/lib/zfusion"
"""Where hosts have their folders."""

PROGRAM = "/opt/zfusion/bin/zfusion"
"""A virtual environment of its own."""

USER = "zfusion"

SERVED = ("router", "recorder", "node")
"""What systemd keeps running; observers are started by whoever looks, sensors are the user's own."""

MEMORY = {"node": "1G", "recorder": "2G", "router": "1G"}

SERVICE = """\
# {about}. Written by zfusion deploy.
[Unit]
Description=zfusion {run}: {what}
After=network-online.target time-sync.target
Wants=network-online.target
PartOf={target}
StartLimitIntervalSec=10min
StartLimitBurst=5

[Service]
ExecStart={command}
WorkingDirectory={place}
User={user}
Group={user}
Environment=OPENBLAS_NUM_THREADS=1

# Ready when it has joined, however long the others take to come.
Type=notify
NotifyAccess=main
TimeoutStartSec=infinity
TimeoutStopSec=60
# Longer than a put may wait for a neighbour whose link is full: 60 s.
WatchdogSec=150
Restart=on-failure
RestartSec=2
# 2: what is wrong with its input no restart puts right
RestartPreventExitStatus=2

# Of the keys its own.
{files}
UMask=0077
MemoryMax={memory}
MemorySwapMax=0
TasksMax=128
LimitNOFILE=16384
LimitCORE=0

NoNewPrivileges=yes
CapabilityBoundingSet=
AmbientCapabilities=
ProtectSystem=strict
ProtectHome=yes
ProtectProc=invisible
ProtectClock=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
PrivateDevices=yes
DevicePolicy=closed
PrivateTmp=yes
PrivateUsers=yes
RemoveIPC=yes
KeyringMode=private
LockPersonality=yes
MemoryDenyWriteExecute=yes
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
# netlink: the addresses of this machine are read over it
RestrictAddressFamilies=AF_INET AF_INET6 AF_UNIX AF_NETLINK
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallFilter=~@privileged @resources
SystemCallErrorNumber=EPERM

[Install]
WantedBy={target}
"""

TARGET = """\
# All that runs on host {host} for the run {run}. Written by zfusion deploy.
[Unit]
Description=zfusion {run} on {host}
Wants={services}

[Install]
WantedBy=multi-user.target
"""

USERS = f"""\
# Whom zfusion's services run as. Written by zfusion deploy.
u {USER} - "zfusion" {PLACE}
"""

INSTALL = f"""\
Under systemd, as root, from inside the host's folder:

    python3 -m venv /opt/zfusion && /opt/zfusion/bin/pip install zfusion
    cp {DIRECTORY}/zfusion.conf /etc/sysusers.d/ && systemd-sysusers
    mkdir -p {PLACE} && cp -r . {{place}}
    chown -R root:{USER} {{place}} && chmod -R u=rwX,g=rX,o= {{place}}
{{writable}}    cp {DIRECTORY}/*.service {DIRECTORY}/*.target /etc/systemd/system/ && systemctl daemon-reload
    systemctl enable --now --no-block {{target}}

A service is active when it has joined the others. How they are doing:

    systemctl status 'zfusion-{{run}}-*'
    journalctl -f -u 'zfusion-{{run}}-*'
"""


def units(plan: Plan, host: str) -> dict[str, str]:
    """The host's unit files by their names; none where nothing is to be kept running there."""
    services: dict[str, str] = {}
    started = []
    for process in plan.on(host):
        if process.kind in SERVED:
            started.append(unit_of(plan, process))
            name = template_of(plan, process)
            services[name] = _service(plan, process)
    if not started:
        return {}
    target = TARGET.format(host=host, run=plan.run, services=" ".join(started))
    return {**services, target_of(plan): target, "zfusion.conf": USERS}


def write_units(plan: Plan, directory: Path) -> Iterator[Path]:
    """Write the units of all hosts into their folders, and how to install them; the files."""
    for host in plan.hosts.hosts:
        files = units(plan, host)
        if not files:
            continue
        place = directory / host / DIRECTORY
        place.mkdir(exist_ok=True)
        for name, text in {**files, "README": _install(plan, host)}.items():
            (place / name).write_text(text)
            yield place / name


def unit_of(plan: Plan, process: Process) -> str:
    """The name of the unit that keeps a process running."""
    return template_of(plan, process).replace("@", f"@{process.node}")


def template_of(plan: Plan, process: Process) -> str:
    """The name of the file that says so: all nodes of a host have one."""
    return f"zfusion-{plan.run}-{process.kind}{'@' if process.kind == 'node' else ''}.service"


def target_of(plan: Plan) -> str:
    """The name of the unit for all that a host runs."""
    return f"zfusion-{plan.run}.target"


def _service(plan: Plan, process: Process) -> str:
    general = replace(process, node="%i") if process.kind == "node" else process
    program, *words = plan.command(general)
    assert program == "zfusion"  # which is in an environment of its own
    place = f"{PLACE}/{plan.run}"
    return SERVICE.format(
        about=f"A {process.kind} of the run {plan.run} on host {process.host}",
        run=plan.run,
        what="node %i" if process.kind == "node" else process.kind,
        command=join((PROGRAM, *words)),
        target=target_of(plan),
        place=place,
        user=USER,
        files="\n".join(_files(plan, general, place)),
        memory=MEMORY[process.kind],
    )


def _files(plan: Plan, process: Process, place: str) -> Iterator[str]:
    """What a process may see and change of its folder."""
    if plan.secured:
        yield f"TemporaryFileSystem={place}/tls:ro"
        yield from (f"BindReadOnlyPaths={place}/{file}" for file in (AUTHORITY, process.certificate, process.key))
    if process.kind == "recorder":
        yield f"ReadWritePaths={place}/{RECORDINGS}"


def _install(plan: Plan, host: str) -> str:
    place = f"{PLACE}/{plan.run}"
    writable = f"    chown -R {USER}: {place}/{RECORDINGS}\n" if plan.hosts.hosts[host].recorder else ""
    return INSTALL.format(place=place, run=plan.run, target=target_of(plan), writable=writable)
