"""The method `delay_aware` at a node: its neighbours and it itself are the sensors whose measurements come late.

What is received of a neighbour at a step is the newest of its measurements that came since the step before; those of
earlier steps are what the node takes in late (timing.late = "revise"). The own measurement is never late.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, cast

import numpy as np

from zfusion.errors import InputError
from zfusion.methods.delay_aware.companions import Augmented, Packet, Stamped
from zfusion.methods.delay_aware.constant import best_gain, moment_radius, settled
from zfusion.methods.delay_aware.mapping import METHOD, Model, check_noises
from zfusion.methods.delay_aware.options import ESTIMATED, DelayAwareOptions
from zfusion.methods.delay_aware.recursion import Filter
from zfusion.methods.family import Family, Forecast
from zfusion.methods.protocol import Fields, Outcome, Setting
from zfusion.model.checks import ModelError
from zfusion.model.network import Network
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId
from zfusion.stages import MEASUREMENT, Stage
from zfusion.used_sets import Ledger, UsedSet


class DelayAware:
    """One node's filter."""

    name: ClassVar[str] = METHOD
    stages: ClassVar[tuple[Stage, ...]] = (MEASUREMENT,)

    def __init__(self, setting: Setting) -> None:
        """InputError where probabilities are to be estimated and nothing is known of the links."""
        options = cast(DelayAwareOptions, setting.options)
        self._node, self._neighbourhood = setting.node, setting.network.neighbours(setting.node)
        self._model = Model(setting.system, self._neighbourhood, options.noise)
        self._p = probabilities_by_row(self._model, setting)
        self._stamped = options.companion == "stamped"
        self._filtered = options.filtered
        self._window = setting.window
        prior = self._model.prior(setting.born)
        start = prior.mean, prior.covariance, len(self._p) - 1, self._model.m
        self._constant: Array | None = None
        self._core: Filter | Augmented | Stamped
        if self._stamped:
            self._core = Stamped(*start)
        elif options.companion == "augmented":
            self._core = Augmented(*start)
        else:
            self._core = Filter(*start)
            if options.gain == "constant":
                self._constant = best_gain(self._model.stationary(self._p)).L
        self._begun = False
        self._step = setting.born
        self._late: dict[NodeId, list[Packet]] = {}
        self._told: dict[int, Outcome] = {}

    def begin(self, step: int, y: Array | None) -> Fields:
        """The measurement, as it is."""
        self._go_to(step)
        return {"y": y}

    def skip(self, step: int) -> None:
        """A step at which nothing was received, and it is known."""
        self._go_to(step)
        self._receive([], self._p * 0.0)

    def revise(self, late: Mapping[int, Mapping[NodeId, Fields]]) -> dict[int, UsedSet]:
        """Keep what came late for this step's reception: without stamps the newest of each neighbour."""
        taken: dict[int, list[NodeId]] = {}
        for step in sorted(late, reverse=True):
            for j in self._neighbourhood:
                y = late[step][j]["y"] if j in late[step] else None
                age = self._step - step
                if y is None or not self._may_come(j, age) or (j in self._late and not self._stamped):
                    continue
                self._late.setdefault(j, []).append(Packet(age, self._model.rows[j], cast(Array, y)))
                taken.setdefault(step, []).append(j)
        return {step: tuple(taken[step]) for step in sorted(taken)}

    def correct(self, step: int, heard: Mapping[NodeId, Fields]) -> Outcome:  # noqa: ARG002
        """What was told: past estimates are not corrected, what comes late serves the next one."""
        return self._told[step]

    def advance(self, stage: int, step: int, arrived: Mapping[NodeId, Fields], ledger: Ledger) -> Fields | Outcome:  # noqa: ARG002
        """Filter with what was received."""
        packets: list[Packet] = []
        used = []
        for j in self._neighbourhood:  # in sorted order, whatever the order of arrival
            y = cast("Array | None", arrived[j]["y"]) if j in arrived else None
            late = self._late.get(j, [])
            if y is not None:
                used.append(j)
                late = [Packet(0, self._model.rows[j], y), *late]
            packets += late if self._stamped else late[:1]
        p = self._p
        if self._node not in used:  # it is known that there is none
            p = p.copy()
            p[:, self._model.rows[self._node]] = 0.0
        x, P = self._receive(packets, p)
        outcome = self._told[step] = Outcome(x, P, tuple(used))
        for past in [past for past in self._told if past < step - self._window]:
            del self._told[past]
        return outcome

    def _may_come(self, j: NodeId, age: int) -> bool:
        return age < len(self._p) and (self._stamped or bool(self._p[age, self._model.rows[j].start] > 0))

    def _go_to(self, step: int) -> None:
        if self._begun:
            motion = self._model.motion(step)
            if isinstance(self._core, Filter):
                self._core.move(*motion, self._constant)
            else:
                self._core.move(*motion)
        self._begun, self._step = True, step
        self._late = {}

    def _receive(self, packets: list[Packet], p: Array) -> tuple[Array, Array]:
        """The estimate and the covariance of its error."""
        core, given = self._core, self._model.reception(self._step, p)
        before = core.x, core.P
        if isinstance(core, Stamped):
            core.receive(packets, given)
            after = core.x, core.P
        elif isinstance(core, Augmented):
            core.receive(_vector(packets, self._model.m), given)
            after = core.x, core.P
        else:
            found = core.receive(_vector(packets, self._model.m), given)
            after = found.x, found.P
        return after if self._filtered else before


