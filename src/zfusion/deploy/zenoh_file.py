"""The Zenoh configuration of a process, as a file: the same settings as zfusion's own sessions have, and who it is."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from zfusion.deploy.access import Speech, access_control
from zfusion.deploy.plan import Plan, Process
from zfusion.drivers.credentials import dialled_under
from zfusion.drivers.settings import base_settings

AUTHORITY = "tls/ca.pem"
"""The certificate of the CA that everybody of the run is signed by."""


def zenoh_file(plan: Plan, process: Process, speech: Speech) -> str:
    """The text of the process' file; to be used in its host's folder, as the paths in it are relative."""
    settings = base_settings(process.mode, low_latency=plan.scenario.transport.preset == "lowlatency")
    settings |= {"listen/endpoints": list(process.listen), "connect/endpoints": list(process.connect)}
    if plan.secured:
        settings |= {
            "transport/link/protocols": ["tls"],
            "transport/link/tls": tls(process),
            "access_control": access_control(plan, process, speech),
        }
        if process.listen:
            settings["metadata"] = dialled_under(plan.hosts.hosts[process.host].address)
    header = f"// {process.name} of the run {plan.run}, by zfusion deploy. To be used in the folder above."
    return f"{header}\n{json.dumps(_nested(settings), indent=2)}\n"


def tls(process: Process) -> dict[str, Any]:
    """Zenoh's settings of TLS: both ends of a link prove who they are, and the listener that it is who was dialled."""
    return {
        "root_ca_certificate": AUTHORITY,
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "listen_certificate": process.certificate,
        "listen_private_key": process.key,
        "connect_certificate": process.certificate,
        "connect_private_key": process.key,
    }


def _nested(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by their paths as the tables within tables that they mean."""
    document: dict[str, Any] = {}
    for path, value in settings.items():
        *tables, name = path.split("/")
        place = document
        for table in tables:
            place = place.setdefault(table, {})
        place[name] = value
    return document
