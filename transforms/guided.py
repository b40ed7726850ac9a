"""What transforms have in common that put a guide's advice to use themselves."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import Transform

from coil_rl.transforms.action_space import ActionSpace

Schedule = Callable[[float], float]


class Guided(Transform):
    """Reads the advice that the agent saw when it chose its action, so `GuideActions` must stand before it.

    As TorchRL does it, an env's transforms evaluate until `env.train()` is called. In evaluation a schedule has the
    value that it ends with, and whatever is there for learning only is off.

    Args:
        out_keys: the entries it writes.
        guide: which row of the advice.
        action_key: of the action.
        advice_key: of the advice, [*batch, n_guides, A].

    Attributes:
        progress: share of the run that is over, for the schedules; whoever trains sets it.
        alters: the name of the number by which it alters what an action leads to or pays; empty if it only has a say in
            who acts. Where that number follows a schedule, steps of the past say what is no longer so.
    """

    alters: str = ""

    def __init__(
        self,
        out_keys: Sequence[NestedKey] = (),
        *,
        guide: int = 0,
        action_key: NestedKey = "action",
        advice_key: NestedKey = "guide_action",
    ) -> None:
        if guide < 0:
            raise ValueError(f"guide={guide} must be at least 0: it is a row of the advice")
        super().__init__(in_keys=[], out_keys=list(out_keys))
        self.guide, self.action_key, self.advice_key = guide, action_key, advice_key
        self.progress = 0.0
        self._space: ActionSpace | None = None

    def now(self, value: float | Schedule) -> float:
        """A number as it is, a schedule's value at this point of the run."""
        if not callable(value):
            return value
        return value(self.progress if self.training else 1.0)

    def advice(self, tensordict: TensorDictBase) -> Tensor:
        """[*batch, A]."""
        advice: Tensor = tensordict[self.advice_key]
        return advice[..., self.guide, :]

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """See that there is advice.

        Raises:
            KeyError: if nobody writes it, or not so many rows of it.
        """
        spec = observation_spec.get(self.advice_key, None)
        if spec is None or self.guide >= spec.shape[-2]:
            what = "no advice" if spec is None else f"{spec.shape[-2]} of them"
            raise KeyError(
                f"{type(self).__name__} reads row {self.guide} of {self.advice_key}, but there is {what}; "
                "put GuideActions with that many guides before it"
            )
        return observation_spec

    @property
    def space(self) -> ActionSpace:
        """The env's actions.

        Raises:
            RuntimeError: outside an env.
        """
        if self._space is None:
            if self.parent is None:
                raise RuntimeError(f"{type(self).__name__} works inside a TransformedEnv only")
            self._space = ActionSpace(self.parent.full_action_spec[self.action_key], self.parent.batch_dims)
        return self._space

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leave stored data as they are."""
        return tensordict

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict
