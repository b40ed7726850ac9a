"""Imitation of a guide: offline (OIL, paper algorithm 6) and by DAgger (algorithm 7).

The guide's action in every state of a batch is added to a data set, and a regressor is fitted to
the whole data set. One batch in which the guide acted gives behavioural cloning, offline imitation
learning. Several batches in which the guide acts less and less give DAgger: later batches hold the
states that the policy itself reaches.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from coil_rl.errors import UserError
from coil_rl.imitation.regressors import Regressor
from coil_rl.imitation.validation import cross_validate, scores
from coil_rl.learners.encoders import ConcatObservations
from coil_rl.learners.learner import Learner
from coil_rl.learners.networks import FastTensorDictModule
from coil_rl.ranges import Index, Interval, checked
from coil_rl.run import checkpoint
from coil_rl.transforms.action_space import ActionSpace, nested_key
from coil_rl.transforms.guide_transform import check_advised


@checked
class Imitation(Learner):
    """The imitation learner.

    Args:
        env: the env with its transforms, for its specs.
        in_keys: entries that the policy observes.
        regressor: specification of the regressor; its `fresh` copy is fitted.
        advice_key: entry with the advice in a state, [*batch, n_guides, A].
        guide: row of the advice, the index of the guide to imitate.
        group_key: entry with the track of a sample, for the validation on unseen tracks. None, or
            an entry that the env does not have, skips that validation.
        kept_key: entry that says which samples are learned, such as the scans of a recording with a
            recent command. None, or an entry that the env does not have, keeps all.
        validate: whether to validate in each update, which takes several more fits.
        dataset: file of a data set to start from, `dataset.pt` of another run; None to start
            without.
        seed: of the random split of the validation, below 2^32.

    Raises:
        KeyError: for an env without such advice or observation.
        ValueError: for a seed out of range.
        UserError: for a data set that is missing, damaged or of another env.

    Attributes:
        policy: writes the prediction of the regressor, clamped to the bounds of the action; 0
            before the first update.
        keys: entries that a batch must have.
        dataset: [N] with the observed entries, `action` (of the guide) and the track.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.guides import SplineGuide
        >>> from coil_rl.imitation import LinearRegressor
        >>> from coil_rl.run.rollout import Rollout
        >>> from coil_rl.transforms import GuideActions
        >>> env = ConeTrackEnv(shipped_tracks("train"), num_envs=7, assignment="cyclic")
        >>> env = TransformedEnv(env, GuideActions({"middle": SplineGuide()}))
        >>> learner = Imitation(env, regressor=LinearRegressor())
        >>> rollout = Rollout(env, learner.policy, steps=20, keys=learner.keys)
        >>> metrics = learner.update(rollout.collect())
    """

    kind: ClassVar[str] = "imitation"

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        regressor: Regressor,
        advice_key: str = "guide_action",
        guide: Index = 0,
        group_key: str | Sequence[str] | None = ("info", "track"),
        kept_key: str | Sequence[str] | None = ("info", "usable"),
        validate: bool = True,
        dataset: str | os.PathLike[str] | None = None,
        seed: Annotated[int, Interval(ge=0, le=2**32 - 1)] = 0,
    ) -> None:
        in_keys = [nested_key(key) for key in in_keys]
        spec, batch_dims = env.observation_spec, len(env.batch_size)
        available = list(spec.keys(True, True))
        self.in_keys, self.advice_key, self.guide = list(in_keys), advice_key, guide
        check_advised(spec, self)
        _, size = spec[advice_key].shape[batch_dims:]
        self.concat = ConcatObservations(env, in_keys)
        self.regressor = regressor.fresh(self.concat.width, size).to(env.device)
        action = _Action(self.concat, self.regressor, ActionSpace(env.action_spec, batch_dims))
        self.policy = FastTensorDictModule(action, in_keys, ["action"])
        group: NestedKey | None = nested_key(group_key)
        self.group_key = group if group in available else None
        kept: NestedKey | None = nested_key(kept_key)
        self.kept_key = kept if kept in available else None
        self.sample_keys: list[NestedKey] = [*in_keys, advice_key]
        if self.group_key is not None:
            self.sample_keys.append(self.group_key)
        self.keys: list[NestedKey] = list(self.sample_keys)
        if self.kept_key is not None:
            self.keys.append(self.kept_key)
        self.validate, self.seed, self.device = validate, seed, env.device
        self.validates_groups = validate and self.group_key is not None
        self.dataset: TensorDictBase | None = None
        if dataset is not None:
            self.dataset = self._load(Path(dataset), env)

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Add the guide's actions in a batch to the data set, and fit the regressor to it.

        Args:
            batch: [*B, T] with the entries `keys`.
            progress: of the run; ignored.

        Returns:
            The number of `samples`, and with `kept_key` of the steps that were `left_out`;
            `target_variance`, the mean squared error of predicting the
            mean; `mse_ahead` and `r2_ahead`, on this batch before the fit, if anything in it is to
            be learned; `mse_training` and `r2_training`, on the data set after the fit; with
            `validate`, the metrics (and errors) of `cross_validate`.

        Raises:
            UserError: if nothing is to be learned in this batch and all before.
        """
        pairs = self._pairs(batch)
        dataset: TensorDictBase = pairs
        if self.dataset is not None:
            dataset = torch.cat([self.dataset, pairs])
        if not len(dataset):
            raise UserError(
                f"none of {batch.numel()} steps is to be learned: {self.kept_key} is false at all "
                "of them"
            )
        self.dataset = dataset
        x, y = self.concat(*(dataset[key] for key in self.in_keys)), dataset["action"]
        metrics = {
            "samples": float(len(y)),
            "left_out": float(batch.numel() - len(pairs)),
            "target_variance": float(y.var(0, correction=0).mean()),
        }
        metrics |= self._ahead(pairs)
        if self.validate:
            groups = None if self.group_key is None else dataset[self.group_key].reshape(-1)
            metrics |= cross_validate(self.regressor, x, y, groups, self.seed)
        self.regressor.fit(x, y)
        with torch.no_grad():
            return metrics | scores([self.regressor(x)], [y], "training")

    def export(self, folder: Path) -> None:
        """Save the data set as `dataset.pt` in the folder of a run."""
        if self.dataset is not None:
            checkpoint.save(self.dataset.to_dict(), folder / "dataset.pt")

    def _pairs(self, batch: TensorDictBase) -> TensorDictBase:
        """Return the samples of a batch: what the policy observes and the action of the guide."""
        rows = batch.select(*self.keys).reshape(-1)
        if self.kept_key is not None:
            rows = rows[rows[self.kept_key].reshape(-1)]
        kept = [key for key in self.sample_keys if key != self.advice_key or key in self.in_keys]
        pairs = rows.select(*kept)
        return pairs.set("action", rows[self.advice_key][:, self.guide])

    @torch.no_grad()
    def _ahead(self, pairs: TensorDictBase) -> dict[str, float]:
        """Return the scores on samples before they are learned, if there are any."""
        if not len(pairs):
            return {}
        predicted = self.regressor(self.concat(*(pairs[key] for key in self.in_keys)))
        return scores([predicted], [pairs["action"]], "ahead")

    def _load(self, file: Path, env: EnvBase) -> TensorDictBase:
        """Load the entries of a data set that this learner needs."""
        if not file.is_file():
            raise UserError(f"there is no data set {file}; give the dataset.pt of a run")
        dataset = _from_dict(checkpoint.load(file))
        expected = self._pairs(env.fake_tensordict())
        keys, known = list(expected.keys(True, True)), dataset.keys(True, True)
        for key in keys:
            needed = list(expected[key].shape[1:])
            found = list(dataset[key].shape[1:]) if key in known else "missing"
            if found != needed:
                raise UserError(
                    f"{file} is a data set of another env: {key} is {found}, but must be {needed}; "
                    "give another data set, or none"
                )
        return dataset.select(*keys).to(env.device)

    def state_dict(self) -> dict[str, Any]:
        """Return everything the next update depends on besides its batch."""
        dataset = None if self.dataset is None else self.dataset.to_dict()
        return {"policy": self.policy.state_dict(), "dataset": dataset}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from `state_dict`."""
        self.policy.load_state_dict(state["policy"])
        self.dataset = None
        if state["dataset"] is not None:
            self.dataset = _from_dict(state["dataset"]).to(self.device)


def _from_dict(entries: dict[str, Any]) -> TensorDictBase:
    """Return the entries of a data set as a TensorDict [N]."""
    return TensorDict.from_dict(entries, batch_size=entries["action"].shape[:1])


class _Action(nn.Module):
    """Prediction of a regressor for the observed entries, as an action of the env."""

    def __init__(
        self, concat: ConcatObservations, regressor: Regressor, space: ActionSpace
    ) -> None:
        super().__init__()
        self.concat, self.regressor, self.space = concat, regressor, space

    def forward(self, *inputs: Tensor) -> Tensor:
        """Map inputs [*batch, ...] to actions [*batch, A], or [*batch] for categorical actions."""
        return self.space.actions(self.space.clamp(self.regressor(self.concat(*inputs))))
