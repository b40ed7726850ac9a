"""Steps of an env and its policy from tensors to tensors, with the numbers of TorchRL's steps.

TorchRL's step is for any env: it looks for keys, completes what an env leaves out, and carries all
that was written to the next step. With a small network this takes longer than a step of an env that
is known. `LeanSteps` is for those: it calls the env and its transforms directly, and carries only
what is read. All others keep TorchRL's step, see `LeanSteps.covers`. The advice of a network may
differ in the last bit, because it is computed in batches of another size.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.envs import Compose, EnvBase, RewardSum, Transform, TransformedEnv

from coil_rl.envs.seeded_env import SeededEnv
from coil_rl.learners.policy import Entries, Policy, by_key
from coil_rl.transforms.guide_transform import SeededGenerator
from coil_rl.transforms.link import Link

ENDS = {"done", "terminated", "truncated"}
# Rows up to which a step and the first entries of the next episodes are observed at once: the
# many small operations of a guide take as long for both together as for one of them.
AT_ONCE = 512


class LeanEnv:
    """The step of an env with its transforms, called directly.

    Args:
        env: for which `covers` is true.
    """

    def __init__(self, env: EnvBase) -> None:
        self.base = env.base_env if isinstance(env, TransformedEnv) else env
        self.batch_size, self.device = env.batch_size, env.device
        transforms = _transforms(env)
        self.links = [each for each in transforms if isinstance(each, Link)]
        self.sums = [each.out_keys[0] for each in transforms if isinstance(each, RewardSum)]

    @staticmethod
    def covers(env: EnvBase) -> bool:
        """Return whether the steps of an env have this form.

        They have if it is one of this project, and if its transforms are a sum of rewards and links
        that remember, record and draw nothing.
        """
        base = env.base_env if isinstance(env, TransformedEnv) else env
        return (
            isinstance(base, SeededEnv)
            and len(env.batch_size) == 1
            and (env.action_keys, env.reward_keys, set(env.done_keys))
            == (["action"], ["reward"], ENDS)
            and not list(base.state_spec.keys(True, True))
            and all(_is_known(each) for each in _transforms(env))
        )

    def step(self, action: Tensor, before: Mapping[NestedKey, Tensor] | TensorDictBase) -> Any:
        """Return the entries after a step.

        Args:
            before: entries before the step, of which the sums of rewards are read.
        """
        return self.observed(self.moved(action, before))

    def moved(self, action: Tensor, before: Mapping[NestedKey, Tensor] | TensorDictBase) -> Any:
        """Return what the env writes in a step, and the sums of rewards.

        Args:
            before: as for `step`.
        """
        # An env of this project reads its action by the key only; a dictionary is made at once.
        acted: Any = Entries(action=action)
        for link in reversed(self.links):
            link.act(acted, {})
        after = self.base._step(acted)
        for key in self.sums:
            after.set(key, before[key] + after["reward"])
        return after

    def observed(self, data: TensorDictBase) -> TensorDictBase:
        """Write the observations for entries of the env, and return all."""
        for link in self.links:
            link.observe(data, {})
        return data

    def data(self, entries: Mapping[NestedKey, Tensor]) -> TensorDict:
        """Return entries as data of the env."""
        return TensorDict(dict(entries), self.batch_size, device=self.device)


class LeanSteps:
    """Steps with resets of an env in which a policy acts.

    Args:
        env: for which `covers` is true.
        policy: of the same.
        keys: of the same.
    """

    def __init__(self, env: EnvBase, policy: Any, keys: Sequence[NestedKey]) -> None:
        self.env = LeanEnv(env)
        self.before = [key for key in keys if not _is_next(key)]
        self.after = {key: unravel_key(key[1:]) for key in keys if _is_next(key)}
        self.carried = [*_observed(policy, keys), *self.env.sums]
        links, known = self.env.links, set(self.env.base.observation_spec.keys(True, True))
        read = dict.fromkeys([*self.carried, *(key for link in links for key in link.in_keys)])
        self.read = [key for key in read if key in known]
        self.written = [key for link in links for key in link.out_keys]

    @staticmethod
    def covers(env: EnvBase, policy: Any, keys: Sequence[NestedKey] | None) -> bool:
        """Return whether the steps of an env and a policy have this form.

        They have if those of the env have, see `LeanEnv`, if the policy has none but modules of
        this project, and if all that it observes is written by the env.

        Args:
            keys: entries that are kept of each step; None: all.
        """
        return (
            keys is not None
            and isinstance(policy, Policy)
            and by_key(policy)
            and LeanEnv.covers(env)
            and set(_observed(policy, keys)) <= set(env.observation_spec.keys(True, True))
        )

    def carry(self, carrier: TensorDictBase) -> Entries:
        """Return what is read of the state of the env before a step."""
        return Entries({key: carrier[key] for key in self.carried})

    def step(self, entries: Entries) -> tuple[dict[NestedKey, Tensor], Entries]:
        """Take a step; return the entries to keep, and what is read in the next step.

        Args:
            entries: what is read in this step, and what the policy has written.
        """
        after = self.env.moved(entries["action"], entries)
        rows = after["done"].flatten().nonzero().flatten()
        first = self._begin(after, rows)
        kept = {key: entries[key] for key in self.before}
        kept |= {key: after[name] for key, name in self.after.items()}
        carried = self.carry(after)
        for key, value in first.items():
            carried[key] = carried[key].index_put((rows,), value)
        return kept, carried

    def _begin(self, after: TensorDictBase, rows: Tensor) -> dict[NestedKey, Tensor]:
        """Write the observations after a step, and begin new episodes in the rows that are done.

        Args:
            after: what the env has written in the step.
            rows: that are done, [K].

        Returns:
            What is read of the first steps of the new episodes, [K, ...].
        """
        if not len(rows):
            self.env.observed(after)
            return {}
        env, count = self.env, len(after)
        first = env.base._reset(env.data({"_reset": after["done"].clone()}))
        new = {key: first[key][rows] for key in self.read}
        if count > AT_ONCE:
            env.observed(after)
            count = 0
        else:
            new = {key: torch.cat([after[key], value]) for key, value in new.items()}
        data = env.observed(TensorDict(new, (count + len(rows),), device=env.device))
        if count:
            for key in self.written:
                after.set(key, data[key][:count])
        zero = {key: after[key].new_zeros(len(rows), 1) for key in env.sums}
        return {key: zero[key] if key in zero else data[key][count:] for key in self.carried}


def _transforms(env: EnvBase) -> list[Transform]:
    if not isinstance(env, TransformedEnv):
        return []
    return list(env.transform) if isinstance(env.transform, Compose) else [env.transform]


def _is_known(transform: Transform) -> bool:
    """Return whether a lean step does what a transform does."""
    if type(transform) is RewardSum:
        return list(transform.in_keys) == ["reward"]
    if not isinstance(transform, Link) or transform.needs_past or transform.passed:
        return False
    draws = any(isinstance(part, SeededGenerator) for part in transform.children())
    return not (draws or transform.state or transform.records)


def _observed(policy: Any, keys: Sequence[NestedKey]) -> list[NestedKey]:
    """Return the entries before a step that are read: what the policy does not write itself."""
    before = [key for key in keys if not _is_next(key)]
    read = dict.fromkeys([*policy.in_keys, *before])
    return [key for key in read if key not in policy.out_keys]


def _is_next(key: NestedKey) -> bool:
    return isinstance(key, tuple) and key[0] == "next"
