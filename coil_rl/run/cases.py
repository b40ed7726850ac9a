"""The cases of a training in which policies are compared; their steps are frames."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from coil_rl.envs.seeded_env import SeededEnv
from coil_rl.learners.learner import Stateful
from coil_rl.measures import Measure
from coil_rl.output import progress
from coil_rl.run.evaluation import Totals, episodes
from coil_rl.run.parts import SOME_ROWS
from coil_rl.run.policy_batch import Acting, OnRows, traced
from coil_rl.run.rollout import exploring
from coil_rl.transforms import GuideActions
from coil_rl.transforms.chain import memory_keys
from coil_rl.transforms.guide_transform import SeededGenerator

SEEDS = 2**31  # seeds of cases are below
LEAST_CASES = 2  # of a comparison: a placebo may give a row the advice of another row
MOST_CASES = 32  # of the test at the end


@dataclass(eq=False)
class TrainingCases(Stateful):
    """Cases of a training in which policies are compared, the `Cases` of its learner.

    They are drawn as the episodes of the training are. All policies act in them from the same seed,
    so a difference of two returns is that of the policies.

    Args:
        build: makes an env of a number of rows.
        frames: of the whole run.
        seed: of the cases.
        noise_correlation: of the noise of sampled actions in consecutive steps, as in the
            `Rollout` of the training.

    Attributes:
        steps: that all comparisons have taken so far.
        taken: of these the steps of each policy in the last comparison.
        episodes: number of all episodes so far.
        longest: number of steps of the longest episode so far, of this process.
        calls: number of actions that guides were asked for.
        guide_ahead: whether a guide that is not held was better in every case of the start test.
        taught: what learns from the steps of compared policies, and the entries that it needs.
    """

    parts: ClassVar = ("generator", "steps", "episodes", "calls", "guide_ahead")

    build: Callable[[int], EnvBase]
    frames: int
    seed: int = 0
    noise_correlation: float = 0.0

    def __post_init__(self) -> None:
        self.steps = self.episodes = self.longest = self.calls = 0
        self.guide_ahead = False
        self.taught: tuple[Sequence[NestedKey], Callable[[TensorDictBase], Any]] | None = None
        self.generator = torch.Generator().manual_seed(self.seed)
        self.env: EnvBase | None = None
        self.env_seed, self.count = 0, 0
        self.taken: list[int] = []

    def teach(self, keys: Sequence[NestedKey], learn: Callable[[TensorDictBase], Any]) -> None:
        """Let something learn from the steps of compared policies."""
        self.taught = keys, learn

    def begin(self) -> None:
        """Begin a comparison: forget the env of the one before, of which nothing may be left."""
        self.env = None

    def renew(self, count: int) -> None:
        """Draw that many new cases.

        An env with their rows is made when a policy acts in them.
        """
        self.env_seed = int(torch.randint(SEEDS, (), generator=self.generator))
        self.count = count
        if self.env is None:
            self._build(count)

    def blocks(self, first: int, frames: int) -> Iterator[int]:
        """Yield the number of new cases of each part of a test, as long as its frames allow.

        Args:
            first: number of the first part, which has at least `LEAST_CASES`.
            frames: that the test may take.
        """
        begun, done, count = self.steps, 0, first
        while count >= LEAST_CASES:
            yield count
            done += count
            count = further_cases(done, self.steps - begun, frames)

    def can_copy(self) -> bool:
        """Return whether several rows of the env can have the same case."""
        env = self._build(SOME_ROWS) if self.env is None else self.env
        return isinstance(env.base_env if isinstance(env, TransformedEnv) else env, SeededEnv)

    def env_of(self, parts: int) -> EnvBase:
        """Return the env with some rows for each of the present cases; row i is case `i % count`.

        Args:
            parts: number of rows for each case. Only an env for which `can_copy` holds has more
                than one.
        """
        return self._build(self.count * parts)

    def _build(self, rows: int) -> EnvBase:
        """Return the env with that many rows; it is made unless it has them."""
        if self.env is None or self.env.batch_size.numel() != rows:
            with torch.random.fork_rng():
                self.env = self.build(rows)
        return self.env

    def compared(
        self, policies: Sequence[TensorDictModuleBase], sampled: Sequence[bool] | None = None
    ) -> list[Tensor]:
        """Return the returns of policies in the present cases, [C] each.

        They act side by side in the rows of one env, if its rows can have the same case and no
        policy has a memory, and else one after the other.

        Args:
            sampled: whether each samples its actions, as in training; None: none does.
        """
        sampled = [False] * len(policies) if sampled is None else sampled
        noise = [self.noise_correlation if samples else 0.0 for samples in sampled]
        each, parts = list(zip(policies, sampled, noise, strict=True)), len(policies)
        if parts > 1 and self._can_act_beside(policies):
            env = self.env_of(parts)
            beside = [
                Acting(exploring(traced(policy), env, correlation, parts), samples)
                for policy, samples, correlation in each
            ]
            totals = self._acted(env, OnRows(beside))
            self.taken = [int(part.sum()) for part in totals.steps.split(self.count)]
            return list(totals.results()["return"].split(self.count))
        env = self.env_of(1)
        alone = [
            self._acted(env, exploring(policy, env, correlation), sampled=samples)
            for policy, samples, correlation in each
        ]
        self.taken = [int(totals.steps.sum()) for totals in alone]
        return [totals.results()["return"] for totals in alone]

    def _can_act_beside(self, policies: Sequence[TensorDictModuleBase]) -> bool:
        """Return whether policies can act side by side in one env."""
        return (
            self.can_copy()
            and self.env is not None
            and self.env.action_key == "action"
            and not any(memory_keys(policy) for policy in policies)
        )

    def returns(self, policy: TensorDictModuleBase, parts: int = 1) -> Tensor:
        """Return the return of a policy in each row of the present cases, [rows].

        Args:
            parts: see `env_of`.
        """
        return self._acted(self.env_of(parts), policy).results()["return"]

    def _acted(
        self, env: EnvBase, policy: TensorDictModuleBase, *, sampled: bool = False
    ) -> Totals:
        """Return the totals of a policy in the rows of the present cases, and count its steps."""
        keys, learn = ((), None) if self.taught is None else self.taught
        steps: list[TensorDictBase] = []
        totals = Totals({"return": Measure(unravel_key(env.reward_key), "sum")})
        calls = guide_calls(env)
        with (
            torch.no_grad(),
            torch.random.fork_rng(),
            progress(unit="step", desc="test", leave=False, mininterval=0.5) as bar,
        ):
            env.set_seed(self.env_seed)
            for number, part in enumerate(env.modules()):
                if isinstance(part, SeededGenerator):  # of a transform: the env does not seed it
                    part.generator.manual_seed(self.env_seed + number)
            torch.manual_seed(self.env_seed)
            options: Any = {"sampled": sampled, "cases": self.count, "tick": bar.update}
            for before, after, running in episodes(env, policy, **options):
                totals.add(after, running)
                if learn is not None:
                    steps.append(before.exclude("next").set("next", after).select(*keys).clone())
        if learn is not None:
            learn(torch.stack(steps, -1))
        self.steps += int(totals.steps.sum())
        self.episodes += totals.steps.numel()
        self.longest = max(self.longest, int(totals.steps.max()))
        self.calls += guide_calls(env) - calls
        return totals


def further_cases(done: int, taken: int, frames: int) -> int:
    """Return how many further cases a test has, if their episodes are as long as those so far.

    They are not more than those so far, because their episodes may be longer.

    Args:
        taken: steps of their episodes.
        frames: that the test may take.
    """
    return min(int(frames * done / taken), MOST_CASES, 2 * done) - done


def guide_calls(env: EnvBase) -> int:
    """Return the number of actions that the guides of an env have been asked for."""
    return sum(part.calls for part in env.modules() if isinstance(part, GuideActions))
