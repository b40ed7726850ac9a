"""What a machine is sent: the policy of a run as a controller, outside of any env.

A policy alone is not enough: its action may be a residual that is added to a guide's, it observes
advice, and it may have a memory. Here the whole chain of the run is applied to observations that
come from anywhere: guides, transforms, normaliser, policy, and what the transforms make of its
action. It is the chain of an evaluation, without the env and what disturbs it.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase, is_tensor_collection, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, ExplorationType, TransformedEnv, set_exploration_type

from coil_rl.foreign.gymnasium_env import GymnasiumEnv
from coil_rl.learners.anchor import rest_guides
from coil_rl.transforms import GuideActions
from coil_rl.transforms.chain import Chain, Past, restore


class Controller:
    """A trained policy as a controller: `act(observation)` returns the executed action.

    Actions are deterministic. Call `reset()` at the start of each episode.

    Args:
        env: env of one row with the transforms of the run. It gives the specs and converts
            observations and actions; it is never stepped. Its disturbances are taken off: a machine
            has its own delays and noise.
        policy: of the run, for this env.
        folder: of the run, if it has one.
        which: name of the policy in the folder, "handed_over" or "last".

    Example:
        >>> import coil_rl
        >>> controller = coil_rl.open_run("outputs/tank").controller()  # doctest: +SKIP
        >>> controller.reset()  # doctest: +SKIP
        >>> action = controller.act(observation)  # doctest: +SKIP
    """

    def __init__(
        self,
        env: EnvBase,
        policy: TensorDictModuleBase,
        folder: Path | None = None,
        which: str = "handed_over",
    ) -> None:
        if not isinstance(env, TransformedEnv) or env.batch_size.numel() != 1:
            raise ValueError(f"a controller needs an env of one row, not {list(env.batch_size)}")
        self.env, self.policy = env.eval(), policy
        self.plant, self.folder, self.which = env.base_env, folder, which
        plants = self.plant.held.plants if isinstance(self.plant, GymnasiumEnv) else []
        self.beside = [name for plant in plants[:1] for name in plant.controllers]
        rest_guides(policy, self.env, ())
        self.chain = Chain(self.env, policy)
        # Those that demonstrated are left out.
        links = [part for part in self.chain.links if isinstance(part, GuideActions)]
        parts = [part for part in links if not part.rests]
        self.guides = parts[0] if parts else None
        self.read = {unravel_key(key) for part in (policy, *parts) for key in part.in_keys}
        self._check_read()
        self.reset()

    def __deepcopy__(self, memo: Any) -> Controller:
        """Return a controller in an episode of its own, such as for another row of an env.

        The env that only converts is the same.
        """
        if self.beside:
            raise ValueError("a policy that reads a controller beside its env cannot be copied")
        outer = {id(self.env): None, id(self.plant): None}
        env = TransformedEnv(self.plant, copy.deepcopy(self.env.transform, outer))
        return Controller(env, copy.deepcopy(self.policy), self.folder, self.which)

    def reset(self) -> None:
        """Begin an episode: forget everything."""
        self.past: Past | None = None

    def act(self, observation: Any) -> Any:
        """Return the action for an observation.

        Args:
            observation: as the env gives it: for a Gymnasium env what its `reset` and `step`
                return; for a TorchRL env its entries as a mapping or TensorDict, or the value of
                the only entry, each without the batch dimension.

        Returns:
            The action in the env's own units and numbering: for a Gymnasium env what its `step`
            takes; for a TorchRL env an array of the action.

        Raises:
            ValueError: if the observation does not fit the env, or lacks what is read.
        """
        action = self.act_on(self._entries(observation))
        if isinstance(self.plant, GymnasiumEnv):
            return self.plant.decode(action)
        return action.reshape(action.shape[len(self.env.batch_size) :]).cpu().numpy()

    @torch.no_grad()
    def act_on(self, entries: TensorDictBase) -> Tensor:
        """Return the action for the entries of the env, as an entry of the env, [1, *A].

        Args:
            entries: what the env writes before the transforms of the run, [1].
        """
        # Transforms of others may look at these.
        self.plant._complete_done(self.plant.full_done_spec, entries)
        if self.past is not None:
            entries.update(self.plant.full_reward_spec.zero())
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            data, self.past = self.chain(entries, self.past)
        action: Tensor = data[self.env.action_key]
        return action

    def state_dict(self) -> dict[str, Any]:
        """Return what the next actions of the episode depend on, besides their observations."""
        past = None
        if self.past is not None:
            past = [[(key, _plain(value)) for key, value in own.items()] for own in self.past]
        return {"past": past, "transforms": copy.deepcopy(self.env.transform.state_dict())}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        past, batch = state["past"], self.env.batch_size
        self.past = None
        if past is not None:
            self.past = [{key: _restored(value, batch) for key, value in own} for own in past]
        restore(self.env.transform, state["transforms"])

    def _check_read(self) -> None:
        """Refuse a policy or guide that reads what is no part of an observation."""
        for key in self.read:
            if isinstance(key, tuple) and key[0] == "info":
                raise ValueError(
                    f"{'/'.join(key)} is read by the policy or its guide, but is no part of an "
                    "observation"
                )
        if self.beside:
            warnings.warn(
                f"the controller {', '.join(self.beside)} belongs to an env of its own, in which "
                "nothing happens: its advice is right only if it reads nothing but the observation",
                stacklevel=3,
            )

    def _entries(self, observation: Any) -> TensorDictBase:
        """Return the entries of the env for an observation, with the batch dimension."""
        if isinstance(self.plant, GymnasiumEnv):
            return self.plant.encode(observation, first=self.past is None)
        spec = self.plant.full_observation_spec
        entries = spec.zero()
        if not isinstance(observation, Mapping) and not is_tensor_collection(observation):
            (key, *others) = spec.keys(True, True)
            if others:
                names = ", ".join(map(str, (key, *others)))
                raise ValueError(f"this env has the entries {names}; give a mapping with them")
            observation = {key: observation}
        for key in spec.keys(True, True):
            value: Any = observation
            whole = isinstance(key, str) or key in list(observation.keys())
            for part in (key,) if whole else key:
                value = value.get(part, {}) if hasattr(value, "get") else {}
            if not isinstance(value, Mapping):
                _put(entries, key, value)
            elif key in self.read:
                raise ValueError(f"{key} is missing, which the policy or its guide reads")
            if key in self.read and not entries[key].isfinite().all():
                raise ValueError(f"{key} holds a number that is not finite")
        return entries


def _plain(value: Any) -> Any:
    return value.to_dict() if is_tensor_collection(value) else value


def _restored(value: Any, batch: torch.Size) -> Any:
    return TensorDict.from_dict(value, batch_size=batch) if isinstance(value, dict) else value


def _put(entries: TensorDictBase, key: Any, value: Any) -> None:
    """Set an entry of one row; raises a `ValueError` for a value of another size."""
    zero = entries[key]
    given = torch.as_tensor(np.asarray(value) if not isinstance(value, Tensor) else value)
    if given.shape != zero.shape[len(entries.batch_size) :]:
        expected = list(zero.shape[len(entries.batch_size) :])
        raise ValueError(f"{key} has the shape {list(given.shape)}, but must have {expected}")
    entries.set(key, given.to(zero).reshape(zero.shape))
