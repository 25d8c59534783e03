"""`replay --verify` beside merely reading the file.

    python benchmarks/replay.py [--steps N] [--json]

Both on the same simulated recording of the four-sensor example, in turn, in one process.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

from results import tell
from zfusion.drivers.replayed import verify
from zfusion.drivers.simulated import simulate
from zfusion.messages import decode_any
from zfusion.model.scenario import load_scenario
from zfusion.recording.reader import Recording

SCENARIO = Path(__file__).parents[1] / "examples" / "four_sensor.toml"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=5000)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    read, decoded, verified = [], [], []
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "run.mcap"
        simulate(load_scenario(SCENARIO, steps=options.steps), run="benchmark", output=path)
        for _ in range(options.repetitions):
            began = time.process_time()
            with Recording.open(path) as recording:
                messages = sum(1 for _ in recording.records())
            read.append(time.process_time() - began)
            began = time.process_time()
            with Recording.open(path) as recording:
                for record in recording.records():
                    decode_any(record.data)
            decoded.append(time.process_time() - began)
            began = time.process_time()
            with Recording.open(path) as recording:
                verdict = verify(recording)
            verified.append(time.process_time() - began)
            assert verdict.verified, verdict.first
    each = {
        name: statistics.median(times) / messages * 1e6
        for name, times in (("read", read), ("read_and_unpack", decoded), ("verify", verified))
    }
    result = {"messages": messages, **{f"{name}_us_per_message": round(us, 2) for name, us in each.items()}}
    result |= {"verify_over_read": round(each["verify"] / each["read"], 1)}
    result |= {"verify_steps_per_s": round(options.steps / statistics.median(verified))}
    tell(result, options.json)


if __name__ == "__main__":
    main()
