"""Dynamic COIL (paper section 3.3): an agent that listens to guides, and guides that learn to be listened to.

Guides and agent are one differentiable network: the guides say what they would do, the agent sees that and acts. The
phases of a run decide who learns. In an agent phase the guides are frozen and this is COIL; in a guide phase the agent
is frozen and one guide learns through it, by the same PPO loss and with a smaller learning rate. Each phase learns a
little more slowly than the one of its kind before it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import nn
from torch.func import functional_call
from torchrl.envs import EnvBase

from coil_rl.guides.advice import Advice
from coil_rl.learners import networks
from coil_rl.learners.phases import Phases
from coil_rl.learners.ppo import PPO
from coil_rl.schedules import Schedule, schedule


class DynamicCoil(PPO):
    """The learner of Dynamic COIL and its controls.

    Args:
        env: for the shapes of what is observed and done; its actions are continuous.
        in_keys: what agent and critic observe; the agent also sees the advice, which the critic could compute.
        guides: the guides by name, networks that learn; each reads what the env writes and writes `action`.
        phases: makes the order of who learns when for so many guides.
        guide_learning_rate: of the guides, a number or a schedule over the run.
        shrink: each phase learns at this fraction of the rate of the one of its kind before it.
        critic_phases: in which phases the critic learns: "both", "agent" or "guide".
        ppo: everything else as for `PPO`.

    Attributes:
        guides: by name.
        phases: who learns when.

    Raises:
        ValueError: for a value outside its range, a guide without parameters, or two guides that share some.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.train.rollout import Rollout
        >>> env = ConeTrackEnv(shipped_tracks("train"), num_cars=64)
        >>> first, second = (networks.Keyed(networks.Network(env, ["observation"], [8], 1, 1.0), ["observation"],
        ...                                 ["action"]) for _ in range(2))
        >>> learner = DynamicCoil(env, guides={"first": first, "second": second})
        >>> metrics = learner.update(Rollout(env, learner.policy, steps=32).collect())
    """

    kind = "guides"

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[str] = ("observation",),
        *,
        guides: Mapping[str, TensorDictModuleBase],
        phases: Callable[[int], Phases] = Phases,
        guide_learning_rate: float | Schedule = 1e-4,
        shrink: float = 0.9,
        critic_phases: Literal["both", "agent", "guide"] = "both",
        **ppo: Any,
    ) -> None:
        if not 0 < shrink <= 1:
            raise ValueError(f"shrink={shrink} must be more than 0 and at most 1")
        if critic_phases not in ("both", "agent", "guide"):
            raise ValueError(f"critic_phases={critic_phases!r} must be one of both, agent, guide")
        if not env.action_spec.dtype.is_floating_point:
            raise ValueError("guides learn through actions that are numbers; this env has choices")
        self.advice = Advice(guides)
        self.guides: dict[str, TensorDictModuleBase] = dict(guides)
        self.start = [{name: p.detach().clone() for name, p in guide.named_parameters()} for guide in guides.values()]
        self.phases = phases(len(guides))
        self.guide_learning_rate = schedule(guide_learning_rate)
        if not self.guide_learning_rate(0) >= 0:
            raise ValueError(f"guide_learning_rate={self.guide_learning_rate(0)} must be at least 0")
        self.shrink, self.critic_phases = shrink, critic_phases
        super().__init__(env, in_keys, **ppo)

    def build_policy(
        self, env: EnvBase, in_keys: Sequence[str], hidden: Sequence[int], scale: float, gain: float
    ) -> ProbabilisticTensorDictSequential:
        """The guides, and behind them an agent that also sees what they say."""
        shape = torch.Size([len(self.guides), *env.action_spec.shape[len(env.batch_size) :]])
        seen = [*in_keys, *self.advice.out_keys]
        agent = networks.actor(env, seen, hidden, scale, gain, {"guide_action": shape})
        self.agent_parameters = list(agent.parameters())
        return ProbabilisticTensorDictSequential(self.advice, *agent.module)

    def groups(self) -> list[list[nn.Parameter]]:
        """The agent's parameters, the critic's, and each guide's."""
        of_guides = [list(guide.parameters()) for guide in self.guides.values()]
        if len({id(p) for group in of_guides for p in group}) < sum(map(len, of_guides)):
            raise ValueError("two of the guides share parameters, so that one cannot learn while the other does not")
        return [self.agent_parameters, list(self.critic.parameters()), *of_guides]

    def rates(self, progress: float) -> list[float]:
        """Of each group in this phase; 0 where it does not learn."""
        turn, shrunk = self.phases.turn, self.shrink**self.phases.turn.earlier
        critic = self.critic_phases in ("both", "agent" if turn.agent else "guide")
        agent, guide = self.learning_rate(progress), self.guide_learning_rate(progress) * shrunk
        of_guides = [guide if place in turn.guides else 0.0 for place in range(len(self.guides))]
        return [agent * shrunk if turn.agent else 0.0, agent if critic else 0.0, *of_guides]

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Learn from a batch of rollouts, whoever's turn it is.

        Args:
            batch: as for `PPO`.
            progress: share of the run that is over, for the schedules.

        Returns:
            What `PPO` returns; `phase`, its number; `guide`, which one learns, -1 if none and n if all do;
            `guides_changed`, whether a phase ends in which one did; `guide_learning_rate`; and of each guide
            `moved_NAME`, how far its action is from what it was at the start, mean |g - g_start| over the batch.
        """
        phase, turn, rates = self.phases.number, self.phases.turn, self.rates(progress)
        for group, rate in zip(self.optimiser.param_groups, rates, strict=True):
            for parameter in group["params"]:
                parameter.requires_grad_(rate > 0)
        metrics = super().update(batch, progress)
        ended = self.phases.advance(batch.numel(), float(batch["next", "reward"].mean()))
        metrics |= {
            "phase": phase,
            "guides_changed": float(ended and bool(turn.guides)),
            "guide": turn.guides[0] if len(turn.guides) == 1 else len(turn.guides) or -1,
            "learning_rate": rates[0],
            "guide_learning_rate": max(rates[2:]),
        }
        return metrics | {f"moved_{name}": value for name, value in self._moved(batch).items()}

    @torch.no_grad()
    def _moved(self, batch: TensorDictBase) -> dict[str, float]:
        moved = {}
        for (name, guide), start in zip(self.guides.items(), self.start, strict=True):
            seen = batch.select(*guide.in_keys)
            then = functional_call(guide, start, (seen.copy(),))["action"]
            moved[name] = float((guide(seen)["action"] - then).abs().mean())
        return moved

    def state_dict(self) -> dict[str, Any]:
        """Everything an update depends on besides the batch."""
        return super().state_dict() | {"phases": self.phases.state_dict(), "names": list(self.guides)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over a state of `state_dict`.

        Raises:
            ValueError: if it is of other guides, or of another order.
        """
        if state["names"] != list(self.guides):
            raise ValueError(f"the state is of the guides {', '.join(state['names'])}, not {', '.join(self.guides)}")
        super().load_state_dict(state)
        self.phases.load_state_dict(state["phases"])
