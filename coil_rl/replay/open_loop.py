"""Asks policies scan by scan what they would have steered, in a drive in which none of them steered."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.envs.recordings.reading import Recording
from coil_rl.envs.recordings.replay_env import McapReplayEnv
from coil_rl.envs.reward import HISTORY, recent_mean

RECORDED = "recorded"  # what the robot was told, as if it were one more policy
ANSWER = (("next", "steering"), ("next", "omega"), ("next", "info", "smoothness"))
SEEN = ("cones", "cone_count", "observation", ("info", "valid"))

Floats = NDArray[np.float64]
Times = NDArray[np.int64]
# By name, each in a replay env with the transforms that it needs; all of them around the same replay env.
Policies = Mapping[str, tuple[EnvBase, TensorDictModuleBase]]


@dataclass(frozen=True)
class Steering:
    """What one policy would have done after each of N scans.

    Attributes:
        action: [N], the steering that reaches the robot, as a fraction of the largest one; positive to the left.
        omega: [N] radians/s, how fast that turns the robot.
        smoothness: [N] |a - a_avg|, as in the simulation.
    """

    action: Floats
    omega: Floats
    smoothness: Floats


@dataclass(frozen=True)
class OpenLoop:
    """One recording of N scans, what was seen in it, and what policies would have done.

    Attributes:
        recording: it.
        cones: [N, 2, K, 2] m in the scale of the simulation, in the car's frame, left side first.
        count: [N, 2], how many of the K are real.
        observation: [N, 20], what an agent sees.
        valid: [N, 2], whether each side was seen in this scan.
        steering: by policy; `RECORDED` comes last, if the recording tells, and is NaN before the first command.
        largest: radians, of an action of 1.
    """

    recording: Recording
    cones: NDArray[np.float32]
    count: NDArray[np.int64]
    observation: NDArray[np.float32]
    valid: NDArray[np.bool_]
    steering: dict[str, Steering]
    largest: float

    @property
    def sighted(self) -> NDArray[np.bool_]:
        """In which scans both sides were seen, [N]."""
        return self.valid[:, 0] & self.valid[:, 1]

    @property
    def policies(self) -> list[str]:
        """The names of those who were asked."""
        return [name for name in self.steering if name != RECORDED]


@torch.no_grad()
def open_loop(
    replay: McapReplayEnv, policies: Policies, *, seed: int = 0, tick: Callable[[str], Any] | None = None
) -> list[OpenLoop]:
    """Ask each policy about each scan; it remembers its own last action, which nobody obeyed.

    Args:
        replay: without transforms; its recordings side by side.
        policies: at least one.
        seed: of PyTorch's generator, for each policy anew, so that nobody depends on who was asked before.
        tick: called after every scan with the policy's name.

    Returns:
        One for each recording.

    Example:
        >>> from coil_rl.guides import ZeroGuide
        >>> times, ones = np.arange(5) * 10**8, np.ones(5)
        >>> drive = Recording("drive", False, times, times, np.ones((5, 360), np.float32), ones * 360, -ones, ones / 60)
        >>> replay = McapReplayEnv(drive, lambda ranges, angles: (np.zeros((5, 2, 16, 2)), np.zeros((5, 2))))
        >>> [found] = open_loop(replay, {"straight on": (replay, ZeroGuide())})
        >>> found.steering["straight on"].omega.tolist()
        [0.0, 0.0, 0.0, 0.0, 0.0]
    """
    scans = int(replay.length.max())
    asked: dict[str, TensorDictBase] = {}
    for name, (env, policy) in policies.items():
        torch.manual_seed(seed)

        def after_scan(*_: Any, name: str = name) -> None:
            if tick is not None:
                tick(name)

        with set_exploration_type(ExplorationType.DETERMINISTIC):
            asked[name] = env.eval().rollout(scans, policy.eval(), callback=after_scan, break_when_any_done=False).cpu()
        after_scan()
    return [_of_recording(replay, row, asked) for row in range(len(replay.recordings))]


def _of_recording(replay: McapReplayEnv, row: int, asked: Mapping[str, TensorDictBase]) -> OpenLoop:
    recording = replay.recordings[row]
    # A recording that is over before the longest one starts again.
    own = {name: steps[row, : len(recording.ranges)] for name, steps in asked.items()}
    steering = {
        name: Steering(*(steps[key].squeeze(-1).double().numpy() for key in ANSWER)) for name, steps in own.items()
    }
    if recording.commands is not None:
        steering[RECORDED] = _recorded(*recording.commands, recording.log_time, replay.turn_rate, replay.max_steering)
    seen = next(iter(own.values()))  # which is the same for all
    cones, count, observation, valid = (seen[key].numpy() for key in SEEN)
    return OpenLoop(recording, cones, count, observation, valid, steering, replay.max_steering)


def _recorded(commands: Floats, since: Times, scans: Times, turn_rate: float, largest: float) -> Steering:
    """What the robot was told, as the steering with which it would have turned as fast at the speed of the replay.

    That is the first command between a scan and the next one, and where there is none the one before still holds.
    """
    after = np.searchsorted(since, scans)
    until = np.append(np.searchsorted(since, scans[1:]), len(since))
    holds = np.where(after < until, after, after - 1)
    omega = np.where(holds < 0, np.nan, commands[holds, 1])
    action = np.arcsin(np.clip(omega / turn_rate, -math.sin(largest), math.sin(largest))) / largest
    before = np.concatenate([np.zeros(HISTORY), action[:-1]])
    history = np.lib.stride_tricks.sliding_window_view(before, HISTORY)[:, ::-1].T.copy()
    return Steering(action, omega, np.abs(action - recent_mean(torch.from_numpy(history)).numpy()))
