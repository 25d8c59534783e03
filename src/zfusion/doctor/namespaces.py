"""What ``launch --netns`` would choose on this machine, and for this user."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator

from zfusion.doctor.finding import Finding, Topic
from zfusion.model.scenario import Scenario

TOPIC = Topic("netns")

TRY = """
import json, sys
from zfusion.errors import InputError
from zfusion.model.scenario import Scenario
from zfusion.swarm.netns.network import Network
try:
    said = Network(Scenario.from_toml(sys.stdin.read()), None).choice._asdict()
except InputError as error:
    said = {"fault": str(error)}
sys.stdout.write(json.dumps(said))
"""
"""In a process of its own: who enters a namespace does not come back."""

TIMEOUT_S = 20.0


def check_namespaces(scenario: Scenario) -> Iterator[Finding]:
    """Tried for real: a network of the scenario's nodes, which is gone when the process is."""
    why, remedy = "only launch --netns needs it; without, links are emulated at the receivers", "leave out --netns"
    try:
        tried = subprocess.run(
            [sys.executable, "-c", TRY],
            input=scenario.anchored().to_toml(),
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=True,
        )
        said = json.loads(tried.stdout)
    except (OSError, subprocess.SubprocessError, ValueError):
        yield TOPIC.warning("the network of namespaces could not be tried", why, remedy)
        return
    if "fault" in said:
        yield TOPIC.warning(said["fault"], why, f"{remedy}, or run as root, or allow user namespaces and /dev/net/tun")
    else:
        yield TOPIC.ok(f"launch --netns would use {said['kind']}: {said['why']}")
