"""The metrics of a run against what is computed plainly, one message after the other, from the same messages."""

from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from test_experiment_spec import SCENARIO
from zfusion.drivers.simulated import Simulation
from zfusion.methods.prediction import predict
from zfusion.model.sampling import SamplePath
from zfusion.model.scenario import Scenario, load_scenario
from zfusion.stages import Message
from zfusion.studies.experiment.catalogue import METRICS
from zfusion.studies.experiment.engines import in_processes
from zfusion.studies.experiment.execute import execute
from zfusion.studies.experiment.metrics import Row, metrics, theory_metrics
from zfusion.studies.experiment.observed import Observer
from zfusion.studies.experiment.plan import Task
from zfusion.studies.intervals import mean_interval

EXAMPLE = Path(__file__).parents[1] / "examples" / "four_sensor.toml"
STEPS, BURN_IN = 40, 7

CHURN = """
[links]
loss = 0.25
[[faults]]
kind = "kill"
node = 2
step = 11
restart_after = 4
[[faults]]
kind = "kill"
node = 3
step = 20
restart_after = 1
"""

LATE = """
[timing]
late = "revise"
window = 5
[links]
delay = { distribution = "exponential", mean = 0.04 }
loss = 0.1
"""


class Run:
    """A simulated run, all that was said in it, and its metrics."""

    def __init__(self, extra: str, method: str = "two_stage") -> None:
        text = (
            EXAMPLE.read_text().replace("[timing]\nrate_hz = 20.0", "") if "[timing]" in extra else EXAMPLE.read_text()
        )
        extra = extra.replace("[timing]", "[timing]\nrate_hz = 20.0")
        self.scenario = Scenario.from_toml(text + extra).with_overrides(steps=STEPS, method=method)
        self.messages: list[Message] = []
        self.filters: dict[tuple[object, int, int], float] = {}
        observer = Observer(self.scenario)

        def observe(message: Message, now_ns: int) -> None:
            self.messages.append(message)
            if message.stage == "intermediate":
                P = self.simulation.nodes[message.node]._method._filter.P  # type: ignore[attr-defined]
                self.filters[message.node, message.born, message.step] = float(np.trace(P))
            observer(message, now_ns)

        self.simulation = Simulation(self.scenario, observe=observe)
        self.simulation.run()
        self.simulation.close()
        self.rows, self.curves = metrics(observer, self.simulation.reports, BURN_IN)
        path = SamplePath(self.scenario.system(), self.scenario.seed)
        self.truth = [path.truth(k) for k in range(STEPS + 1)]

    def told(self, stage: str, node: object = None) -> list[Message]:
        return [m for m in self.messages if m.stage == stage and node in (None, m.node)]

    def value(self, metric: str, stage: str = "", node: object = "all", sender: object = "") -> float:
        [row] = [row for row in self.rows if row[:4] == (str(node), str(sender), stage, metric)]
        return row.value


RUNS: dict[str, Run] = {}


def run_of(case: str) -> Run:
    if case not in RUNS:
        RUNS[case] = Run({"plain": "", "churn": CHURN, "late": LATE}[case])
    return RUNS[case]


@pytest.mark.parametrize("case", ["plain", "churn", "late"])
@pytest.mark.parametrize("node", ["all", 2])
def test_errors_are_those_of_the_messages(case: str, node: object) -> None:
    run = run_of(case)
    counted = [m for m in run.told("estimate", None if node == "all" else node) if m.step > BURN_IN]
    errors = [m.fields["x"] - run.truth[m.step] for m in counted]  # type: ignore[operator]
    mse = np.mean([e @ e for e in errors])
    predicted = np.mean([np.trace(m.fields["P"]) for m in counted])  # type: ignore[call-overload]
    nees = np.mean([e @ np.linalg.inv(m.fields["P"]) @ e for e, m in zip(errors, counted, strict=True)])  # type: ignore[call-overload]
    assert run.value("mse", "estimate", node) == pytest.approx(mse)
    assert run.value("rmse", "estimate", node) == pytest.approx(np.sqrt(mse))
    assert run.value("predicted_mse", "estimate", node) == pytest.approx(predicted)
    assert run.value("excess_mse", "estimate", node) == pytest.approx(mse - predicted)
    assert run.value("nees", "estimate", node) == pytest.approx(nees)
    last = [e @ np.linalg.inv(m.fields["P"]) @ e for e, m in zip(errors, counted, strict=True) if m.step == STEPS]  # type: ignore[call-overload]
    assert run.value("nees_final", "estimate", node) == pytest.approx(np.mean(last))


