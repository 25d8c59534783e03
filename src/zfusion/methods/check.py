"""Whether there is such a method, and it can do what is asked of it: what of a scenario only the methods can judge."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise

from zfusion.errors import InputError, Problem, ScenarioError
from zfusion.methods import METHODS, Chosen, chosen
from zfusion.model.checks import ModelError
from zfusion.model.scenario import Scenario

LAST_DEADLINE = 0.9
"""Until which part of a period the messages of the last stage are waited for; earlier stages share what is before."""

ONLY_DEADLINE = 0.45
"""The same of the one stage of a method that has only one."""


def deadlines(scenario: Scenario) -> Mapping[str, float]:
    """Until when the messages of each stage of the scenario's method are waited for, as fractions of the period."""
    stages = [stage.name for stage in chosen(scenario).stages]
    given, last = scenario.timing.deadlines, LAST_DEADLINE if len(stages) > 1 else ONLY_DEADLINE
    return {stage: given.get(stage, last * n / len(stages)) for n, stage in enumerate(stages, start=1)}


def deadline_ns(scenario: Scenario, stage: str) -> int:
    """How long after a step's beginning a paced node stops waiting for messages of `stage`.

    KeyError for a stage that the method has not, ValueError in free-running mode.
    """
    period = scenario.timing.period_ns
    if period is None:
        raise ValueError("a free-running step has no deadlines, only timeouts")
    return round(deadlines(scenario)[stage] * period)


def check_method(scenario: Scenario, source: str) -> None:
    """ScenarioError unless there is such a method, with such stages and options, for such a system and network."""
    spec = scenario.method
    if spec.name not in METHODS:
        raise ScenarioError(source, [Problem("method", spec.name, f"expected one of {', '.join(METHODS)}")])
    try:
        method = chosen(scenario)
    except ModelError as error:
        problem = error.problem
        problem = Problem(f"method.options.{problem.field}", problem.value, problem.expected)
        raise ScenarioError(source, [problem]) from None
    problems = [*_stage_problems(scenario, method), *_ability_problems(scenario, method)]
    if problems:
        raise ScenarioError(source, problems)
    if method.family.check is not None:
        try:
            method.family.check(method.options, scenario.system(), method.network(scenario.network))
        except ModelError as error:
            raise ScenarioError(source, [error.problem]) from None
        except InputError as error:
            raise InputError(f"{source}: method {spec.name}: {error}") from None


def _ability_problems(scenario: Scenario, method: Chosen) -> Iterator[Problem]:
    if scenario.timing.late == "revise" and not method.revises:
        able = ", ".join(family.name for family in METHODS.values() if family.revises)
        yield Problem("timing.late", "revise", f"expected a method that can go back: {able}")
    lateness, window = method.family.lateness(method.options), scenario.timing.revised_steps
    if lateness > window:
        wanted = f'expected late = "revise" and a window of {lateness} at least: the method wants messages so late'
        yield Problem("timing.window", window, wanted)
    if scenario.method.design is not None and method.family.designer is None:
        able = ", ".join(family.name for family in METHODS.values() if family.designer is not None)
        yield Problem("method.design", scenario.method.design, f"expected a method that is designed off-line: {able}")


def _stage_problems(scenario: Scenario, method: Chosen) -> Iterator[Problem]:
    stages = [stage.name for stage in method.stages]
    default = [stage.name for family in METHODS.values() for stage in family.stages(family.options())]
    known = dict.fromkeys((*stages, *default))
    expected = f"expected a stage: {', '.join(stages)}"
    for stage, fraction in scenario.timing.deadlines.items():
        if stage not in known:
            yield Problem(f"timing.deadlines.{stage}", fraction, expected)
    for n, exception in enumerate(scenario.links.edges):
        for stage in exception.stages or ():
            if stage not in known:
                yield Problem(f"links.edges[{n}].stages", stage, expected)
    waits = deadlines(scenario)
    for earlier, later in pairwise(stages):
        if not waits[earlier] < waits[later]:
            told = f"expected a deadline after that of {earlier}, {waits[earlier]:g}"
            yield Problem(f"timing.deadlines.{later}", waits[later], told)
