"""Fallback at test time: the guide acts where the agent's critic expects little.

That is where it values a state less than those that the guide visits.
"""

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import expand_as_right
from torch import Tensor

from coil_rl.errors import UserError, file_of_a_run
from coil_rl.guides import FollowAdvice
from coil_rl.learners.learner import Learner
from coil_rl.report.runs import SELECTION
from coil_rl.run import checkpoint
from coil_rl.run.beside import Beside, Driver
from coil_rl.run.evaluation import EvaluationResult, episodes
from coil_rl.run.parts import EnvMaker
from coil_rl.run.run import Run
from coil_rl.transforms import MixedAction, ResidualAction

NAME = "or guide"  # after the label, in tables
LEAVE, BACK = 0.01, 0.05  # shares of the guide's states that are worth less than the two limits


class FallbackPolicy(TensorDictModuleBase):
    """Policy that leaves steps to the first guide by the values of a critic.

    It has a hysteresis (after CALF, 2025).

    The guide acts from a state on that is worth less than `leave`, until one is worth at least
    `back`. It serves for one episode of each row. The policy is that of the agent, the critic
    writes `state_value`, and `guide` the guide's action.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        critic: TensorDictModuleBase,
        guide: TensorDictModuleBase,
        leave: float,
        back: float,
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = list(policy.in_keys), list(policy.out_keys)
        self.policy, self.critic, self.guide, self.leave, self.back = (
            policy,
            critic,
            guide,
            leave,
            back,
        )
        self.guide_acts: list[Tensor] = []  # by step, [rows] each

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of the agent or of the guide."""
        value = values_of(self.critic, tensordict)
        limit = (
            torch.where(self.guide_acts[-1], self.back, self.leave)
            if self.guide_acts
            else self.leave
        )
        self.guide_acts.append(value < limit)
        advised = self.guide(tensordict.copy())["action"]
        tensordict = self.policy(tensordict)
        chosen = tensordict["action"]
        falls_back = self.guide_acts[-1].view(tensordict.shape)
        return tensordict.set(
            "action", torch.where(expand_as_right(falls_back, chosen), advised, chosen)
        )

    def said(self, result: EvaluationResult) -> list[str]:
        """Return the sentence on the share of the steps in which the guide acted."""
        return [f"With fallback the guide acted in {self.share(result):.1%} of the steps."]

    def share(self, result: EvaluationResult) -> float:
        """Return the share of the steps of an evaluation in which the guide acted."""
        acts = torch.stack(self.guide_acts)
        steps = torch.tensor([episode["steps"] for episode in result.episodes], device=acts.device)
        within = torch.arange(len(acts), device=acts.device)[:, None] < steps
        return float(acts[within].double().mean())


def values_of(critic: TensorDictModuleBase, states: TensorDictBase) -> Tensor:
    """Return the values of states [*B], flattened."""
    value: Tensor = critic(states.select(*critic.in_keys))["state_value"]
    return value.reshape(-1)


class Fallback(Beside):
    """The policy of a run once more, with its first guide to fall back to."""

    def check(self, make_env: EnvMaker, learner: Learner, folder: Path) -> None:
        """Raise a `UserError` for a run without cases, advice or critic to fall back by.

        Args:
            make_env: makes the envs of the run.
            learner: of the run.
            folder: of the run, for the message.
        """
        env = make_env()
        # In these cases the values of the guide's states are seen.
        if SELECTION not in make_env.sizes:
            raise UserError(no_effect(folder, f"it has no evaluation.curve.cases.{SELECTION}"))
        if "guide_action" not in env.observation_spec:
            raise UserError(
                no_effect(folder, "its agent has no guide in its env; train it with method=coil")
            )
        if any(isinstance(part, (MixedAction, ResidualAction)) for part in env.modules()):
            raise UserError(
                no_effect(
                    folder,
                    "its env adds the actions of agent and guide, so the guide cannot act alone",
                )
            )
        if learner.critic is None:
            raise UserError(
                no_effect(folder, "its learner has no value function; train it with learner=ppo")
            )

    @torch.no_grad()
    def driver(self, run: Run, policy: TensorDictModuleBase | None) -> Driver:
        """Return the policy with its guide.

        The limits are quantiles of the critic's values along the guide's episodes in the cases of
        selection; the critic is that of the newest checkpoint.

        Args:
            run: that is evaluated, with its checkpoint.
            policy: of the run.

        Raises:
            UserError: for a run that cannot fall back.
        """
        if policy is None or run.make_learner is None:
            raise UserError(no_effect(run.folder, "there is no agent"))
        learner = run.make_learner(run.make_env())
        self.check(run.make_env, learner, run.folder)
        env = run.make_env(run.make_env.sizes[SELECTION], SELECTION)
        critic: Any = learner.critic
        newest = run.folder / checkpoint.NEWEST
        with file_of_a_run(newest, "train again"):
            critic.load_state_dict(checkpoint.load(newest, run.device)["learner"]["critic"])
        guide = FollowAdvice(env)
        values = [
            values_of(critic, after)[running.reshape(-1)]
            for _, after, running in episodes(env, guide)
        ]
        of_guide = torch.cat(values)
        leave, back = of_guide.quantile(of_guide.new_tensor([LEAVE, BACK])).tolist()
        acting = FallbackPolicy(policy, critic, guide, leave, back)
        return Driver(NAME, acting, acting.said)


def no_effect(folder: Path, problem: str) -> str:
    """Return the sentence for a run that cannot fall back; `problem` is why."""
    return f"beside=fallback has no effect on {folder}: {problem}; leave it out"