@pytest.mark.parametrize("case", ["plain", "churn", "late"])
def test_the_prediction_of_the_intermediate_is_that_of_the_nodes_filters(case: str) -> None:
    """It is computed from the used sets alone; the filters know it, and do not tell."""
    run = run_of(case)
    for node in run.scenario.ids:
        wanted = [run.filters[m.node, m.born, m.step] for m in run.told("intermediate", node) if m.step > BURN_IN]
        assert run.value("predicted_mse", "intermediate", node) == pytest.approx(np.mean(wanted), rel=1e-9)
        [curve] = [c for c in run.curves if (c.node, c.stage) == (str(node), "intermediate")]
        assert curve.predicted[BURN_IN:] == pytest.approx(wanted, rel=1e-9)


def test_the_used_sets_really_changed_in_these_cases() -> None:
    assert run_of("plain").value("restarts") == 0
    churn, late = run_of("churn"), run_of("late")
    assert (churn.value("restarts"), churn.value("restarts", node=2)) == (2, 1)
    assert churn.value("missed", "measurement") > 0
    assert late.value("revised", "measurement") > 20
    assert late.value("late", "measurement") >= late.value("revised", "measurement")
    assert late.value("predicted_mse", "revised") < late.value("predicted_mse", "estimate")


def test_a_revised_estimate_is_the_last_word_on_its_step() -> None:
    run = run_of("late")
    final = {(m.node, m.step): m for m in run.told("estimate")}
    final |= {(m.node, m.step): m for m in run.told("revised")}
    counted = [m for m in final.values() if m.step > BURN_IN]
    errors = [m.fields["x"] - run.truth[m.step] for m in counted]  # type: ignore[operator]
    assert run.value("mse", "revised") == pytest.approx(np.mean([e @ e for e in errors]))


@pytest.mark.parametrize("case", ["plain", "churn", "late"])
def test_disagreement_is_the_distance_from_the_mean_of_the_nodes(case: str) -> None:
    run = run_of(case)
    for stage in ("intermediate", "estimate"):
        by_step = defaultdict(list)
        for message in run.told(stage):
            by_step[message.step].append(message.fields["x"])
        distances = [
            np.mean([np.sum((x - np.mean(of, axis=0)) ** 2) for x in of])
            for step, of in by_step.items()
            if step > BURN_IN and len(of) > 1
        ]
        assert run.value("disagreement", stage) == pytest.approx(np.mean(distances))


def newest(run: Run) -> tuple[dict[object, list[float]], dict[object, list[bool]]]:
    """Ages and absences at every node, by keeping what every filter knows, message by message."""
    graph = run.scenario.network
    knows: dict[object, dict[object, int]] = defaultdict(dict)
    at_step: dict[tuple[object, int], dict[object, int]] = {}
    lives: dict[object, int] = {}
    ages: dict[object, list[float]] = defaultdict(list)
    absent: dict[object, list[bool]] = defaultdict(list)
    estimates = []
    for m in run.messages:
        if lives.setdefault(m.node, m.born) != m.born:
            lives[m.node], knows[m.node] = m.born, {}
        if m.stage == "event" and m.fields["kind"] == "revised" and m.fields["data"]["stage"] == "measurement":  # type: ignore[index]
            for step, ids in m.fields["data"]["taken"]:  # type: ignore[index]
                for j in ids:
                    knows[m.node][j] = max(step, knows[m.node].get(j, 0))
        elif m.stage == "intermediate":
            knows[m.node] |= dict.fromkeys(m.fields["used"], m.step)  # type: ignore[call-overload]
            at_step[m.node, m.step] = dict(knows[m.node])
        elif m.stage == "estimate" and m.step > BURN_IN:
            estimates.append(m)
    for m in estimates:
        for j in graph.two_hop(m.node):
            if j != m.node:
                steps = [at_step[n, m.step][j] for n in m.fields["used"] if j in at_step[n, m.step]]  # type: ignore[attr-defined]
                absent[m.node].append(not steps)
                ages[m.node] += [m.step - max(steps)] if steps else []
    return ages, absent


