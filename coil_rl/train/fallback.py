"""Fallback at test time: the guide acts where the agent's critic values a state less than those of the guide."""

from pathlib import Path

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import expand_as_right
from torch import Tensor

from coil_rl.errors import UserError, file_of_a_run
from coil_rl.guides import FollowAdvice
from coil_rl.report.runs import SELECTION
from coil_rl.train import checkpoint
from coil_rl.train.build import build_env, build_learner, cases_node
from coil_rl.train.evaluation import EvaluationResult, episodes
from coil_rl.transforms import MixedAction, ResidualAction

LEAVE, BACK = 0.01, 0.05  # shares of the guide's states that are worth less than the two limits


class Fallback(TensorDictModuleBase):
    """Policy that leaves steps to the first guide by the values of a critic, with hysteresis (after CALF, 2025).

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


@torch.no_grad()
def build_fallback(
    config: DictConfig, folder: Path, policy: TensorDictModuleBase | None
) -> Fallback | None:
    """Return the policy of a run with its first guide to fall back to, if `evaluation.fallback` asks for it.

    The limits are quantiles of the critic's values along the guide's drives of the cases of
    selection. A run without advice, critic or cases, or whose env does not execute the advice as it
    is, is a `UserError`.
    """
    if not config.evaluation.fallback:
        return None
    problem = ""
    if policy is None:
        problem = "there is no agent"
    elif SELECTION not in config.evaluation.curve.cases:
        problem = f"it has no evaluation.curve.cases.{SELECTION}"
    else:
        env = build_env(config, cases_node(config, SELECTION))
        learner = build_learner(config, env)
        if "guide_action" not in env.observation_spec:
            problem = "its agent has no guide in its env; train it with method=coil"
        elif any(isinstance(part, (MixedAction, ResidualAction)) for part in env.modules()):
            problem = "its env adds the actions of agent and guide, so the guide cannot act alone"
        elif learner.critic is None:
            problem = "its learner has no value function; train it with learner=ppo"
    if problem:
        raise UserError(
            f"evaluation.fallback=true has no effect on {folder}: {problem}; leave it out"
        )
    with file_of_a_run(folder / checkpoint.NEWEST, "train again"):
        learner.critic.load_state_dict(
            checkpoint.load(folder / checkpoint.NEWEST, config.device)["learner"]["critic"]
        )
    guide = FollowAdvice(env)
    values = [
        values_of(learner.critic, after)[running.reshape(-1)]
        for after, running in episodes(env, guide)
    ]
    leave, back = torch.cat(values).quantile(torch.tensor([LEAVE, BACK])).tolist()
    return Fallback(policy, learner.critic, guide, leave, back)
