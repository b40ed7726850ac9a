"""Imitation of a guide: offline (paper algorithm 6) and by data-set aggregation, DAgger (algorithm 7).

The guide is asked in every state of a batch, whoever acted there, and what it says is added to a data set. On all of
that a regressor is fitted anew. One batch in which the guide acted makes this behavioural cloning, offline imitation
learning; several, in which the guide acts less and less, make it DAgger: the later batches hold the states into which
the policy itself gets.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from coil_rl.errors import UserError
from coil_rl.imitation import dataset as folders
from coil_rl.imitation.regressor import Regressor
from coil_rl.imitation.validation import cross_validated, scores
from coil_rl.learners.networks import Joined, Keyed
from coil_rl.transforms.action_space import ActionSpace


class Imitation:
    """The learner of imitation: a policy that does what a guide would do.

    Args:
        env: for the shapes of what is observed, advised and done.
        in_keys: what the policy observes.
        regressor: what is to learn; a `fresh` one does.
        advice_key: the entry [*batch, n_guides, A] with what the guides say of this very state.
        guide: whose row of it is learned.
        group_key: the entry that says on which track a car is, for the validation; None, or an env that has no such
            entry, leaves that part of it out.
        validate: also fit on parts of the data and test on the rest, which takes several times as long.
        dataset: a folder of `coil_rl.imitation.dataset.save` to begin with.
        seed: of the random split of the validation.

    Attributes:
        policy: writes the action that the regressor predicts, brought within the action's bounds; before the first
            update it predicts 0.
        keys: what a batch must hold.
        dataset: everything gathered, [N] with the observed entries, `action` (what the guide said) and the track.

    Raises:
        KeyError: if the env has no such advice or observation, naming what it has.
        ValueError: if there is no such guide.
        UserError: if the folder holds no data set, or one of another env.

    Example:
        >>> from sklearn.linear_model import LinearRegression
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.guides import SplineGuide
        >>> from coil_rl.imitation import Sklearn
        >>> from coil_rl.train.rollout import Rollout
        >>> from coil_rl.transforms import GuideActions
        >>> env = ConeTrackEnv(shipped_tracks("train"), num_cars=7, assignment="cyclic")
        >>> env = TransformedEnv(env, GuideActions({"middle": SplineGuide()}))
        >>> learner = Imitation(env, regressor=Sklearn(LinearRegression()))
        >>> metrics = learner.update(Rollout(env, learner.policy, steps=20, keys=learner.keys).collect())
    """

    kind = "imitation"

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[str] = ("observation",),
        *,
        regressor: Regressor,
        advice_key: str = "guide_action",
        guide: int = 0,
        group_key: str | Sequence[str] | None = ("info", "track"),
        validate: bool = True,
        dataset: str | os.PathLike[str] | None = None,
        seed: int = 0,
    ) -> None:
        spec, batch = env.observation_spec, len(env.batch_size)
        self.joined = Joined(env, in_keys)
        if advice_key not in spec.keys(True, True):
            known = [key for key in spec.keys(True, True) if isinstance(key, str)]
            raise KeyError(
                f"the env has no entry {advice_key} to imitate; it has {', '.join(known)}: put the transform "
                "GuideActions around it"
            )
        guides, size = spec[advice_key].shape[batch:]
        if not 0 <= guide < guides:
            raise ValueError(f"guide={guide} must be at least 0 and less than {guides}, the number of guides")
        if not 0 <= seed < 2**32:
            raise ValueError(f"seed={seed} must be at least 0 and at most {2**32 - 1}")
        self.regressor = regressor.fresh(self.joined.width, size).to(env.device)
        self.policy = Keyed(
            _Action(self.joined, self.regressor, ActionSpace(env.action_spec, batch)), in_keys, ["action"]
        )
        self.in_keys, self.advice_key, self.guide = list(in_keys), advice_key, guide
        self.group_key = _known(group_key, spec)
        self.keys: list[NestedKey] = [*in_keys, advice_key, *([] if self.group_key is None else [self.group_key])]
        self.validate, self.seed, self.device = validate, seed, env.device
        self.dataset: TensorDictBase | None = None
        if dataset is not None:
            self.dataset = self._fitting(folders.load(dataset), dataset, env)

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Add what the guide says of a batch to the data set, and fit the regressor anew.

        Args:
            batch: [*B, T] with `keys`.
            progress: not used.

        Returns:
            `samples` of the data set; `target_variance`, the mean squared error of always predicting the mean;
            `mse_ahead` and `r2_ahead`, of this batch before it is learned from: where the policy itself drove, that is
            how well it does what the guide would; `mse_training` and `r2_training`, of the samples learned from; with
            `validate`, what `cross_validated` says.

        Raises:
            UserError: if the data cannot be validated.
        """
        pairs = self._pairs(batch)
        dataset: TensorDictBase = pairs if self.dataset is None else torch.cat([self.dataset, pairs])
        self.dataset = dataset
        x, y = self.joined(*(dataset[key] for key in self.in_keys)), dataset["action"]
        metrics = {"samples": float(len(y)), "target_variance": float(y.var(0, correction=0).mean())}
        with torch.no_grad():
            ahead = self.regressor(self.joined(*(pairs[key] for key in self.in_keys)))
            metrics |= scores([ahead], [pairs["action"]], "ahead")
        if self.validate:
            groups = None if self.group_key is None else dataset[self.group_key].reshape(-1)
            metrics |= cross_validated(self.regressor, x, y, groups, self.seed)
        self.regressor.fit(x, y)
        with torch.no_grad():
            return metrics | scores([self.regressor(x)], [y], "training")

    def export(self, folder: Path) -> None:
        """Leave the data set as `dataset` in the folder of a run, for others to begin with."""
        if self.dataset is not None and not (folder / "dataset").exists():
            folders.save(self.dataset, folder / "dataset")

    def _pairs(self, batch: TensorDictBase) -> TensorDictBase:
        data = batch.select(*self.keys).reshape(-1)
        pairs = data.select(*(key for key in self.keys if key != self.advice_key or key in self.in_keys))
        return pairs.set("action", data[self.advice_key][:, self.guide])

    def _fitting(self, dataset: TensorDictBase, folder: str | os.PathLike[str], env: EnvBase) -> TensorDictBase:
        """A data set that was read, if it can be added to."""
        wanted = self._pairs(env.fake_tensordict())
        for key in wanted.keys(True, True):
            shape = dataset[key].shape[1:] if key in dataset.keys(True, True) else None
            if shape != wanted[key].shape[1:]:
                raise UserError(
                    f"{folder} holds data of another env: {key} is {'missing' if shape is None else list(shape)}, "
                    f"but {list(wanted[key].shape[1:])} is wanted; give another, or none"
                )
        return dataset.select(*wanted.keys(True, True)).to(env.device)

    def state_dict(self) -> dict[str, Any]:
        """Everything an update depends on besides the batch."""
        return {
            "policy": self.policy.state_dict(),
            "dataset": None if self.dataset is None else self.dataset.to_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over a state of `state_dict`."""
        self.policy.load_state_dict(state["policy"])
        entries = state["dataset"]
        if entries is not None:
            entries = TensorDict.from_dict(entries, batch_size=entries["action"].shape[:1])
            entries = entries.to(self.device)
        self.dataset = entries


class _Action(nn.Module):
    """What a regressor says of the observed entries, as an action that the env takes."""

    def __init__(self, joined: Joined, regressor: Regressor, space: ActionSpace) -> None:
        super().__init__()
        self.joined, self.regressor, self.space = joined, regressor, space

    def forward(self, *inputs: Tensor) -> Tensor:
        """[*batch, ...] each to the action: [*batch, A], or [*batch] where it is a number of a finite set."""
        return self.space.actions(self.space.clamp(self.regressor(self.joined(*inputs))))


def _known(key: str | Sequence[str] | None, spec: TensorSpec) -> NestedKey | None:
    """The key as TensorDict takes it, if the env has it."""
    if key is None:
        return None
    nested = key if isinstance(key, str) else tuple(key)
    return nested if nested in spec.keys(True, True) else None
