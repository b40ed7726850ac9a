"""Collection of experience: batches of consecutive steps of an env and a policy, and its noise."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.errors import UserError
from coil_rl.foreign.batch import optional_entries
from coil_rl.learners.policy import NOISE
from coil_rl.ranges import Share, checked
from coil_rl.run.lean_steps import LeanSteps
from coil_rl.transforms.chain import restore
from coil_rl.transforms.guide_transform import set_progress


class Rollout:
    """Batches of consecutive steps of all rows of an env. A row that is done is reset.

    Args:
        env: its transforms are set to training mode.
        policy: writes the action; actions are sampled.
        steps: T, length of a batch.
        keys: entries to keep, those after a step as `("next", ...)`; all by default.
        noise_correlation: of the noise of continuous actions in consecutive steps, at most 1. Each
            action alone has the distribution that the policy gives, see `Exploring`.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.guides import SplineGuide
        >>> env = ConeTrackEnv(shipped_tracks("train"), 8)
        >>> Rollout(env, SplineGuide(), steps=4).collect().shape
        torch.Size([8, 4])
    """

    def __init__(
        self,
        env: EnvBase,
        policy: TensorDictModuleBase,
        steps: int,
        keys: Sequence[NestedKey] | None = None,
        noise_correlation: float = 0.0,
    ) -> None:
        self.env, self.policy, self.steps = env.train(), policy, steps
        self.base_env = self.env.base_env if isinstance(self.env, TransformedEnv) else self.env
        self.keys = None if keys is None else list(dict.fromkeys(keys))
        optional = optional_entries(env)
        self.unchecked = [*optional, *(("next", *key) for key in optional)]
        self.lean: LeanSteps | None = None
        if self.keys is not None and LeanSteps.covers(env, policy, self.keys):
            self.lean = LeanSteps(env, policy, self.keys)
        self.acts = exploring(policy, env, noise_correlation)
        self.carrier: TensorDictBase | None = None
        self.taken = 0  # steps of each row

    @property
    def frames(self) -> int:
        """Number of frames in a batch, B * T."""
        return self.env.batch_size.numel() * self.steps

    @torch.no_grad()
    def collect(self, progress: float = 0.0) -> TensorDictBase:
        """Return the next batch, [B, T].

        `progress` is the finished share of the run, for the schedules of transforms.

        A number that is NaN or infinite is a `UserError` with its entry, step and row.
        """
        set_progress(self.env, progress)
        carrier = self.env.reset() if self.carrier is None else self.carrier
        columns: dict[NestedKey, list[Tensor]] = {}
        with set_exploration_type(ExplorationType.RANDOM):
            carrier = self._drive(carrier, columns)
        batch = self._stacked(columns)
        self._check(batch, 0)
        self.carrier = carrier
        self.taken += self.steps
        return batch

    def _check(self, batch: TensorDictBase, steps: int) -> None:
        """Check a batch [*B, T] that comes `steps` after the last one, see `check_batch`."""
        check_batch(batch.exclude(*self.unchecked), self.taken + steps)

    def _drive(
        self, first: TensorDictBase, columns: dict[NestedKey, list[Tensor]]
    ) -> TensorDictBase:
        """Take the steps of a batch, and return the data of the next one.

        If a step fails behind a number that is NaN or infinite, that number is the error.

        Args:
            first: data of the first step.
            columns: gets the entries of each step.
        """
        lean: Any = self.lean
        take = self.env.step_and_maybe_reset if lean is None else lean.step
        carrier = first if lean is None else lean.carry(first)
        try:
            for _ in range(self.steps):
                # The policy writes its action into the carrier.
                step, after = take(self.acts(carrier))
                for key in self.keys or step.keys(True, True):
                    columns.setdefault(key, []).append(step[key])
                carrier = after
        except Exception:
            self._check(self._stacked(columns), 0)
            failed = carrier if lean is None else lean.env.data(carrier)
            self._check(failed.unsqueeze(-1), max(map(len, columns.values()), default=0))
            raise
        return carrier if lean is None else lean.env.data(carrier)

    def _stacked(self, columns: Mapping[NestedKey, list[Tensor]]) -> TensorDictBase:
        time = len(self.env.batch_size)
        steps = min(map(len, columns.values()), default=0)
        batch = TensorDict({}, (*self.env.batch_size, steps), device=self.env.device)
        for key, column in columns.items():
            batch[key] = torch.stack(column[:steps], time)
        return batch

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the env and of the collection."""
        return {
            "env": self.base_env.state_dict(),
            "transforms": self.env.state_dict() if self.base_env is not self.env else {},
            "carrier": None if self.carrier is None else self.carrier.to_dict(),
            "noise": self.acts.last if isinstance(self.acts, Exploring) else None,
            "taken": self.taken,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned.

        New episodes begin where the env or a guide cannot go on with its own.
        """
        self.base_env.load_state_dict(state["env"])
        if self.base_env is not self.env:
            restore(self.env.transform, state["transforms"])
        carrier = state["carrier"]
        # A part that cannot go on has said so.
        continues = all(getattr(module, "continues", True) for module in self.env.modules())
        if (
            carrier is not None
            and not self.base_env.state_dict()
            and not self.base_env.state_spec.keys()
        ):
            continues, name = False, type(self.base_env).__name__
            warnings.warn(f"{name} does not save its state, so new episodes begin", stacklevel=2)
        if carrier is not None and continues:
            self.carrier = TensorDict.from_dict(
                carrier, batch_size=self.env.batch_size, device=self.env.device
            )
        if isinstance(self.acts, Exploring) and state["noise"] is not None:
            self.acts.last = state["noise"].to(self.env.device)
        self.taken = state["taken"]


def check_batch(batch: TensorDictBase, steps: int = 0) -> None:
    """Raise a `UserError` for the earliest number of a batch [*B, T] that is NaN or infinite.

    It has the entry, the step (from 1, after `steps` earlier ones) and the row (from 0). The check
    waits for the device once.
    """
    floats = {key: value for key, value in batch.items(True, True) if value.is_floating_point()}
    if not floats or torch.stack([value.isfinite().all() for value in floats.values()]).all():
        return
    errors = []
    for order, (key, value) in enumerate(floats.items()):
        if value.isfinite().all():
            continue
        rows = value.reshape(batch.shape[:-1].numel(), batch.shape[-1], -1)
        t, row = (~rows.isfinite()).any(-1).T.nonzero()[0].tolist()
        numbers = rows[row, t]
        path = (key,) if isinstance(key, str) else key
        # Entries before a step precede those after it.
        place = (t, path[0] == "next", order)
        errors.append((place, row, float(numbers[~numbers.isfinite()][0]), "/".join(path)))
    (t, _, _), row, number, name = min(errors)
    raise UserError(f"{name} is {number} at step {steps + t + 1} of row {row}")


class Exploring(TensorDictModuleBase):
    """A policy that samples its actions with noise that is correlated from step to step.

    Each number is `correlation` of the one before and a fresh part, so that each step alone is
    standard normal. Korenkevych et al. 2019; Hollenstein et al. 2024 (for PPO).

    Args:
        policy: writes the action.
        env: whose actions are sampled, numbers and not choices.
        correlation: of the numbers of consecutive steps, above 0 and at most 1.
        parts: number of policies that share the rows of the env; this one acts on its part.

    Attributes:
        last: the numbers of the last step, [rows, *action]; None before the first.
    """

    def __init__(
        self, policy: TensorDictModuleBase, env: EnvBase, correlation: float, parts: int = 1
    ) -> None:
        self.in_keys, self.out_keys = list(policy.in_keys), list(policy.out_keys)
        super().__init__()
        self.policy, self.correlation = policy, correlation
        spec = env.full_action_spec[env.action_key]
        self.shape = (spec.shape[0] // parts, *spec.shape[1:]) if parts > 1 else spec.shape
        self.dtype, self.device = spec.dtype, spec.device
        self.last: Tensor | None = None

    def forward(self, entries: Any) -> Any:
        """Draw the noise of the step, and write the action and what the policy remembers.

        Args:
            entries: a TensorDict or `Entries`, [rows].
        """
        numbers = torch.randn(self.shape, dtype=self.dtype, device=self.device)
        if self.last is not None:
            share = self.correlation
            numbers = share * self.last + (1 - share**2) ** 0.5 * numbers
        self.last = numbers
        return self.policy(entries.set(NOISE, numbers))


@checked
def exploring(
    policy: TensorDictModuleBase, env: EnvBase, noise_correlation: Share, parts: int = 1
) -> TensorDictModuleBase:
    """Return a policy with correlated noise; itself for choices, or without a correlation.

    Args:
        policy: writes the action.
        noise_correlation: of consecutive steps.
        parts: see `Exploring`.

    Raises:
        ValueError: if the correlation is below 0 or above 1.
    """
    if noise_correlation == 0 or not env.full_action_spec[env.action_key].dtype.is_floating_point:
        return policy
    return Exploring(policy, env, noise_correlation, parts)