@pytest.mark.parametrize("case", ["plain", "churn", "late"])
def test_the_age_of_information_is_that_of_the_newest_measurement_that_went_in(case: str) -> None:
    run = run_of(case)
    ages, absent = newest(run)
    for node in run.scenario.ids:
        assert run.value("age", "estimate", node) == pytest.approx(np.mean(ages[node]))
        assert run.value("unheard", "estimate", node) == pytest.approx(np.mean(absent[node]))
    assert run.value("age", "estimate") == pytest.approx(np.mean([np.mean(of) for of in ages.values()]))


@pytest.mark.parametrize("case", ["plain", "churn", "late"])
def test_used_fractions_and_traffic_are_counted_from_the_messages(case: str) -> None:
    run = run_of(case)
    steps = {(m.node, m.step) for m in run.told("estimate") if m.step > BURN_IN}
    for stage, told in (("measurement", "intermediate"), ("intermediate", "estimate")):
        fractions = [
            (len(m.fields["used"]) - 1) / (len(run.scenario.network.neighbours(2)) - 1)  # type: ignore[arg-type]
            for m in run.told(told, 2)
            if (m.node, m.step) in steps
        ]
        assert run.value("used_fraction", stage, 2) == pytest.approx(np.mean(fractions))
    assert run.value("messages", "estimate", 3) == len(run.told("estimate", 3))
    assert run.value("messages") == len(run.messages)
    assert run.value("bytes") > run.value("bytes", "intermediate") > 0


def test_latencies_are_those_of_the_links() -> None:
    run = Run("[links]\ndelay = 0.004\n[[links.edges]]\nfrom = 2\nto = 1\ndelay = 0.006\n")
    assert run.value("latency_p50", "measurement", 1, sender=2) == pytest.approx(0.006, rel=0.01)
    assert run.value("latency_p99", "intermediate", 1, sender=3) == pytest.approx(0.004, rel=0.01)
    assert run.value("latency_p50", "measurement") == pytest.approx(0.004, rel=0.01)


def test_the_response_time_is_from_measurement_to_estimate() -> None:
    run = Run("[links]\ndelay = 0.004\n")
    assert run.value("response_p50", "estimate") == pytest.approx(0.008, rel=0.03)
    assert run.value("response_p99", "estimate", 3) == pytest.approx(0.008, rel=0.03)


@pytest.mark.parametrize("method", ["local", "centralized"])
def test_methods_of_one_stage_have_their_metrics_too(method: str) -> None:
    run = Run("[links]\nloss = 0.3\n", method)
    assert {row.stage for row in run.rows if row.metric == "mse"} == {"estimate"}
    if method == "local":
        assert not [row for row in run.rows if row.metric in {"age", "used_fraction"}]
        theory = {row[:4]: row.value for row in theory_metrics(run.scenario, BURN_IN)}
        assert run.value("predicted_mse", "estimate") == pytest.approx(theory["all", "", "estimate", "bound_local"])
    else:
        assert 0 < run.value("age", "estimate") < 2
        assert 0.5 < run.value("used_fraction", "measurement") < 0.9


def test_without_losses_what_was_designed_is_what_is_predicted() -> None:
    run = run_of("plain")
    theory = {row[:4]: row.value for row in theory_metrics(run.scenario, BURN_IN)}
    for stage in ("intermediate", "estimate"):
        for node in ("all", *run.scenario.ids):
            designed = theory[str(node), "", stage, "design_mse"]
            assert run.value("predicted_mse", stage, node) == pytest.approx(designed)
    prediction = predict(run.scenario.system(), run.scenario.network, STEPS)
    bound = np.mean([np.trace(P) for P in prediction.centralized[BURN_IN + 1 :]])
    assert theory["all", "", "estimate", "bound_centralized"] == pytest.approx(bound)


