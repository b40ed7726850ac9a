"""Open-loop evaluation of policies on recordings.

The policies act at every scan of a drive that they did not control.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from coil_rl.envs import HISTORY, McapReplayEnv, Recording, recent_mean
from coil_rl.for_guests import progress

RECORDED = "recorded"  # name of the recorded commands among the policies
STEERING_KEYS = (("next", "steering"), ("next", "omega"), ("next", "info", "smoothness"))
VIEW_KEYS = ("cones", "cone_count", "observation", ("info", "valid"))

Floats = NDArray[np.float64]
# By name: the replay env with the transforms of the policy, and the policy. All share one replay
# env.
Policies = Mapping[str, tuple[EnvBase, TensorDictModuleBase]]


@dataclass(frozen=True)
class Steering:
    """Steering of one policy at each of N scans.

    Attributes:
        action: [N], the steering that reaches the robot, as a fraction of the maximum, positive to
            the left.
        omega: [N] radians/s, the turn rate at that steering.
        smoothness: [N], |a - a_avg|, as in the cone world.
    """

    action: Floats
    omega: Floats
    smoothness: Floats


@dataclass(frozen=True)
class OpenLoop:
    """Result for one recording of N scans.

    Attributes:
        recording: the recording.
        cones: [N, 2, K, 2] m in the scale of the cone world, in the car's frame, left side first.
        count: [N, 2], number of the cones.
        observation: [N, 20], see `coil_rl.envs.sight`.
        valid: [N, 2], whether each side is valid in the scan.
        steering: by policy; `recorded_steering` is last, as `RECORDED`, if there are commands.
        env: of the replay, without transforms.
    """

    recording: Recording
    cones: NDArray[np.float32]
    count: NDArray[np.int64]
    observation: NDArray[np.float32]
    valid: NDArray[np.bool_]
    steering: dict[str, Steering]
    env: McapReplayEnv

    @property
    def both_valid(self) -> NDArray[np.bool_]:
        """Whether both sides are valid, [N]."""
        return self.valid[:, 0] & self.valid[:, 1]

    @property
    def policies(self) -> list[str]:
        """Names of the policies, without `RECORDED`."""
        return [name for name in self.steering if name != RECORDED]


@torch.no_grad()
def open_loop(env: McapReplayEnv, policies: Policies, *, seed: int = 0) -> list[OpenLoop]:
    """Return the result of each recording of an env, in which each recording has a row.

    Each policy observes its own last action.

    Args:
        env: the env of the recordings, without transforms.
        policies: the policies by name, each with an env that has the transforms it needs.
        seed: of PyTorch's generator, set again for each policy.
    """
    scans = int(env.length.max())
    rollouts: dict[str, TensorDictBase] = {}
    with progress(total=scans * len(policies), unit="scan", desc="replay", leave=False) as bar:
        for name, (policy_env, policy) in policies.items():
            torch.manual_seed(seed)
            bar.set_postfix_str(name, refresh=False)
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                rollouts[name] = (
                    policy_env.eval()
                    .rollout(
                        scans,
                        policy.eval(),
                        callback=lambda *_: bar.update(),
                        break_when_any_done=False,
                    )
                    .cpu()
                )
            bar.update()
    return [_result(env, row, rollouts) for row in range(len(env.recordings))]


def _result(env: McapReplayEnv, row: int, rollouts: Mapping[str, TensorDictBase]) -> OpenLoop:
    recording = env.recordings[row]
    # A recording shorter than the longest one restarts; its first pass counts.
    steps = {name: rollout[row, : len(recording.ranges)] for name, rollout in rollouts.items()}
    steering: dict[str, Steering] = {}
    for name, step in steps.items():
        columns = [step[key].squeeze(-1).double().numpy() for key in STEERING_KEYS]
        steering[name] = Steering(*columns)
    if recording.commands is not None:
        car = env.speed, env.car_length, env.max_steering
        steering[RECORDED] = recorded_steering(recording, *car)
    view = next(iter(steps.values()))  # equal for all policies
    cones, count, observation, valid = (view[key].numpy() for key in VIEW_KEYS)
    return OpenLoop(recording, cones, count, observation, valid, steering, env)


def recorded_steering(
    recording: Recording, speed: float, car_length: float, max_steering: float
) -> Steering:
    """Return the recorded commands as steering, see `Recording.steering`.

    It is NaN where there is no command, and its smoothness compares with the last commands that
    there are.

    Args:
        speed: m/s of the robot, for a recording without speeds.
        car_length: length L of the robot, m.
        max_steering: radians of an action of 1.
    """
    angle, omega, _ = recording.steering(speed, car_length)
    action = (angle / max_steering).clip(-1, 1)
    known = ~np.isnan(action)
    given, smoothness = action[known], np.full(len(action), np.nan)
    before = np.concatenate([np.zeros(HISTORY), given[:-1]])
    history = np.lib.stride_tricks.sliding_window_view(before, HISTORY)[:, ::-1].T.copy()
    smoothness[known] = np.abs(given - recent_mean(torch.from_numpy(history)).numpy())
    return Steering(action, omega, smoothness)
