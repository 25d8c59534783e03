"""`recover`, `merge` and `cut` beside merely reading the file.

    python benchmarks/recover.py [--steps N] [--json]

All on the same simulated recording of the four-sensor example, in turn, in one process; recover on a copy with a
damaged block.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from results import tell
from zfusion.drivers.simulated import simulate
from zfusion.model.scenario import load_scenario
from zfusion.recording import Recording
from zfusion.recording.cut import cut
from zfusion.recording.merge import merge
from zfusion.recording.recover import recover

SCENARIO = Path(__file__).parents[1] / "examples" / "four_sensor.toml"


def read(path: Path) -> int:
    with Recording.open(path) as recording:
        return sum(1 for _ in recording.records())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        path, broken, made = (Path(directory) / f"{name}.mcap" for name in ("run", "broken", "made"))
        simulate(load_scenario(SCENARIO, steps=options.steps), run="benchmark", output=path)
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        broken.write_bytes(data)
        works: dict[str, Callable[[], object]] = {
            "read": lambda: read(path),
            "recover": lambda: recover(broken, made),
            "merge": lambda: merge([path], made),
            "cut": lambda: cut(path, made, steps=range(1, options.steps)),
        }
        times: dict[str, list[float]] = {name: [] for name in works}
        for _ in range(options.repetitions):
            for name, work in works.items():
                began = time.process_time()
                work()
                times[name].append(time.process_time() - began)
        messages = read(path)
    each = {name: statistics.median(of) / messages * 1e6 for name, of in times.items()}
    result = {"messages": messages, **{f"{name}_us_per_message": round(us, 2) for name, us in each.items()}}
    result |= {"bytes": len(data), "recover_over_read": round(each["recover"] / each["read"], 1)}
    tell(result, options.json)


if __name__ == "__main__":
    main()
