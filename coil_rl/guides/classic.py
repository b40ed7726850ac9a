"""Public controllers of well-known envs of Gymnasium, to compare with.

They are what a user of such an env would find first: heuristics that Gymnasium ships, textbook
feedback, a planner. Those that are functions work on a whole batch and are chosen by the name of
`ClassicGuide`. The others are objects with a state, one for each row of the env.
"""

import importlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from functools import partial
from typing import Any, Literal

import gymnasium
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import TensorDictPrimer

from coil_rl.ranges import checked
from coil_rl.transforms.guide_memory import primer_of


def lander(observation: Tensor, continuous: bool = False) -> Tensor:
    """Land in LunarLander-v3, as Gymnasium's `lunar_lander.heuristic` does.

    Args:
        observation: [*batch, 8].
        continuous: whether the env has continuous actions.

    Returns:
        The index of an engine, [*batch], and with `continuous` the power of both engines,
        [*batch, 2].
    """
    x, y, speed, climb_rate, angle, spin, left_leg, right_leg = observation.unbind(-1)
    touches = (left_leg != 0) | (right_leg != 0)
    turn = ((0.5 * x + speed).clamp(-0.4, 0.4) - angle) * 0.5 - spin
    turn = turn.masked_fill(touches, 0.0)
    climb = torch.where(touches, -climb_rate * 0.5, (0.55 * x.abs() - y) * 0.5 - climb_rate * 0.5)
    if continuous:
        return torch.stack([climb * 20 - 1, -turn * 20], -1).clamp(-1, 1)
    side = (turn > 0.05).long() + 3 * (turn < -0.05).long()
    return side.masked_fill((climb > turn.abs()) & (climb > 0.05), 2)


def energy_pump(observation: Tensor, power: float = 1.0) -> Tensor:
    """Push the car of MountainCarContinuous-v0 in the direction of its motion.

    Args:
        observation: [*batch, 2].
        power: of the push, from -1 to 1. A negative power brakes, so that the car never leaves the
            valley.

    Returns:
        The power with its sign, [*batch, 1].
    """
    speed = observation[..., 1:]
    return torch.where(speed < 0, -power, power).to(observation)


def swing_up(observation: Tensor, gain: float = 5.0) -> Tensor:
    """Swing Pendulum-v1 up by its energy, and hold it there by linear feedback.

    Args:
        observation: [*batch, 3].
        gain: torque per joule of missing energy.

    Returns:
        The torque, [*batch, 1].
    """
    cos, sin, speed = observation.unbind(-1)
    # J, to the energy at rest at the top: m g l / 2 = 5, inertia 1 / 3.
    missing = 5 * (1 - cos) - speed.square() / 6
    pump = gain * missing * torch.where(speed < 0, -1.0, 1.0)
    hold = -(10 * torch.atan2(sin, cos) + 2 * speed)
    return torch.where(cos > 0.9, hold, pump).clamp(-2, 2).unsqueeze(-1)


def linear_feedback(observation: Tensor, weights: Sequence[float] = (0.1, 0.3, 1.0, 0.5)) -> Tensor:
    """Balance CartPole-v1 by the sign of a weighted sum.

    Args:
        observation: [*batch, 4], position, speed, angle and spin.
        weights: of these four numbers.

    Returns:
        The index of a direction, [*batch].
    """
    return ((observation * observation.new_tensor(weights)).sum(-1) > 0).long()


def swing_tip(observation: Tensor) -> Tensor:
    """Swing the links of Acrobot-v1 up: push the joint between them the way it turns.

    Args:
        observation: [*batch, 6]; the last number is the spin of the second link.

    Returns:
        The index of a torque, [*batch].
    """
    return 2 * (observation[..., 5] > 0).long()


FUNCTIONS: dict[str, Callable[..., Tensor]] = {
    each.__name__: each for each in (lander, energy_pump, swing_up, linear_feedback, swing_tip)
}