def _vector(packets: list[Packet], m: int) -> Array:
    """What is received, zero where nothing is, (m,)."""
    r = np.zeros(m)
    for packet in packets:
        r[packet.rows] = packet.y
    return r


def probabilities_by_row(model: Model, setting: Setting) -> Array:
    """p of each row, (L+1, m); the own measurement is always there, and at once.

    InputError where probabilities are to be estimated and nothing is known of the links.
    """
    options, node = cast(DelayAwareOptions, setting.options), setting.node
    others = [j for j in setting.network.neighbours(node) if j != node]
    steps = options.lateness
    known: Mapping[NodeId, Sequence[float]] = {}
    if options.probabilities == ESTIMATED:
        steps = setting.window if options.delays is None else options.delays
        if options.companion != "stamped" and others:  # with stamps nobody asks how likely a delay was
            if setting.punctuality is None:
                raise InputError(f"method {METHOD}: nothing is known of the links: give probabilities")
            known = setting.punctuality(steps)
    p = np.zeros((steps + 1, model.m))
    p[0, model.rows[node]] = 1.0
    for j in others:
        listed = np.array(known.get(j, ()) if options.probabilities == ESTIMATED else options.given(j) or ())
        p[: len(listed), model.rows[j]] = listed[:, None]
    return p


def _forecast(options: DelayAwareOptions, system: System, network: Network) -> Forecast:
    """Of the filter of the source; InputError where the probabilities are not given, or nothing is stationary."""
    if options.probabilities == ESTIMATED:
        raise InputError(f"method {METHOD}: errors are known beforehand where the probabilities are given")
    stepwise, constant = [], []
    for i in network.ids:
        model = Model(system, network.neighbours(i), options.noise)
        stationary = model.stationary(probabilities_by_row(model, Setting(i, system, network, options=options)))
        stepwise.append(settled(stationary).variance)
        constant.append(best_gain(stationary).variance)
    return Forecast(
        {"mse": sum(stepwise), "constant_mse": sum(constant)},
        {"mse": stepwise, "constant_mse": constant},
        ("errors are those of one-step predictions of the plain filter; constant_mse: with the best constant gain",),
        given="with delays and losses as the option probabilities says, drawn afresh at each step",
    )


def _warnings(options: DelayAwareOptions, system: System, network: Network) -> tuple[str, ...]:  # noqa: ARG001
    """Where E[x xᵀ] grows without bound, what is random grows with it: all but what is certain is noise."""
    F = system.F.items[0]
    if system.F.constant_from != system.F.first:
        return ()
    given = options.probabilities
    lists = given.values() if isinstance(given, Mapping) else () if given == ESTIMATED else (given,)
    certain = options.companion == "stamped" or (given != ESTIMATED and all(p in (0, 1) for one in lists for p in one))
    random = F.is_random or any(h.is_random for sensor in system.sensors for h in sensor.H.items)
    radius = moment_radius(F.mean, F.factors)
    if radius < 1 or (certain and not random):
        return ()
    return (
        f"delay_aware: E[x x^T] grows without bound (spectral radius {radius:.6g}, not below 1), and the mean squared "
        "error with it wherever gains, delays or losses are random",
    )


def _check(options: DelayAwareOptions, system: System, network: Network) -> None:
    check_noises(system)
    if isinstance(options.probabilities, Mapping):
        known = {str(i): i for i in network.ids}
        for sender in options.probabilities:
            if sender not in known:
                raise ModelError(f"method.options.probabilities.{sender}", sender, "expected the id of a sensor")
        for i in network.ids:
            for j in network.neighbours(i):
                if j != i and str(j) not in options.probabilities:
                    told = f"expected those of node {j}, too, which node {i} hears"
                    raise ModelError("method.options.probabilities", sorted(options.probabilities), told)
    if options.gain == "constant":
        for i in network.ids:
            model = Model(system, network.neighbours(i))
            model.stationary(np.zeros((1, model.m)))


DELAY_AWARE = Family(
    DelayAware.name,
    DelayAware,
    stages=lambda _: DelayAware.stages,
    options=DelayAwareOptions,
    revises=True,
    lateness=lambda options: cast(DelayAwareOptions, options).lateness,
    forecast=_forecast,
    check=_check,
    warnings=_warnings,
    note="late measurements serve the next estimate; what is late more often than it was taken to be makes P wrong",
)
