"""The fixed cases of the training in which candidate policies are evaluated between updates."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from tqdm import tqdm

from coil_rl.learners.learner import CaseResults
from coil_rl.report.measures import Measure
from coil_rl.run.evaluation import Totals, episodes
from coil_rl.run.policy_batch import policy_batch
from coil_rl.transforms.action_space import random_action

RANDOM_SEED = 0  # of random actions: the same ones at each call


@dataclass(frozen=True)
class SelectionCases:
    """The cases of a run in which policies are selected, the `Cases` of its learner.

    Args:
        policy: of the learner; copies of it act.
        build: makes an env with all cases for each of a number of policies; takes that number and
            the number of cases.
        count: C, number of cases.
        failure: measure that is true for an episode that failed; None: no episode fails.
    """

    policy: TensorDictModuleBase
    build: Callable[[int, int], EnvBase]
    count: int
    failure: Measure | None = None

    def take(self, count: int) -> "SelectionCases":
        """Return that many cases."""
        return replace(self, count=count)

    def evaluate(self, states: Sequence[dict[str, Any]]) -> CaseResults:
        """Evaluate copies of the policy, each with another state, in all cases."""
        with torch.random.fork_rng():
            env = self.build(len(states), self.count)
            results = self._totals(env, policy_batch(self.policy, states))
        returns = results["return"].view(len(states), -1)
        failures = [0] * len(states)
        if self.failure is not None:
            counts = results["failure"].view(len(states), -1).sum(1)
            failures = [int(count) for count in counts.tolist()]
        return CaseResults(returns, failures)

    def evaluate_random(self) -> Tensor:
        """Return the returns of random actions, [C], which are the same at each call."""
        env = self.build(1, self.count)
        with torch.random.fork_rng():
            torch.manual_seed(RANDOM_SEED)
            return self._totals(env, partial(random_action, env))["return"]

    @torch.no_grad()
    def _totals(
        self, env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase]
    ) -> dict[str, Tensor]:
        """Return return and failure of an episode of each row of an env, by name."""
        failure = {} if self.failure is None else {"failure": self.failure}
        totals = Totals({"return": Measure("episode_reward", "last")} | failure)
        with tqdm(unit="step", desc="look", leave=False, mininterval=0.5) as bar:
            for after, running in episodes(env, policy, tick=bar.update):
                totals.add(after, running)
        return totals.results()
