"""The brake of an anchored policy: drives in fixed cases of the training decide how much of its guide it keeps."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from tqdm import tqdm

from coil_rl.learners.anchor import Anchor, Look
from coil_rl.train.evaluation import Totals, episodes
from coil_rl.train.measures import Measure
from coil_rl.train.policy_batch import policy_batch


@dataclass(eq=False)
class Brake:
    """Decides before training and at each look of a run how strongly the policy is anchored; a `Probe`."""

    anchor: Anchor  # of the policy
    policy: TensorDictModuleBase  # of the learner; copies of it act
    build: Callable[[int], EnvBase]  # makes an env with all cases for a number of policies
    failure: Measure | None = (
        None  # measure that is true for an episode that failed, if there is one
    )
    names: Sequence[str] = (
        "look/return",
        "look/lower_return",
        "look/failures",
        "look/lower_failures",
        "look/back",
    )

    def due(self, update: int, updates: int, row: Mapping[str, float]) -> bool:
        """Return whether there is a look after an update."""
        return update == 0 or self.anchor.due(update, updates)

    def __call__(self, update: int) -> dict[str, float]:
        """Look, decide, and return the numbers by name."""
        back = False
        if update == 0:
            look = self._look(self.anchor.starts())
            env = self.build(1)
            with torch.random.fork_rng():
                torch.manual_seed(0)
                random = self._drive(env, env.rand_action)["return"]
            self.anchor.begin(look, random, self.policy)
        else:
            look = self._look(self.anchor.tried())
            back = self.anchor.decide(look, self.policy)
        numbers = (look.score(0), look.score(1), *look.failures[:2], back)
        return dict(zip(self.names, map(float, numbers), strict=True))

    def _look(self, weights: Sequence[Tensor]) -> Look:
        """Drive all cases with each of some weights of the guides."""
        (key,) = [
            name for name, value in self.policy.named_buffers() if value is self.anchor.head.weight
        ]
        states = [{**self.policy.state_dict(), key: weight} for weight in weights]
        with torch.random.fork_rng():
            results = self._drive(self.build(len(states)), policy_batch(self.policy, states))
        parts = {name: values.view(len(states), -1) for name, values in results.items()}
        failures = parts["failure"].sum(1).tolist() if "failure" in parts else [0] * len(states)
        return Look(parts["return"], [int(count) for count in failures])

    @torch.no_grad()
    def _drive(
        self, env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase]
    ) -> dict[str, Tensor]:
        failure = {"failure": self.failure} if self.failure else {}
        totals = Totals({"return": Measure("episode_reward", "last")} | failure)
        with tqdm(unit="step", desc="look", leave=False, mininterval=0.5) as bar:
            for after, running in episodes(env, policy, tick=bar.update):
                totals.add(after, running)
        return totals.results()
