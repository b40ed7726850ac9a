"""Base classes of transforms that use advice, or draw, and a generator with a saved state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypedDict

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Composite
from torchrl.envs import EnvBase

from coil_rl.ranges import Index, checked
from coil_rl.transforms.action_space import ActionTransform, nested_key
from coil_rl.transforms.link import Link, State

Schedule = Callable[[float], float]


class GuideSettings(TypedDict, total=False):
    """Arguments that every transform that uses advice takes as `GuideTransform` does."""

    guide: Index
    action_key: NestedKey
    advice_key: NestedKey


@checked
class GuideTransform(ActionTransform):
    """Base class of transforms that use the advice observed by the agent.

    Place them after `GuideActions`. Call `env.train()` or `env.eval()` before the first step, with
    any collector. In evaluation a schedule returns its final value, and changes that serve learning
    only are off. In training, `set_progress` moves the schedules.

    Args:
        guide: row of the advice, the index of the guide.
        action_key: entry of the env's action.
        advice_key: entry of the advice, [*batch, n_guides, A].
    """

    written: tuple[str, ...] = ()  # entries that the transform adds
    # Name of the parameter that changes rewards or transitions, empty if there is none. If it is a
    # schedule, stored transitions become invalid during the run.
    mdp_parameter: str = ""

    def __init__(
        self,
        guide: Index = 0,
        action_key: NestedKey = "action",
        advice_key: NestedKey = "guide_action",
    ) -> None:
        self.action_key, self.advice_key = nested_key(action_key), nested_key(advice_key)
        super().__init__(in_keys=[self.advice_key], out_keys=list(self.written))
        self.guide = guide
        # Completed fraction of the run, for schedules; see `set_progress`.
        self.progress: float | None = None
        self._mode_is_set = False

    def train(self, mode: bool = True) -> GuideTransform:
        """Set the mode: training, or evaluation."""
        super().train(mode)
        # TorchRL calls `eval` itself on a transform that it is about to put into an env: only one
        # that is a part of its env already was told by somebody that this is an evaluation.
        whole = getattr(self.container, "transform", None)
        is_part = whole is not None and any(self is part for part in whole.modules())
        self._mode_is_set = mode or is_part
        return self

    @property
    def learns(self) -> bool:
        """Whether the env is used for training; RuntimeError while the mode is not set."""
        if not self._mode_is_set:
            raise RuntimeError(
                f"{type(self).__name__} acts in training only: call env.train() or env.eval() "
                "first, on the env that has the transform; for an env inside SerialEnv or "
                "ParallelEnv in the function that makes it"
            )
        return self.training

    def current(self, value: float | Schedule) -> float:
        """Return the current value of a number or a schedule.

        A schedule in training before `set_progress` is a RuntimeError.
        """
        if not callable(value):
            return value
        if not self.learns:
            return value(1.0)
        if self.progress is None:
            raise RuntimeError(
                f"{type(self).__name__} has a schedule, but nothing tells it the progress of the "
                "run: call coil_rl.transforms.set_progress(env, FRACTION) before each batch; for "
                "SerialEnv or ParallelEnv put the transform around it, not inside"
            )
        return value(self.progress)

    def advice(self, tensordict: TensorDictBase) -> Tensor:
        """Return the advice of the guide, [*batch, A]."""
        return tensordict[self.advice_key][..., self.guide, :]

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add what is written; raises a `KeyError` if the env does not write this advice."""
        check_advised(observation_spec, self)
        return super().transform_observation_spec(observation_spec)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return stored data unchanged."""
        return tensordict


def check_advised(observation_spec: Composite, reader: Any) -> None:
    """Raise a `KeyError` if an env does not write the advice that something reads.

    Args:
        observation_spec: of the env.
        reader: has an `advice_key`, and a `guide`, its row of the advice.
    """
    spec = observation_spec.get(reader.advice_key, None)
    if spec is None or reader.guide >= spec.shape[-2]:
        found = "no advice" if spec is None else f"advice of {spec.shape[-2]} guides"
        raise KeyError(
            f"{type(reader).__name__} reads row {reader.guide} of {reader.advice_key}, but there "
            f"is {found}; put GuideActions with enough guides before it"
        )


def set_progress(env: EnvBase, progress: float) -> None:
    """Set the finished share of the run, for the schedules of all transforms of an env.

    Args:
        env: the env, in this process.
        progress: from 0 to 1.
    """
    for module in env.modules():
        if isinstance(module, GuideTransform):
            module.progress = progress


class SeededGenerator(nn.Module):
    """Random generator on the CPU with its state in `state_dict()`.

    Args:
        seed: of the generator.

    Attributes:
        different: number of rows that draw; row i gets what row `i % different` draws, so that
            rows of one case, in which different policies act, get the same numbers. None: all rows
            draw.
    """

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.generator = torch.Generator().manual_seed(seed)
        self.different: int | None = None

    def sample(self, sample: Callable[..., Tensor], shape: Sequence[int], dim: int = 0) -> Tensor:
        """Draw random numbers for all rows.

        Args:
            sample: draws a tensor of a shape with a generator, such as `torch.randn`.
            dim: of `shape`, whose places are the rows.
        """
        if self.different is None:
            return sample(*shape, generator=self.generator)
        few = sample(*shape[:dim], self.different, *shape[dim + 1 :], generator=self.generator)
        return few.index_select(dim, torch.arange(shape[dim]) % self.different)

    def draw(
        self, sample: Callable[..., Tensor], shapes: Sequence[torch.Size], *, after_reset: bool
    ) -> list[Tensor]:
        """Draw a tensor of each shape, for a step or for the state after a partial reset.

        A step draws two of each and uses the first. A partial reset uses the second of the next
        step, without advancing the generator: later draws then do not depend on when other rows are
        reset.

        Args:
            sample: draws a tensor of a shape with a generator, such as `torch.randn`.
            after_reset: whether this is a partial reset.
        """
        state = self.generator.get_state() if after_reset else None
        draws = [self.sample(sample, (2, *shape), dim=1) for shape in shapes]
        if state is not None:
            self.generator.set_state(state)
        return [pair[int(after_reset)] for pair in draws]

    def get_extra_state(self) -> Tensor:
        """Return the state of the generator."""
        return self.generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the generator."""
        self.generator.set_state(state.cpu())


class DrawingLink(Link):
    """Base class of links that change their `in_keys` by random numbers, drawn anew at each step.

    The state in `observe` is one number for each number of these entries, by their keys.
    """

    _sample: Callable[..., Tensor] = staticmethod(torch.randn)  # of a shape, with a generator
    rng: SeededGenerator

    def first(self, data: TensorDictBase, reset: TensorDictBase | None = None) -> State:
        """Draw the numbers of the first step, see `SeededGenerator.draw`."""
        return self._drawn(data, after_reset=reset is not None and "_reset" in reset)

    def sent(self, data: TensorDictBase, state: State) -> State:
        """Draw the numbers of the next step."""
        return self._drawn(data)

    def _drawn(self, data: TensorDictBase, *, after_reset: bool = False) -> State:
        shapes = [self._entry(data, key).shape for key in self.in_keys]
        draws = self.rng.draw(self._sample, shapes, after_reset=after_reset)
        return dict(zip(self.in_keys, draws, strict=True))
