"""Commands on scenarios: design."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from zfusion.cli.common import Json, Links, Loss, ScenarioFile, Seed, Steps, finish, load, out
from zfusion.cli.progress import progress

Delay = Annotated[
    float | None, typer.Option(help="Seconds that a message takes.", min=0, show_default="the scenario's")
]
SAMPLES = 100


def design(
    scenario: ScenarioFile,
    steps: Steps = None,
    links: Links = None,
    loss: Loss = None,
    delay: Delay = None,
    seed: Seed = None,
    samples: Annotated[int, typer.Option(help="Realisations of random links to average over.", min=2)] = SAMPLES,
    as_json: Json = False,
) -> None:
    """Predict the error covariances of all estimates, without running anything.

    If every message arrives; and where the scenario or the options say what becomes of messages, their mean under that.
    """
    from zfusion.methods.prediction import predict
    from zfusion.report.design import as_json_object, show_prediction
    from zfusion.studies.sensitivity import under_links

    loaded = load(scenario, steps, seed=seed, links=links, loss=loss, delay=delay)
    under = None
    if loaded.links.model_fields_set or loaded.faults:
        with progress("realisations of the links", samples) as done:
            under = under_links(loaded, samples, jobs=os.cpu_count() or 1, progress=done)
    prediction = predict(loaded.system(), loaded.network, loaded.steps)
    finish(as_json_object(prediction, under), as_json, lambda: show_prediction(out, loaded.name, prediction, under))