def test_every_metric_that_comes_out_is_in_the_catalogue() -> None:
    found = {row.metric for case in ("plain", "churn", "late") for row in run_of(case).rows}
    found |= {row.metric for row in theory_metrics(run_of("plain").scenario, BURN_IN)}
    made_later = {"nees_band", "rounds_per_s", "wall_s"}
    assert found | made_later == set(METRICS)


def test_without_truth_there_are_no_errors(tmp_path: Path) -> None:
    (tmp_path / "y.csv").write_text("y\n" + "1.0\n" * 12)
    text = SCENARIO + '[source]\nkind = "csv"\nfile = "y.csv"\ncolumns = ["y"]\n'
    scenario = Scenario.from_toml(text, directory=tmp_path)
    result = execute(Task("csv", "simulated", scenario.anchored().to_toml(), 1, 2))
    assert "error" not in result, result
    found = {row.metric for row in result["rows"]}
    assert not found & {"mse", "nees", "predicted_mse"}
    assert found >= {"disagreement", "age", "messages"}
    assert result["curves"] == []


SEEDS, SHORT = 40, 30

CONFIDENCE = 1 - 4.7e-4
"""Of 3.5 sigma."""


def test_under_random_loss_errors_are_as_predicted_and_the_covariances_believable() -> None:
    """20 % of all messages lost, each independently: errors as large as predicted, NEES one, and no fallbacks.

    The used sets do not depend on the measurements, so that given them P is the covariance, and the mean over runs of
    mse - predicted_mse is zero, that of NEES the state's dimension. Runs are independent: over them, and not over
    steps, goes the interval. The state is heavy-tailed, and so these intervals are wide; the same seeds without loss
    have nearly the same errors, and the difference, zero in the mean too, shows a few percent.
    """
    found: dict[tuple[float, str], list[float]] = defaultdict(list)
    for loss in (0.0, 0.2):
        text = load_scenario(EXAMPLE, steps=SHORT, loss=loss).to_toml()
        tasks = [Task(str(seed), "simulated", text, seed, 5) for seed in range(SEEDS)]
        for _, result in sorted(in_processes(tasks, 2), key=lambda done: done[0].seed):
            for row in map(Row._make, result["rows"]):
                if row.node == "all" and row.stage in {"", "estimate"}:
                    found[loss, row.metric].append(row.value)
    for metric, wanted, sharp in (("excess_mse", 0.0, 0.05), ("nees", 1.0, 0.1)):
        lossy, ideal = found[0.2, metric], found[0.0, metric]
        direct = mean_interval(lossy, CONFIDENCE)
        assert direct.low < wanted < direct.high  # type: ignore[operator]
        paired = mean_interval([a - b for a, b in zip(lossy, ideal, strict=True)], CONFIDENCE)
        assert paired.low < 0 < paired.high  # type: ignore[operator]
        assert paired.high - paired.low < 2 * sharp, "the interval says next to nothing"  # type: ignore[operator]
    assert sum(found[0.2, "fallbacks"]) == 0
    assert np.mean(found[0.2, "predicted_mse"]) > np.mean(found[0.0, "predicted_mse"]) * 1.02


def test_a_live_run_has_the_same_metrics_from_its_recording() -> None:
    scenario = load_scenario(EXAMPLE, steps=25, free_run=True)
    live = execute(Task("live", "live", scenario.anchored().to_toml(), 3, 5))
    assert "error" not in live, live
    simulated = execute(Task("simulated", "simulated", scenario.anchored().to_toml(), 3, 5))
    same = {"mse", "rmse", "predicted_mse", "excess_mse", "nees", "nees_final", "disagreement", "age", "used_fraction"}

    def of(result: dict[str, list[Row]]) -> dict[tuple[str, ...], float]:
        return {tuple(row[:4]): row[4] for row in result["rows"] if row[3] in same}

    assert of(live) == of(simulated)
    assert {row[3] for row in live["timings"]} == {"rounds_per_s", "wall_s"}


def test_the_manual_has_every_metric() -> None:
    text = (EXAMPLE.parents[1] / "docs" / "experiments.md").read_text()
    for name, metric in METRICS.items():
        assert f"| `{name}` | {metric.unit} | {metric.meaning.replace('|', chr(92) + '|')} |" in text
