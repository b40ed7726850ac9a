"""An FMU as an env of Gymnasium: named inputs, outputs and setpoints, and an end in time."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from coil_fmu.model import REAL, Instance, Model, SolverError, Variable
from coil_fmu.reward import Moment
from coil_fmu.setpoints import Course, Drawn

SETPOINT = "_setpoint"  # what the entry of a setpoint has behind the name of its output
FAILED = "failed"  # in info: whether the FMU could not go on

Floats = NDArray[np.float64]
Reward = Callable[[Moment, Moment], Any]


@dataclass(frozen=True)
class Clock:
    """When an episode begins and ends, and how it is cut into steps.

    Attributes:
        start: s, time of the FMU at the begin of an episode.
        step: s, between two actions.
        parts: steps of the FMU in each of them.
        steps: actions of an episode.
    """

    start: float
    step: float
    parts: int
    steps: int


@dataclass(frozen=True)
class Wiring:
    """What is connected to an FMU.

    Attributes:
        actions: inputs that are actions.
        space: of them, one after the other.
        observations: outputs that are observed.
        setpoints: courses, by the name of the output.
        parameters: what is drawn for each episode, by name.
        start: what is set before each episode, by name.
    """

    actions: Sequence[Variable]
    space: spaces.Box
    observations: Sequence[Variable]
    setpoints: Mapping[str, Course]
    parameters: Mapping[str, Course]
    start: Mapping[str, Any]


class FMU(gymnasium.Env[dict[str, Floats], Floats]):
    """An FMU as an env; `fmu_env` makes it from names, and several as one env.

    An observation has an entry for each output, and NAME_setpoint for each setpoint. Where the FMU
    cannot go on, the episode terminates, `info` has `failed` and the `message`, and the observation
    stays. `info` also has the parameters that were drawn.

    Args:
        model: the FMU.
        wiring: what is connected to it.
        clock: of its episodes.
        reward: of the end of a step, and of the step before: a number, or a number and whether the
            episode terminates.
        failure: reward of a step that the FMU cannot do; None: as if each step that is left were
            the worst one so far, and at most 0.
    """

    def __init__(
        self,
        model: Model,
        wiring: Wiring,
        clock: Clock,
        reward: Reward,
        failure: float | None,
    ) -> None:
        self.model, self.wiring, self.clock = model, wiring, clock
        self.reward, self.failure = reward, failure
        self.instance = Instance(model, wiring.observations)
        self.metadata = {"render_modes": [], "render_fps": 1 / clock.step}
        self.max_steps = clock.steps
        self.action_space: spaces.Space[Any] = wiring.space
        self.observation_space: spaces.Space[Any] = observation_space(wiring)
        self.meanings = meanings(wiring)
        self.courses: dict[str, Drawn] = {}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Floats], dict[str, Any]]:
        """Begin an episode; a `SolverError` if the FMU cannot.

        Args:
            seed: of its parameters and setpoints.
            options: none are known.
        """
        super().reset(seed=seed)
        wiring, seconds = self.wiring, self.clock.steps * self.clock.step
        drawn = {
            name: course.drawn(self.np_random, 0.0).at(0.0)
            for name, course in wiring.parameters.items()
        }
        self.courses = {
            name: course.drawn(self.np_random, seconds) for name, course in wiring.setpoints.items()
        }
        self.count, self.worst = 0, 0.0
        self.info: dict[str, Any] = {**drawn, FAILED: 0.0}
        self.instance.begin(self.clock.start, {**wiring.start, **drawn})
        inputs = {each.name: self._begun(each) for each in wiring.actions}
        self.now = Moment(0.0, self.instance.read(), inputs, self._wanted(0.0))
        return self._observed(), dict(self.info)

    def _begun(self, variable: Variable) -> Floats:
        """Return the value of an input before the first action."""
        given = self.wiring.start.get(variable.name, variable.own.start)
        if given in (None, "false", "true"):
            given = float(given == "true")
        numbers = given.split() if isinstance(given, str) else given
        return np.broadcast_to(np.array(numbers, dtype=np.float64), variable.shape or (1,))

    def _wanted(self, time: float) -> dict[str, Floats]:
        return {name: np.array([course.at(time)]) for name, course in self.courses.items()}

    def _rewarded(self, now: Moment, before: Moment) -> tuple[Any, bool]:
        """Return the reward of a step, and whether the episode terminates."""
        given = self.reward(now, before)
        reward, ends = given if isinstance(given, tuple) and len(given) == 2 else (given, False)
        with suppress(TypeError, ValueError):  # the env says of a reward that it is no number
            self.worst = min(self.worst, float(np.asarray(reward, np.float64).reshape(())))
        return reward, ends

    def step(self, action: Floats) -> tuple[dict[str, Floats], float, bool, bool, dict[str, Any]]:
        """Set the inputs, and simulate until the next action.

        Args:
            action: the values of the inputs, one after the other.
        """
        before, clock = self.now, self.clock
        sizes = np.cumsum([each.size for each in self.wiring.actions])[:-1]
        parts = np.split(np.asarray(action, dtype=np.float64).reshape(-1), sizes)
        try:
            for variable, part in zip(self.wiring.actions, parts, strict=True):
                self.instance.write(variable, part.tolist())
            length = clock.step / clock.parts
            for number in range(clock.parts):
                begun = clock.start + (self.count * clock.parts + number) * length
                self.instance.advance(begun, length)
            outputs = self.instance.read()
        except SolverError as error:
            return self._failed(str(error))
        self.count += 1
        time = self.count * clock.step
        named = [
            (each.name, part.reshape(each.shape or (1,)))
            for each, part in zip(self.wiring.actions, parts, strict=True)
        ]
        # What was to be followed in this step: another setpoint is first seen at its end.
        ended = Moment(time, outputs, dict(named), before.setpoints)
        reward, terminated = self._rewarded(ended, before)
        self.now = ended._replace(setpoints=self._wanted(time))
        truncated = self.count >= clock.steps
        return self._observed(), reward, terminated, truncated, dict(self.info)

    def _failed(self, message: str) -> tuple[dict[str, Floats], float, bool, bool, dict[str, Any]]:
        """End the episode, because the FMU could not do the step."""
        time = self.count * self.clock.step
        if message not in self.model.said:
            self.model.said.add(message)
            warnings.warn(
                f"the FMU {self.model.name} failed after {time:g} s of an episode: {message}; such "
                "an episode ends there and counts as failed",
                stacklevel=2,
            )
        self.info = {**self.info, FAILED: 1.0, "message": message}
        if self.failure is None and self.count == 0:
            self._rewarded(self.now, self.now)  # there is no other yet
        left = self.clock.steps - self.count
        reward = left * self.worst if self.failure is None else self.failure
        return self._observed(), reward, True, False, dict(self.info)

    def _observed(self) -> dict[str, Floats]:
        wanted = {f"{name}{SETPOINT}": value for name, value in self.now.setpoints.items()}
        return {**self.now.outputs, **wanted}

    def close(self) -> None:
        """Free the FMU."""
        self.instance.close()


def action_space(actions: Sequence[Variable], file: str) -> spaces.Box:
    """Return the space of some inputs: real numbers, or whole ones as choices.

    Args:
        file: of the FMU, for messages.

    Raises:
        ValueError: for none, for both kinds, and for bounds that leave no choice.
    """
    if not actions:
        raise ValueError(f"actions: {file} has no input, so there is nothing to decide")
    real = [each.name for each in actions if each.type in REAL]
    if real and len(real) < len(actions):
        others = ", ".join(each.name for each in actions if each.name not in real)
        raise ValueError(
            f"actions: {', '.join(real)} of {file} are real numbers, but {others} are choices; "
            "name those of one kind in env.actions, and give the others by env.start"
        )
    for each in actions:
        if not each.low < each.high:
            raise ValueError(
                f"actions: the input {each.name} of {file} goes from {each.low:g} to "
                f"{each.high:g}, which leaves no choice; leave it out of env.actions, or give "
                f"env.bounds.{each.name}=[LOW,HIGH]"
            )
        if not (real or math.isfinite(each.high - each.low)):
            raise ValueError(
                f"actions: the input {each.name} of {file} is a whole number without bounds; give "
                f"env.bounds.{each.name}=[LOW,HIGH]"
            )
    sizes = [each.size for each in actions]
    low = np.repeat([each.low for each in actions], sizes)
    high = np.repeat([each.high for each in actions], sizes)
    kind = np.float64 if real else np.int64
    return spaces.Box(low.astype(kind), high.astype(kind), dtype=kind)


def observation_space(wiring: Wiring) -> spaces.Dict:
    """Return the space of the observation: an entry for each output and each setpoint."""
    entries: dict[str, spaces.Space[Any]] = {}
    for each in wiring.observations:
        sides = (each.low, each.high) if each.low < each.high else (-math.inf, math.inf)
        entries[each.name] = spaces.Box(*sides, each.shape or (1,), np.float64)
    for name in wiring.setpoints:
        entries[f"{name}{SETPOINT}"] = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    return spaces.Dict(entries)


def meanings(wiring: Wiring) -> dict[str, dict[str, str]]:
    """Return unit and meaning of each entry and of the action, see `coil_rl.envs.meanings`."""
    found = {
        each.name: {"unit": each.unit or "not said", "meaning": each.meaning or each.name}
        for each in wiring.observations
    }
    for name in wiring.setpoints:
        found[f"{name}{SETPOINT}"] = {
            "unit": found[name]["unit"],
            "meaning": f"what {name} is to be in the next step",
        }
    parts = [each.name + (f" ({each.meaning})" if each.meaning else "") for each in wiring.actions]
    found["action"] = {
        "unit": ", ".join(each.unit or "not said" for each in wiring.actions),
        "meaning": ", ".join(parts),
    }
    return found
