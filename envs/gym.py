"""The cone world for other libraries: `coil_rl/ConeTrack-v0` of Gymnasium, one car or a batch of them.

Importing this module registers the id; `gymnasium.make("coil_rl.envs.gym:coil_rl/ConeTrack-v0")` does both at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from coil_rl.envs.cone_track import ConeTrackEnv
from coil_rl.envs.level_files import Split, shipped_tracks
from coil_rl.envs.sight import SAMPLES
from coil_rl.envs.track import Track

try:
    import gymnasium
except ImportError as error:
    raise ImportError("coil_rl.envs.gym needs Gymnasium: python -m pip install 'coil-rl[gym]'") from error
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

ID = "coil_rl/ConeTrack-v0"

Floats = NDArray[np.float32]


class _Cars:
    """A batch of cars with NumPy on its outside.

    Args:
        tracks: where to drive, or which of the shipped tracks.
        num_cars: B.
        advice: a guide whose action is appended to the observation.
        options: of `ConeTrackEnv`.
    """

    def __init__(
        self,
        tracks: Split | Sequence[Track],
        num_cars: int,
        advice: TensorDictModuleBase | None,
        options: dict[str, Any],
    ) -> None:
        tracks = shipped_tracks(tracks) if isinstance(tracks, str) else tracks
        self.env, self.advice = ConeTrackEnv(tracks, num_cars, **options), advice
        self.observation_space = Box(-1.0, 1.0, (4 * SAMPLES + (advice is not None),), np.float32)
        self.action_space = Box(-1.0, 1.0, (1,), np.float32)

    @torch.no_grad()
    def reset(self, mask: torch.Tensor | None = None) -> TensorDictBase:
        return self.env._reset(None if mask is None else TensorDict({"_reset": mask}, self.env.batch_size))

    @torch.no_grad()
    def step(self, actions: Floats) -> TensorDictBase:
        action = torch.as_tensor(actions, dtype=self.env.dtype_, device=self.env.device).reshape(-1, 1)
        return self.env._step(TensorDict({"action": action}, self.env.batch_size))

    @torch.no_grad()
    def observe(self, state: TensorDictBase) -> Floats:
        seen = state["observation"]
        if self.advice is not None:
            seen = torch.cat([seen, self.advice(state.select(*self.advice.in_keys))["action"]], -1)
        return _numpy(seen).astype(np.float32, copy=False)


def _numpy(tensor: torch.Tensor) -> NDArray[Any]:
    # A copy, for whoever keeps an array does not expect it to be the env's own state.
    array: NDArray[Any] = tensor.cpu().numpy().copy()
    return array


def _info(state: TensorDictBase) -> dict[str, Any]:
    """What the env wrote under `info`; empty where it was told not to."""
    return _arrays(state["info"]) if "info" in state else {}


def _arrays(info: TensorDictBase) -> dict[str, Any]:
    """[B] or, for vectors, [B, n] each, nested as the env nests them."""
    return {k: _arrays(v) if isinstance(v, TensorDictBase) else _numpy(v.squeeze(-1)) for k, v in info.items()}


def _of_one(info: dict[str, Any]) -> dict[str, Any]:
    """The first car's part, scalars as plain Python numbers."""
    return {k: _of_one(v) if isinstance(v, dict) else v[0].item() if v[0].ndim == 0 else v[0] for k, v in info.items()}


class ConeTrackGym(gymnasium.Env[Floats, Floats]):
    """One car as a `gymnasium.Env`. For more than a few, `ConeTrackVectorGym` is many times faster.

    `info` holds what `ConeTrackEnv` writes there: `lap`, `lap_time`, `crashed`, `clearance`, `smoothness`, `track`,
    `pose` and the terms of the reward. A seed given to `reset` decides which tracks are drawn from then on.

    Args:
        tracks: where to drive, or "train", "test" or "all" of the shipped tracks.
        advice: a guide; its action becomes the 21st number of the observation, which is all that COIL takes.
        options: any other argument of `ConeTrackEnv`.

    Example:
        >>> import gymnasium
        >>> env = gymnasium.make("coil_rl.envs.gym:coil_rl/ConeTrack-v0", tracks="test")
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape, info["lap"]
        ((20,), 0)
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  as Gymnasium declares it

    def __init__(
        self,
        tracks: Split | Sequence[Track] = "train",
        advice: TensorDictModuleBase | None = None,
        **options: Any,
    ) -> None:
        self.cars = _Cars(tracks, 1, advice, options)
        self.observation_space, self.action_space = self.cars.observation_space, self.cars.action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        """Put the car on the start of a newly drawn track."""
        first = self._np_random is None
        super().reset(seed=seed)
        if first or seed is not None:
            self.cars.env.set_seed(self.np_random_seed % 2**63)
        state = self.cars.reset()
        return self.cars.observe(state)[0], _of_one(_info(state))

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Drive for one step."""
        state = self.cars.step(action)
        ends = (bool(state[key]) for key in ("terminated", "truncated"))
        return self.cars.observe(state)[0], float(state["reward"]), *ends, _of_one(_info(state))


class ConeTrackVectorGym(VectorEnv[Floats, Floats, NDArray[Any]]):
    """Cars side by side as a `gymnasium.vector.VectorEnv`, all of them in one batch of tensors.

    A car that is done starts anew in the same step: `final_obs` and `final_info` of `info` then say how it ended, for
    the rows of `_final_obs` and `_final_info`. One seed decides about the tracks of all cars.

    Args:
        num_envs: B.
        tracks: as for `ConeTrackGym`, like the other two.
        advice: a guide whose action is appended to the observation.
        options: any other argument of `ConeTrackEnv`.

    Example:
        >>> import gymnasium
        >>> envs = gymnasium.make_vec("coil_rl.envs.gym:coil_rl/ConeTrack-v0", num_envs=64)
        >>> envs.reset(seed=0)[0].shape
        (64, 20)
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012  as Gymnasium declares it

    def __init__(
        self,
        num_envs: int = 1,
        tracks: Split | Sequence[Track] = "train",
        advice: TensorDictModuleBase | None = None,
        **options: Any,
    ) -> None:
        self.num_envs, self.cars = num_envs, _Cars(tracks, num_envs, advice, options)
        self.single_observation_space, self.single_action_space = self.cars.observation_space, self.cars.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        """Put all cars on the starts of newly drawn tracks."""
        first = self._np_random is None
        super().reset(seed=seed)
        if first or seed is not None:
            self.cars.env.set_seed((self.np_random_seed or 0) % 2**63)
        state = self.cars.reset()
        return self.cars.observe(state), _info(state)

    def step(
        self, actions: Floats
    ) -> tuple[Floats, NDArray[Any], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Drive for one step and put the cars that are done back on a start."""
        after = state = self.cars.step(actions)
        reward, terminated, truncated = (_numpy(after[k].squeeze(-1)) for k in ("reward", "terminated", "truncated"))
        done = terminated | truncated
        ends: dict[str, Any] = {}
        if done.any():
            rows = after["done"].squeeze(-1)
            last = np.full(self.num_envs, None, dtype=object)
            last[done] = np.fromiter(self.cars.observe(after[rows]), dtype=object, count=int(done.sum()))
            ends = {"final_obs": last, "final_info": _info(after)} | dict.fromkeys(("_final_obs", "_final_info"), done)
            fresh = self.cars.reset(after["done"])
            state = after.select(*fresh.keys()).clone()
            state[rows] = fresh[rows]
        return self.cars.observe(state), reward, terminated, truncated, _info(state) | ends


if ID not in gymnasium.registry:
    gymnasium.register(ID, entry_point=f"{__name__}:ConeTrackGym", vector_entry_point=f"{__name__}:ConeTrackVectorGym")
