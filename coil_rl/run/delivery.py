"""What a run hands over: its last policy, an earlier one, or its guide, by a test at the end.

The last policy of a training need not be its best one, and may be worse than its guide. With
`delivery=tested` a part of the frames is reserved for a test at the end. In it the last policy, the
kept one with the highest return in training, and each guide act in the same new cases. The one with
the highest mean return is handed over. A policy that holds a guide is compared with its own first
policy instead of the guides. None of these cases is in the evaluation curve or in the table.

The test is left out if its first cases do not fit into the frames that the start test has left. The
start test's own frames do not count if it found a guide ahead without holding it. A run that holds
a guide is always tested.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from coil_rl import record
from coil_rl.guides.simple import FollowAdvice
from coil_rl.learners.anchor import hold_of
from coil_rl.learners.learner import Learner
from coil_rl.report.statistics import difference
from coil_rl.run import checkpoint
from coil_rl.run.cases import TrainingCases
from coil_rl.run.curve import EvaluationCurve
from coil_rl.run.folder import HANDED_OVER, weights_file
from coil_rl.run.judge import guide_titles
from coil_rl.transforms import GuideActions
from coil_rl.transforms.combined_actions import GradualResidual, ResidualAction

GUIDE = "guide"  # entry of a file of weights that stands for a guide: its number
SHARE = 0.05  # of the frames of a run that the test may take; its first cases may take more
FIRST_CASES = 2
RETURN_IN_TRAINING = "train/return"
FINISHED = "train/episodes"


class GuideActs(TensorDictModuleBase):
    """Policy in the env of a method that makes the env execute what a guide advises.

    Args:
        env: of the method.
        guide: number of the guide.
    """

    def __init__(self, env: EnvBase, guide: int = 0) -> None:
        advised = FollowAdvice(env, guide, out_key=env.action_key)
        self.in_keys: list[NestedKey] = list(advised.in_keys)
        self.out_keys: list[NestedKey] = [env.action_key]
        super().__init__()
        self.advised = advised
        # Where the agent's action is added to the guide's, its neutral action leaves the guide.
        residual = (ResidualAction, GradualResidual)
        adds = any(isinstance(part, residual) for part in env.modules())
        self.neutral = advised.action_space.neutral() if adds else None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        tensordict = self.advised(tensordict)
        if self.neutral is None:
            return tensordict
        (key,) = self.out_keys
        return tensordict.set(key, self.neutral.expand_as(tensordict[key]))


@dataclass(eq=False)
class Delivery:
    """The test at the end of a training, a `Callback`.

    It writes the policy that is handed over, `policy_handed_over.pt`, and `delivery.json`, which
    says which it is and why. Ties go to the last policy.

    Args:
        learner: has the policy.
        env: of the training.
        cases: in which policies are compared.
        curve: may have kept policies.
        folder: of the run.
    """

    learner: Learner
    env: EnvBase
    cases: TrainingCases
    curve: EvaluationCurve
    folder: Path

    names: Sequence[str] = ("delivery/last", "delivery/earlier", "delivery/guide", "delivery/cases")

    def due(self, update: int, updates: int, row: Mapping[str, float]) -> bool:
        """Return whether the training is over."""
        return update == updates > 0

    def reserve(self) -> int:
        """Return the frames that are kept for the test, once the start test is over.

        They are enough for its first cases, if the start test has seen how long episodes are.
        """
        if not self.cases.longest:
            return self._affordable()
        if not self._fits():
            return 0
        return max(self._affordable(), self._first_episodes() * self.cases.longest)

    def _fits(self) -> bool:
        """Return whether there is a test: its first cases fit, or a guide is to be compared.

        Episodes are taken to be as long as in the start test, and without one as in the training. A
        run that holds a guide, or found one ahead without enough cases to hold it, is always
        tested, as it promises to be no worse than this guide.
        """
        if self._holds() or self.cases.guide_ahead:
            return True
        if self.cases.episodes:
            length = self.cases.steps / self.cases.episodes
            return self._first_episodes() * length <= self._affordable(2)
        return self._first_episodes() * self._length_in_training() <= self._affordable()

    def _length_in_training(self) -> float:
        """Return the mean steps of an episode of the training, 0 before the log has a row.

        If no episode has ended, they are the steps of a row in the whole training.
        """
        rows = self.curve.metrics.rows
        if not rows:
            return 0.0
        finished = sum(row[FINISHED] for row in rows if not math.isnan(row[FINISHED]))
        return rows[-1]["frames/rollout"] / max(finished, self.env.batch_size.numel())

    def _first_episodes(self) -> int:
        """Return the number of episodes of the last policy and the guides in the first cases."""
        return FIRST_CASES * (1 + len(self._guides_of_env()))

    def _holds(self) -> bool:
        """Return whether the policy holds a guide."""
        hold = hold_of(self.learner.policy)
        return hold is not None and bool(hold.held)

    def _affordable(self, shares: int = 1) -> int:
        """Return the frames that the test may take: some shares, or what the start test has left.

        The two tests together have two shares, of which each takes one if it can. If the start test
        found a guide ahead but had too few cases to hold it, its own frames do not count, so that
        this test has more cases.
        """
        share = math.ceil(SHARE * self.cases.frames)
        taken = 0 if self.cases.guide_ahead else self.cases.steps
        return max(min(shares * share, 2 * share - taken), 0)

    def after_update(self, update: int) -> dict[str, float]:
        """Test, hand over, and return the mean returns by name."""
        last = {name: value.clone() for name, value in self.learner.policy.state_dict().items()}
        candidates: dict[str, Any] = {"last": last}
        returns: dict[str, Tensor] = {}
        earlier = None
        if self._fits():
            candidates |= self._guides()
            earlier = self._earlier(update)
            if earlier is not None:
                candidates["earlier"] = checkpoint.load(self.curve.file(earlier))
            returns = self._tested(candidates)
        means = {name: float(values.mean()) for name, values in returns.items()}
        chosen = max(means, key=lambda name: means[name], default="last")
        checkpoint.save(candidates[chosen], weights_file(self.folder, HANDED_OVER))
        self._report(chosen, means, returns, earlier)
        guides = [mean for name, mean in means.items() if name not in ("last", "earlier")]
        numbers = (
            means.get("last", math.nan),
            means.get("earlier", math.nan),
            max(guides, default=math.nan),
            float(len(returns.get("last", ()))),
        )
        return dict(zip(self.names, numbers, strict=True))

    def _earlier(self, update: int) -> int | None:
        """Return the update of the kept policy with the highest return in training, if it is known.

        The first one is left out, as no episode was finished with it.
        """
        rows = self.curve.metrics.rows
        returns = {
            each: rows[each][RETURN_IN_TRAINING] for each in self.curve.kept() if 0 < each < update
        }
        known = {each: value for each, value in returns.items() if not math.isnan(value)}
        if not known:
            return None
        return max(known, key=lambda each: known[each])

    def _guides(self) -> dict[str, Any]:
        """Return what stands for the guides: the first policy if it holds one, else their numbers.

        There is nothing in a run whose env has no guides.
        """
        if self._holds() and self.curve.kept():
            return {"first": checkpoint.load(self.curve.file(0))}
        titles = self._guides_of_env()
        return {title: {GUIDE: torch.tensor(index)} for index, title in enumerate(titles)}

    def _guides_of_env(self) -> list[str]:
        """Return the titles of the guides in the env."""
        found = [part for part in self.env.modules() if isinstance(part, GuideActions)]
        return guide_titles(found[0].names) if found else []

    def _tested(self, candidates: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return the returns of the candidates in the same new cases, [C] each.

        An earlier policy is left out where the frames do not allow for it.
        """
        returns, reserve = dict[str, Tensor](), self._affordable()
        policies, file = dict[str, TensorDictModuleBase](), weights_file(self.folder)
        for name, state in candidates.items():
            policies[name] = policy_of(state, copy.deepcopy(self.learner.policy), self.env, file)
        earlier = policies.pop("earlier", None)
        self.cases.taught = None  # what is handed over is the policy that was tested
        self.cases.begin()
        begun = self.cases.steps
        for count in self.cases.blocks(FIRST_CASES, reserve):
            self.cases.renew(count)
            self._act(policies, returns)
            # The earlier policy is taken to need as many steps as each of the others.
            needed = (self.cases.steps - begun) * (1 + 1 / len(policies))
            if earlier is not None and needed <= reserve:
                self._act({"earlier": earlier}, returns)
                policies["earlier"] = earlier
            earlier = None  # it joins in the first cases or not at all
        return returns

    def _act(self, policies: Mapping[str, Any], returns: dict[str, Tensor]) -> None:
        """Add the returns of policies in the present cases."""
        found = self.cases.compared(list(policies.values()))
        for name, more in zip(policies, found, strict=True):
            returns[name] = torch.cat([returns.get(name, more.new_empty(0)), more])

    def _report(
        self,
        chosen: str,
        means: Mapping[str, float],
        returns: Mapping[str, Tensor],
        earlier: int | None,
    ) -> None:
        """Write which policy is handed over, and why.

        Args:
            chosen: name of the policy that is handed over.
            means: of the returns, by name.
            returns: of each policy in each case, by name; empty without a test.
            earlier: update of the best kept policy; None: there is none.
        """
        ahead = frames = None
        if chosen != "last":
            ahead = difference(returns[chosen].tolist(), returns["last"].tolist())[:3]
        if chosen == "earlier" and earlier is not None:
            frames = int(self.curve.metrics.rows[earlier]["frames"])
        report = record.Delivery(
            policy=chosen if returns else record.UNTESTED,
            cases=len(returns.get("last", ())),
            steps=self.cases.steps,
            calls=self.cases.calls,
            returns=dict(means),
            ahead=ahead,
            frames=frames,
        )
        record.DELIVERY.write(self.folder, report)


def policy_of(
    state: Mapping[str, Any], policy: TensorDictModuleBase, env: EnvBase, path: Path
) -> TensorDictModuleBase:
    """Return the policy that a file of weights stands for: a guide, or `policy` with them.

    Args:
        state: what the file holds.
        policy: gets the weights.
        env: with the transforms of the run.
        path: of the file, for messages.

    Raises:
        UserError: if the weights do not fit the policy, or are not finite.
    """
    if GUIDE in state:
        return GuideActs(env, int(state[GUIDE]))
    checkpoint.put_weights(policy, state, path)
    return policy
