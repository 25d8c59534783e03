"""Commands on scenarios: design."""

from __future__ import annotations

from zfusion.cli.common import Json, ScenarioFile, Steps, finish, load, out


def design(
    scenario: ScenarioFile,
    steps: Steps = None,
    as_json: Json = False,
) -> None:
    """Predict the error covariances of all estimates, without running anything."""
    from zfusion.methods.prediction import predict
    from zfusion.report.design import as_json_object, show_prediction

    loaded = load(scenario, steps)
    prediction = predict(loaded.system(), loaded.network, loaded.steps)
    finish(as_json_object(prediction), as_json, lambda: show_prediction(out, loaded.name, prediction))
