"""Commands on scenarios: design."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from zfusion.cli.common import Json, Links, Loss, MethodName, ScenarioFile, Seed, Steps, finish, load, out
from zfusion.cli.progress import designing, progress, waiting
from zfusion.errors import InputError
from zfusion.methods import METHODS, chosen

if TYPE_CHECKING:
    from zfusion.methods.family import Forecast
    from zfusion.model.scenario import Scenario
    from zfusion.report.forecast import Foretold

Delay = Annotated[
    float | None, typer.Option(help="Seconds that a message takes.", min=0, show_default="the scenario's")
]
SAMPLES = 100

PREDICTED = ("two_stage", "local", "centralized")
"""Methods of which every step's error covariances are predicted, for whatever scenario."""


def design(
    scenario: ScenarioFile,
    method: MethodName = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File for the design (.npz), of methods that have one.")
    ] = None,
    steps: Steps = None,
    links: Links = None,
    loss: Loss = None,
    delay: Delay = None,
    seed: Seed = None,
    samples: Annotated[int, typer.Option(help="Realisations of random links to average over.", min=2)] = SAMPLES,
    as_json: Json = False,
) -> None:
    """Design the scenario's method, or predict its errors, without running anything.

    For methods that are designed off-line: their gains, bounds and true costs. Of two_stage, local and centralized all
    error covariances: if every message arrives; and where the scenario or the options say what becomes of messages,
    their mean under that.
    """
    from zfusion.report.forecast import show_forecast

    loaded = load(scenario, steps, seed=seed, method=method, links=links, loss=loss, delay=delay)
    family = chosen(loaded).family
    if output is not None and family.designer is None:
        able = ", ".join(one.name for one in METHODS.values() if one.designer is not None)
        raise InputError(f"--output: {family.name} is not designed off-line: expected one of {able}")
    if family.name in PREDICTED:
        _predicted(loaded, samples, as_json)
        return
    told = _forecast(loaded) if family.designer is None else _designed(loaded, output)
    finish(told.as_dict(), as_json, lambda: show_forecast(out, told))


def _predicted(scenario: Scenario, samples: int, as_json: bool) -> None:
    from zfusion.methods.prediction import predict
    from zfusion.report.design import as_json_object, show_prediction
    from zfusion.studies.sensitivity import under_links

    under = None
    if _links_matter(scenario):
        with progress("realisations of the links", samples) as done:
            under = under_links(scenario, samples, jobs=os.cpu_count() or 1, progress=done)
    prediction = predict(scenario.system(), scenario.network, scenario.steps)
    finish(as_json_object(prediction, under), as_json, lambda: show_prediction(out, scenario.name, prediction, under))


def _designed(scenario: Scenario, output: Path | None) -> Foretold:
    from zfusion.drivers.designs import make
    from zfusion.report.forecast import Foretold

    began = time.perf_counter()
    with waiting(designing(scenario)):
        made = make(scenario)
    seconds = time.perf_counter() - began
    if output is not None:
        made.save(output)
    remarks = _unforeseen(scenario, made.forecast)
    return Foretold(scenario.name, scenario.method.name, scenario.ids, made.forecast, remarks, seconds, output)


def _forecast(scenario: Scenario) -> Foretold:
    """What the method itself foretells, or that nothing is known; with the bounds that no method goes beyond."""
    from zfusion.report.forecast import Foretold

    method = chosen(scenario)
    if method.family.forecast is not None:
        try:
            known = method.family.forecast(method.options, scenario.system(), method.network(scenario.network))
        except InputError as error:
            return _bounds_only(scenario, f"no prediction: {error}")
        return Foretold(scenario.name, method.name, scenario.ids, known, _unforeseen(scenario, known))
    return _bounds_only(
        scenario,
        f"no prediction: nothing tells the errors of {method.name} beforehand; "
        f"zfusion compare SCENARIO --methods {method.name},two_stage measures them",
    )


def _bounds_only(scenario: Scenario, why: str) -> Foretold:
    from zfusion.methods.family import Forecast
    from zfusion.methods.prediction import predict
    from zfusion.report.forecast import Foretold

    last = predict(scenario.system(), scenario.network, scenario.steps)
    alone = np.einsum("iaa->i", last.local[-1])
    bounds = Forecast({"centralized_mse": float(np.trace(last.centralized[-1]))}, {"alone": alone.tolist()})
    at = f"the bounds are those at step {scenario.steps}: a node alone at its best, and a centre with all measurements"
    return Foretold(scenario.name, scenario.method.name, scenario.ids, bounds, (why, at))


def _unforeseen(scenario: Scenario, forecast: Forecast) -> tuple[str, ...]:
    if not _links_matter(scenario):
        return ()
    return (f"{forecast.given}: what the links and faults of the scenario do is for zfusion compare to tell",)


def _links_matter(scenario: Scenario) -> bool:
    return bool(scenario.links.model_fields_set or scenario.faults)
