"""The cone world as `coil_rl/ConeTrack-v0` of Gymnasium, one car or a batch.

Importing this module registers the id; `gymnasium.make("coil_rl.envs.gym:coil_rl/ConeTrack-v0")`
does both at once.
"""

import operator
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from coil_rl.envs.cone_track import ConeTrackEnv
from coil_rl.envs.level_files import Split, shipped_tracks
from coil_rl.envs.track import Track

ID = "coil_rl/ConeTrack-v0"

Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]


class ConeTrackVectorGym(VectorEnv[Floats, Floats, NDArray[Any]]):
    """A batch of cars as a `gymnasium.vector.VectorEnv`.

    A car is reset in the step that ends its episode. One seed determines the tracks of all cars: it
    is the one of `reset`, or an option `seed`.

    Args:
        num_envs: B, the number of cars.
        tracks: the tracks, or "train", "test" or "all" of the shipped tracks.
        advice: a guide; its action is appended to the observation, as COIL needs. None for no
            advice.
        options: any other argument of `ConeTrackEnv`. They are not spelt out, because
            `gymnasium.make` passes on whatever it is given.

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
        if isinstance(tracks, str):
            tracks = shipped_tracks(tracks)
        self.num_envs, self.advice = num_envs, advice
        self._seeded = "seed" in options
        self._state: TensorDictBase | None = None  # of all cars
        self.env = ConeTrackEnv(tracks, num_envs, **options)
        numbers = self.env.observation_spec["observation"].shape[-1] + (advice is not None)
        self.single_observation_space = Box(-1.0, 1.0, (numbers,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    @torch.no_grad()
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Put cars on the starts of newly drawn tracks.

        Args:
            seed: determines all draws of all cars from now on; None to go on drawing.
            options: `reset_mask`, flags [B], is of the cars that are reset; by default all are. The
                others stay as they are.

        Returns:
            Observations [B, 20] or, with advice, [B, 21]; and the entries of `info`, [B] or [B, n].

        Raises:
            ValueError: for a list of seeds, a mask that does not fit, and another option.
        """
        mask = _reset_mask(options, self.num_envs)
        seed = _one_seed(seed)
        first = self._np_random is None and not self._seeded
        super().reset(seed=seed)
        if first or seed is not None:
            self.env.set_seed((self.np_random_seed or 0) % 2**63)
            self._seeded = True
        if mask is None or self._state is None:
            state = self.env.reset()
        else:
            chosen = torch.from_numpy(mask).to(self.env.device).unsqueeze(-1)
            state = self.env.reset(self._state.copy().set("_reset", chosen))
        self._state = state
        return self.observe(state), _info(state)

    @torch.no_grad()
    def step(self, actions: Floats) -> tuple[Floats, NDArray[Any], Flags, Flags, dict[str, Any]]:
        """Drive one step and reset the cars whose episode ended.

        Args:
            actions: [B, 1], steering angles as a fraction of 80 degrees.

        Returns:
            Observations, rewards, terminated, truncated and info, of all cars; the last observation
            and info of an ended episode are in `final_obs` and `final_info`.
        """
        step, state = self.env.step_and_maybe_reset(self.action(actions))
        after = step["next"]
        reward, terminated, truncated = (
            _numpy(after[k].squeeze(-1)) for k in ("reward", "terminated", "truncated")
        )
        self._state = state
        done = terminated | truncated
        final: dict[str, Any] = {}
        if done.any():
            last = np.full(self.num_envs, None, dtype=object)
            last[done] = np.fromiter(self.observe(after[after["done"].squeeze(-1)]), dtype=object)
            final = {
                "final_obs": last,
                "final_info": _info(after),
                "_final_obs": done,
                "_final_info": done,
            }
        return self.observe(state), reward, terminated, truncated, _info(state) | final

    def action(self, actions: Floats) -> TensorDict:
        """Return actions as the input of `env`."""
        tensor = torch.as_tensor(actions, dtype=self.env.dtype_, device=self.env.device)
        return TensorDict({"action": tensor.reshape(-1, 1)}, self.env.batch_size)

    def observe(self, state: TensorDictBase) -> Floats:
        """Return the observations of a state, with the advice appended."""
        observation = state["observation"]
        if self.advice is not None:
            advice = self.advice(state.select(*self.advice.in_keys))["action"]
            observation = torch.cat([observation, advice], -1)
        return _numpy(observation.float())


