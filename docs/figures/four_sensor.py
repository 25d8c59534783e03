"""Draws docs/figures/four_sensor.svg: predicted mean squared errors of the example, and sampled ones.

    pip install -e '.[figures]' && python docs/figures/four_sensor.py

Each dot is the mean over independent simulated runs, with two standard errors of that mean.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from zfusion.drivers.simulated import Simulation
from zfusion.messages import decode_any
from zfusion.methods.prediction import predict
from zfusion.model.scenario import load_scenario

RUNS, STEPS, NODE = 1000, 20, 2
HERE = Path(__file__).parent
COLOURS = {"local": "#90a4ae", "intermediate": "#1565c0", "estimate": "#2e7d32", "centralized": "#c62828"}


def sampled() -> dict[str, np.ndarray]:
    """Squared errors of node NODE by stage, (RUNS, STEPS)."""
    scenario = load_scenario(HERE.parents[1] / "examples" / "four_sensor.toml", steps=STEPS)
    squared = {stage: np.zeros((RUNS, STEPS)) for stage in ("intermediate", "estimate")}
    for seed in range(RUNS):
        states: dict[str, dict[int, float]] = {"truth": {}, "intermediate": {}, "estimate": {}}

        def keep(topic: str, data: bytes, _: int, states: dict[str, dict[int, float]] = states) -> None:
            stage = topic.rsplit("/", 1)[1]
            if stage == "truth" or (stage in states and f"/node/{NODE}/" in topic):
                message = decode_any(data)
                states[stage][message["step"]] = message["x"][0]

        Simulation(scenario.with_overrides(seed=seed), record=keep).run()
        for stage, of_runs in squared.items():
            of_runs[seed] = [(states[stage][k] - states["truth"][k]) ** 2 for k in range(1, STEPS + 1)]
    return squared


def main() -> None:
    """Simulate, predict, draw."""
    scenario = load_scenario(HERE.parents[1] / "examples" / "four_sensor.toml", steps=STEPS)
    prediction = predict(scenario.system(), scenario.network, STEPS)
    k = np.arange(1, STEPS + 1)
    node = scenario.ids.index(NODE)
    plt.rcParams["svg.hashsalt"] = "zfusion"
    figure, axes = plt.subplots(figsize=(8, 4.2))
    lines = {
        "local": prediction.local[1:, node, 0, 0],
        "intermediate": prediction.intermediate[1:, node, 0, 0],
        "estimate": prediction.distributed[1:, node, 0, 0],
        "centralized": prediction.centralized[1:, 0, 0],
    }
    for kind, line in lines.items():
        axes.plot(k, line, color=COLOURS[kind], linewidth=1.6, label=f"{kind}, predicted")
    for stage, squared in sampled().items():
        error = 2 * squared.std(axis=0, ddof=1) / np.sqrt(RUNS)
        shift = -0.12 if stage == "intermediate" else 0.12
        axes.errorbar(
            k + shift, squared.mean(axis=0), error, fmt="o", markersize=3, linewidth=0.8, color=COLOURS[stage],
            label=f"{stage}, mean of {RUNS} runs ± 2 s.e.",
        )  # fmt: skip
    axes.set(xlabel="step k", ylabel="mean squared error", title=f"four_sensor: errors of node {NODE}", ylim=(0, None))
    axes.set_xticks(range(0, STEPS + 1, 5))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="upper left")
    figure.tight_layout()
    figure.savefig(HERE / "four_sensor.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