@checked
class ClassicGuide(TensorDictModuleBase):
    """Guide that acts by one of the functions above.

    Args:
        controller: name of the function.
        options: arguments of the function after the observation, by name.
    """

    in_keys, out_keys = ["observation"], ["action"]

    def __init__(
        self,
        controller: Literal["lander", "energy_pump", "swing_up", "linear_feedback", "swing_tip"],
        options: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.function = partial(FUNCTIONS[controller], **(options or {}))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        return tensordict.set("action", self.function(tensordict["observation"]))


class Oscillator(TensorDictModuleBase):
    """Guide of Swimmer-v5: sines that its two joints follow.

    The number of the step is its memory. It is due to Raffin et al. (2024), An open-loop baseline
    for reinforcement learning locomotion tasks.

    Args:
        frequency: Hz; 0.3 is detuned, and slow.
        phases: of both joints, as a fraction of a turn.
        amplitude: radians.
        kp: torque per radian of missing angle.
        kd: torque per radian/s.
    """

    in_keys, out_keys = ["observation", "swum_steps"], ["action", ("next", "swum_steps")]
    time_step = 0.04  # s, of the env

    def __init__(
        self,
        frequency: float = 0.62,
        phases: Sequence[float] = (0.0, 0.95),
        amplitude: float = 1.0,
        kp: float = 10.0,
        kd: float = 0.5,
    ) -> None:
        super().__init__()
        self.frequency, self.phases, self.amplitude = frequency, list(phases), amplitude
        self.kp, self.kd = kp, kd

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write both torques, and the number of the next step."""
        observation, step = tensordict["observation"], tensordict["swum_steps"]
        turns = step * (self.frequency * self.time_step) + observation.new_tensor(self.phases)
        missing = self.amplitude * torch.sin(2 * torch.pi * turns) - observation[..., 1:3]
        action = (self.kp * missing - self.kd * observation[..., 6:8]).clamp(-1, 1)
        return tensordict.set("action", action).set(("next", "swum_steps"), step + 1)

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Declare the number of the step as memory."""
        return primer_of({"swum_steps": torch.zeros(1, dtype=torch.int64)})


class Walker:
    """Controller of BipedalWalker-v3: the state machine `BipedalWalkerHeuristics` of Gymnasium.

    `PerRow` makes it a guide.
    """

    memory = ("state", "moving_leg", "supporting_leg", "supporting_knee_angle")

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        from gymnasium.envs.box2d.bipedal_walker import BipedalWalkerHeuristics

        self.machine = BipedalWalkerHeuristics()

    def act(self, observation: Any) -> Any:
        """Return the torques, [4], for an observation [24]."""
        # In float64 the state consists of plain numbers.
        return self.machine.step_heuristic(observation.astype(float))

    def state_dict(self) -> dict[str, float]:
        """Return the state of the machine."""
        return {name: float(getattr(self.machine, name)) for name in self.memory}

    def load_state_dict(self, state: Mapping[str, float]) -> None:
        """Restore the state of the machine."""
        for name, value in state.items():
            setattr(self.machine, name, value if name == "supporting_knee_angle" else int(value))


class LastAction(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Wrapper of a BabyAI env that remembers its `last_action` for `Bot`.

    It also makes levels without printing.

    Args:
        env: the env.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.last_action: Any = None

    def reset(self, **options: Any) -> Any:
        """Begin an episode."""
        self.last_action = None
        with redirect_stdout(None):
            return super().reset(**options)

    def step(self, action: Any) -> Any:
        """Take a step."""
        self.last_action = action
        return super().step(action)


class Bot:
    """Controller that solves BabyAI levels by the planner of MiniGrid, `BabyAIBot`.

    It knows the whole level, and plans again after actions of others. When one opens a box it can
    no longer help, and in a few levels of Unlock it plans without end: from then on it advises
    `done`.

    Args:
        env: a BabyAI env with the wrapper `LastAction`.
    """

    searches = 100  # in one step; usually there are at most 5

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        module, most = importlib.import_module("minigrid.utils.baby_ai_bot"), self.searches

        class Bounded(module.BabyAIBot):  # type: ignore[name-defined]
            def _breadth_first_search(self, *arguments: Any, **options: Any) -> Any:
                if self.bfs_counter >= most:
                    raise module.DisappearedBoxError("it plans without end")
                return super()._breadth_first_search(*arguments, **options)

        self.env, self.make, self.lost = env, Bounded, module.DisappearedBoxError

    def reset(self) -> None:
        """Begin an episode."""
        self.bot: Any = self.make(self.env)

    def act(self, observation: Any) -> int:
        """Return the index of an action."""
        try:
            if self.bot is not None:
                self.bot.bfs_counter = 0
                return int(self.bot.replan(self.env.get_wrapper_attr("last_action")))
        except self.lost:
            self.bot = None
        return int(self.env.unwrapped.actions.done)  # type: ignore[attr-defined]
