"""Whether there is such a method: what of a scenario only the methods can judge."""

from __future__ import annotations

from zfusion.errors import Problem, ScenarioError
from zfusion.methods import METHODS
from zfusion.model.scenario import Scenario


def check_method(scenario: Scenario, source: str) -> None:
    """ScenarioError unless there is such a method, with such stages and options."""
    problems = []
    if scenario.method.name not in METHODS:
        problems.append(Problem("method", scenario.method.name, f"expected one of {', '.join(METHODS)}"))
    else:
        stages = [stage.name for method in METHODS.values() for stage in method.stages]
        known = ", ".join(dict.fromkeys(stages))
        for stage, fraction in scenario.timing.deadlines.items():
            if stage not in stages:
                problems.append(Problem(f"timing.deadlines.{stage}", fraction, f"expected a stage: {known}"))
        if scenario.timing.late == "revise" and not METHODS[scenario.method.name].revises:
            able = ", ".join(name for name, method in METHODS.items() if method.revises)
            problems.append(Problem("timing.late", "revise", f"expected a method that can go back: {able}"))
        for n, exception in enumerate(scenario.links.edges):
            for stage in exception.stages or ():
                if stage not in stages:
                    problems.append(Problem(f"links.edges[{n}].stages", stage, f"expected a stage: {known}"))
        for option, value in scenario.method.options.items():
            expected = f"the method {scenario.method.name} has no options"
            problems.append(Problem(f"method.options.{option}", value, expected))
    if problems:
        raise ScenarioError(source, problems)
