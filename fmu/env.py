"""FMUs as one batched env, made from the names of what is connected to them."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, TypedDict, Unpack

import gymnasium
import torch

from coil_fmu.model import NO_NUMBERS, REAL, Model, Variable
from coil_fmu.plant import FAILED, FMU, SETPOINT, Clock, Reward, Wiring, action_space
from coil_fmu.reward import Follow
from coil_fmu.setpoints import Course, course_of
from coil_rl import GymnasiumEnv
from coil_rl.for_guests import load
from coil_rl.ranges import Count, Len, Positive, Processes, Seed, checked


class Rows(TypedDict, total=False):
    """Settings of `coil_rl.GymnasiumEnv`, see there."""

    num_envs: Count
    seed: Seed
    first_seed: Seed | None
    cases: Count | None
    controllers: Mapping[str, Any] | None
    fresh: bool
    workers: Processes
    device: torch.device | str
    dtype: torch.dtype


@checked
def fmu_env(
    file: str | os.PathLike[str],
    *,
    step: Positive | None = None,
    seconds: Positive | None = None,
    actions: Sequence[str] | None = None,
    observations: Sequence[str] | None = None,
    setpoints: Mapping[str, Any] | None = None,
    parameters: Mapping[str, Any] | None = None,
    start: Mapping[str, Any] | None = None,
    bounds: Mapping[str, Annotated[Sequence[float], Len(2, 2)]] | None = None,
    substeps: Count | None = None,
    reward: str | Reward | None = None,
    failure: float | None = None,
    **rows: Unpack[Rows],
) -> GymnasiumEnv:
    """Return an FMU, or several side by side, as an env.

    Each row is an instance of its own. Reads `action`, the inputs one after the other; writes an
    entry [B, 1] for each output and each setpoint (NAME_setpoint), and under `info` the drawn
    parameters and `failed`, whether the FMU could not go on. An episode that it cannot go on with
    is terminated. Units, bounds, nominal values and descriptions are those of the FMU.

    Args:
        file: the FMU, of FMI 2 or 3 for co-simulation.
        step: s, between two actions.
        seconds: length of an episode; None: of the DefaultExperiment of the FMU.
        actions: inputs; None: all. They are all real numbers or all choices.
        observations: outputs; None: all that are numbers.
        setpoints: what outputs are to follow: a number, or arguments of `Course`.
        parameters: what is drawn for each episode from its seed, as in {inertia: {low: 0.8, high:
            1.2}}.
        start: values of parameters, inputs and states at the begin of each episode.
        bounds: [low, high] of inputs, in place of those of the FMU.
        substeps: steps of the FMU in each step; None: those that its DefaultExperiment prefers.
        reward: function of two `Moment`s, the end of a step and that of the one before, or the
            MODULE:NAME of one; it returns a number, or a number and whether the episode
            terminates. None: `Follow()`.
        failure: reward of a step that the FMU cannot do; None: as if each step that is left were
            the worst one so far, and at most 0.
        rows: settings of `coil_rl.GymnasiumEnv`.

    Raises:
        ValueError: for an FMU that cannot be simulated here, and for names, times and bounds that
            do not fit it.
        UserError: without the extra `fmu`.
    """
    model = Model(file)
    wiring = _wiring(model, actions, observations, setpoints, parameters, start, bounds)
    clock = _clock(model, step, seconds, substeps)
    function = _reward(reward, wiring)

    def make() -> gymnasium.Env[Any, Any]:
        return FMU(model, wiring, clock, function, failure)

    make.__qualname__ = model.name
    return GymnasiumEnv(make, info=(FAILED, *wiring.parameters), **rows)


def _wiring(
    model: Model,
    actions: Sequence[str] | None,
    observations: Sequence[str] | None,
    setpoints: Mapping[str, Any] | None,
    parameters: Mapping[str, Any] | None,
    start: Mapping[str, Any] | None,
    bounds: Mapping[str, Sequence[float]] | None,
) -> Wiring:
    """Return what is connected to an FMU; a `ValueError` for a name that it does not have."""
    inputs = _numbers(model, "actions", actions, "input")
    seen = _numbers(model, "observations", observations, "output", "local")
    if not seen:
        raise ValueError(f"observations: {model.name} has no output that is a number")
    model.named("bounds", bounds or (), "input")
    wanted, names = _courses("setpoints", setpoints), {variable.name for variable in seen}
    for name in wanted:
        if name not in names:
            raise ValueError(f"setpoints: {name} is not observed; name it in env.observations")
        if f"{name}{SETPOINT}" in names:
            raise ValueError(
                f"setpoints: {model.name} has an output {name}{SETPOINT} itself; leave it out of "
                "env.observations"
            )
    drawn = _courses("parameters", parameters)
    for each in model.named("parameters", drawn, "parameter", "input", "local", "output"):
        if each.type not in REAL:
            raise ValueError(
                f"parameters: {each.name} of {model.name} is a {each.type}, and only real numbers "
                "are drawn; give it by env.start"
            )
        if each in inputs:
            raise ValueError(f"parameters: {each.name} is an action; leave one out")
    model.named("start", start or (), "parameter", "input", "local", "output")
    moved = []
    for each in inputs:
        low, high = (bounds or {}).get(each.name, (each.low, each.high))
        moved.append(replace(each, low=low, high=high))
    space = action_space(moved, model.name)
    return Wiring(moved, space, seen, wanted, drawn, dict(start or {}))


def _numbers(
    model: Model, key: str, names: Sequence[str] | None, *causalities: str
) -> list[Variable]:
    """Return the variables of some names; None: all of the first causality that are numbers."""
    if names is None:
        return [each for each in model.of(causalities[0]) if each.type not in NO_NUMBERS]
    found = model.named(key, names, *causalities)
    for each in found:
        if each.type in NO_NUMBERS:
            raise ValueError(
                f"{key}: {each.name} of {model.name} is a {each.type}, not a number; leave it out"
            )
    return found


def _courses(key: str, given: Mapping[str, Any] | None) -> dict[str, Course]:
    return {name: course_of(f"{key}.{name}", each) for name, each in (given or {}).items()}


def _clock(model: Model, step: float | None, seconds: float | None, substeps: int | None) -> Clock:
    """Return the times of an episode; a `ValueError` for those that nobody says, or do not fit."""
    preferred = model.experiment("stepSize")
    if step is None:
        said = f"; {model.name} itself prefers {preferred:g}" if preferred else ""
        raise ValueError(f"step is missing: give env.step, the seconds between two actions{said}")
    begin, end = model.experiment("startTime") or 0.0, model.experiment("stopTime")
    if seconds is None:
        if end is None:
            raise ValueError(
                f"seconds is missing, and {model.name} has no stopTime: give env.seconds, the "
                "length of an episode"
            )
        seconds = end - begin
    steps = round(seconds / step)
    if steps < 1 or not math.isclose(steps * step, seconds, rel_tol=1e-6):
        near = sorted({max(steps - 1, 1) * step, max(steps, 1) * step, (steps + 1) * step})
        raise ValueError(
            f"step={step:g} does not divide the {seconds:g} s of an episode; give env.seconds, "
            f"such as {' or '.join(f'{each:g}' for each in near[:2])}"
        )
    if substeps is None:
        substeps = math.ceil(step / preferred - 1e-6) if preferred else 1
    plan = model.description.coSimulation
    fixed = plan.fixedInternalStepSize or preferred
    if not plan.canHandleVariableCommunicationStepSize and fixed:
        parts = step / substeps / float(fixed)
        if round(parts) < 1 or not math.isclose(parts, round(parts), rel_tol=1e-6):
            raise ValueError(
                f"step={step:g} in {substeps} parts: {model.name} takes steps of {float(fixed):g} "
                "s only; give a multiple of it"
            )
    return Clock(begin, step, substeps, steps)


def _reward(given: str | Reward | None, wiring: Wiring) -> Reward:
    """Return the function of a reward; a `ValueError` for none."""
    if isinstance(given, str):
        given = load(given, "reward")
    if given is not None and not callable(given):
        raise ValueError(f"reward={given!r} must be a function, or MODULE:NAME of one")
    if isinstance(given, Follow) or given is None:
        if not wiring.setpoints:
            raise ValueError(
                "reward: there is nothing to follow; give env.setpoints={OUTPUT: VALUE}, or "
                "env.reward=MODULE:NAME of a function of two moments"
            )
        given = given or Follow()
        for name in given.weights.keys() - wiring.setpoints.keys():
            raise ValueError(f"reward.weights.{name}: {name} has no setpoint")
    return given
