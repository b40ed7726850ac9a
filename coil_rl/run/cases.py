"""The cases of a training in which policies are compared; their steps are frames."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from coil_rl.envs.seeded_env import SeededEnv
from coil_rl.measures import Measure
from coil_rl.output import progress
from coil_rl.run.evaluation import Totals, episodes
from coil_rl.transforms import GuideActions

SEEDS = 2**31  # seeds of cases are below


@dataclass(eq=False)
class TrainingCases:
    """Cases of a training in which policies are compared, the `Cases` of its learner.

    They are drawn as the episodes of the training are. All policies act in them one after the other
    in an env of the same seed, so a difference of two returns is that of the policies.

    Args:
        build: makes an env of a number of rows.
        frames: of the whole run.
        seed: of the cases.

    Attributes:
        steps: that all comparisons have taken so far.
        calls: number of actions that guides were asked for.
    """

    build: Callable[[int], EnvBase]
    frames: int
    seed: int = 0
    steps: int = field(default=0, init=False)
    calls: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self.generator = torch.Generator().manual_seed(self.seed)
        self.env: EnvBase | None = None
        self.env_seed = 0

    def begin(self) -> None:
        """Begin a comparison: forget the env of the one before, of which nothing may be left."""
        self.env = None

    def renew(self, count: int, copies: int = 1) -> None:
        """Draw that many new cases.

        Args:
            count: number of cases.
            copies: number of rows that have each case; row i has case `i % count`. Only an env
                for which `can_copy` holds has more than one.
        """
        self.env_seed = int(torch.randint(SEEDS, (), generator=self.generator))
        self._build(count * copies)
        seeded = seeded_env(self.env)
        if seeded is not None:
            seeded.different = count if copies > 1 else None

    def can_copy(self) -> bool:
        """Return whether several rows of the env can have the same case."""
        if self.env is None:
            self._build(1)
        return seeded_env(self.env) is not None

    def _build(self, rows: int) -> None:
        """Make the env with that many rows, unless it has them."""
        if self.env is None or self.env.batch_size.numel() != rows:
            with torch.random.fork_rng():
                self.env = self.build(rows)

    @torch.no_grad()
    def returns(self, policy: Callable[..., Any], *, sampled: bool = False) -> Tensor:
        """Return the return of a policy in each of the present cases, [C]."""
        if self.env is None:
            raise RuntimeError("there are no cases yet; call renew first")
        totals = Totals({"return": Measure("episode_reward", "last")})
        before = guide_calls(self.env)
        with (
            torch.random.fork_rng(),
            progress(unit="step", desc="test", leave=False, mininterval=0.5) as bar,
        ):
            self.env.set_seed(self.env_seed)
            torch.manual_seed(self.env_seed)
            for after, running in episodes(self.env, policy, sampled=sampled, tick=bar.update):
                totals.add(after, running)
        self.steps += int(totals.steps.sum())
        self.calls += guide_calls(self.env) - before
        return totals.results()["return"]

    def state_dict(self) -> dict[str, Any]:
        """Return what later comparisons depend on."""
        return {"generator": self.generator.get_state(), "steps": self.steps, "calls": self.calls}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.generator.set_state(state["generator"])
        self.steps, self.calls = state["steps"], state["calls"]


def seeded_env(env: EnvBase | None) -> SeededEnv | None:
    """Return the env below all transforms, if its rows can begin alike; None for another env."""
    base = env.base_env if isinstance(env, TransformedEnv) else env
    return base if isinstance(base, SeededEnv) else None


def guide_calls(env: EnvBase) -> int:
    """Return the number of actions that the guides of an env have been asked for."""
    return sum(part.calls for part in env.modules() if isinstance(part, GuideActions))