class ConeTrackGym(gymnasium.Env[Floats, Floats]):
    """One car as a `gymnasium.Env`.

    Args:
        tracks: the tracks, or "train", "test" or "all" of the shipped tracks.
        options: any other argument of `ConeTrackVectorGym`, such as `advice`.

    Example:
        >>> import gymnasium
        >>> env = gymnasium.make("coil_rl.envs.gym:coil_rl/ConeTrack-v0", tracks="test")
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape, info["lap"]
        ((20,), 0)
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  as Gymnasium declares it

    def __init__(self, tracks: Split | Sequence[Track] = "train", **options: Any) -> None:
        self.cars = ConeTrackVectorGym(1, tracks, **options)
        self.observation_space = self.cars.single_observation_space
        self.action_space = self.cars.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Put the car on the start of a newly drawn track.

        Args:
            seed: determines all draws from now on; None to go on drawing.
            options: none are known.
        """
        seed = _one_seed(seed)
        super().reset(seed=seed)
        observation, info = self.cars.reset(seed=seed, options=options)
        return observation[0], _first_row(info)

    @torch.no_grad()
    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Drive one step."""
        state = self.cars.env.step(self.cars.action(action))["next"]
        reward, terminated, truncated = (
            state[key].item() for key in ("reward", "terminated", "truncated")
        )
        return self.cars.observe(state)[0], reward, terminated, truncated, _first_row(_info(state))


def _reset_mask(options: dict[str, Any] | None, cars: int) -> NDArray[np.bool_] | None:
    """Return the mask of the cars that are reset, [B]; None for all."""
    others = sorted(set(options or {}) - {"reset_mask"})
    if others:
        raise ValueError(f"options has {', '.join(others)}, but can only hold reset_mask")
    if not options or options["reset_mask"] is None:
        return None
    mask = np.asarray(options["reset_mask"])
    if mask.dtype != np.bool_ or mask.shape != (cars,) or not mask.any():
        raise ValueError(
            f"reset_mask must be {cars} flags, one a car, at least one of them true; it is "
            f"{mask.tolist()}"
        )
    return mask.copy()


def _one_seed(seed: Any) -> int | None:
    """Return a seed as a whole number; None for none."""
    try:
        return None if seed is None else operator.index(seed)
    except TypeError as error:
        raise ValueError(
            f"seed={seed!r} must be one whole number: it determines the draws of all cars; to seed "
            "a car alone, reset it with options={'reset_mask': MASK}"
        ) from error


def _numpy(tensor: torch.Tensor) -> NDArray[Any]:
    return np.array(tensor.cpu().numpy())  # a copy


def _info(state: TensorDictBase) -> dict[str, Any]:
    """Return `info` as nested arrays, [B] or [B, n]; empty for an env without it."""
    if "info" not in state:
        return {}
    return state["info"].apply(lambda entry: entry.squeeze(-1).cpu().clone()).numpy()


def _first_row(info: dict[str, Any]) -> dict[str, Any]:
    """Return the first car's entries, scalars as Python numbers."""
    rows: dict[str, Any] = {}
    for key, entry in info.items():
        if isinstance(entry, dict):
            rows[key] = _first_row(entry)
        elif np.ndim(entry) > 1:
            rows[key] = entry[0]
        else:
            rows[key] = entry[0].item()
    return rows


if ID not in gymnasium.registry:
    gymnasium.register(
        ID,
        entry_point=f"{__name__}:ConeTrackGym",
        vector_entry_point=f"{__name__}:ConeTrackVectorGym",
    )
