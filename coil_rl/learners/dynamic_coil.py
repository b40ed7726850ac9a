"""Dynamic COIL (paper section 3.3): an agent that observes advice, guides that learn through it.

Guides and agent form one differentiable network: the agent observes the actions of the guides. In
an agent phase the guides are frozen, which is COIL. In a guide phase the agent is frozen and one
guide learns through it, with the same PPO loss and a smaller learning rate. The learning rate
shrinks from each phase to the next of its kind.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, astuple, dataclass
from typing import Annotated, Any, ClassVar, Literal, Unpack

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torch.func import functional_call
from torchrl.envs import EnvBase

from coil_rl.learners.encoders import Mlp
from coil_rl.learners.learner import Stateful
from coil_rl.learners.policy import Entries, Policy
from coil_rl.learners.ppo import PPO, PPOSettings
from coil_rl.ranges import Count, Interval, NonNegative, Seed, checked
from coil_rl.schedules import Linear, Schedule, schedule
from coil_rl.transforms.guide_actions import Guides
from coil_rl.transforms.normalised_action import given_units


@dataclass(frozen=True)
class Phase:
    """A phase of the training.

    Args:
        agent: whether the agent learns.
        guides: indices of the guides that learn.
        earlier: number of earlier phases of the same kind.
    """

    agent: bool
    guides: tuple[int, ...]
    earlier: int


# Whether a phase ends, given its frames so far and the mean reward per step in each of its updates.
StopRule = Callable[[int, Sequence[float]], bool]


@checked
@dataclass(frozen=True)
class AfterFrames:
    """Stop rule for phases of fixed length.

    Args:
        frames: of a phase; it ends with the update that completes them.
    """

    frames: Count

    def __call__(self, frames: int, rewards: Sequence[float]) -> bool:
        """Return whether the phase is complete."""
        return frames >= self.frames


@checked
@dataclass(frozen=True)
class AtConvergence:
    """Stop rule: a phase ends when some evaluations have not improved on the best one before.

    An evaluation is the mean reward per step in the batch of one update.

    Args:
        evaluations: number of consecutive ones without improvement that end the phase.
        improvement: minimum increase of the mean reward.
        frames: maximum length of the phase; None: unlimited.
    """

    evaluations: Count = 5
    improvement: NonNegative = 0.0
    frames: Count | None = None

    def __call__(self, frames: int, rewards: Sequence[float]) -> bool:
        """Return whether the reward has converged, or the maximum length is reached."""
        if self.frames is not None and frames >= self.frames:
            return True
        best, since = float("-inf"), 0
        for reward in rewards:
            best, since = (reward, 0) if reward > best + self.improvement else (best, since + 1)
        return since >= self.evaluations


@checked
@dataclass(eq=False)
class PhaseSchedule(Stateful):
    """The order of the phases.

    Args:
        guides: n, number of guides.
        order: "alternate": agent, guide, agent, guide, ...; as controls, "joint": all at once;
            "agent": the agent only; "guide": one guide after the other, never the agent.
        choice: of the guide in the i-th guide phase: "sequential": i mod n; "stochastic": uniformly
            at random.
        agent_phase: ends phases in which the agent learns.
        guide_phase: ends the other phases.
        seed: of the stochastic choice.

    Attributes:
        phase: the present one.
        number: of the present phase, from 0.
        frames: in the present phase so far.
        rewards: mean reward per step of each update in the present phase.
    """

    parts: ClassVar[tuple[str, ...]] = ("number", "frames", "rewards", "generator")

    guides: Count
    _: KW_ONLY
    order: Literal["alternate", "joint", "agent", "guide"] = "alternate"
    choice: Literal["sequential", "stochastic"] = "sequential"
    agent_phase: StopRule = AfterFrames(131_072)
    guide_phase: StopRule = AfterFrames(65_536)
    seed: Seed = 0

    def __post_init__(self) -> None:
        self.generator = torch.Generator().manual_seed(self.seed)
        self.number, self.frames = 0, 0
        self.rewards: list[float] = []
        self.phase = self._next()

    def advance(self, frames: int, reward: float) -> bool:
        """Count an update with these frames and this mean reward; return whether a phase ends."""
        self.frames += frames
        self.rewards.append(reward)
        stop = self.agent_phase if self.phase.agent else self.guide_phase
        if not stop(self.frames, self.rewards):
            return False
        self.number, self.frames, self.rewards = self.number + 1, 0, []
        self.phase = self._next()
        return True

    def _next(self) -> Phase:
        if self.order == "agent":
            return Phase(True, (), self.number)
        if self.order == "joint":
            return Phase(True, tuple(range(self.guides)), self.number)
        earlier = self.number if self.order == "guide" else self.number // 2
        if self.order == "alternate" and self.number % 2 == 0:
            return Phase(True, (), earlier)
        if self.choice == "sequential":
            return Phase(False, (earlier % self.guides,), earlier)
        drawn = int(torch.randint(self.guides, (), generator=self.generator))
        return Phase(False, (drawn,), earlier)

    def state_dict(self) -> dict[str, Any]:
        """Return the position in the schedule."""
        return super().state_dict() | {"phase": astuple(self.phase)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from `state_dict`; one with other guides is a `ValueError`."""
        super().load_state_dict(state)
        agent, guides, earlier = state["phase"]
        if not set(guides) <= set(range(self.guides)):
            raise ValueError(
                f"the guides {list(guides)} learn in it, but the numbers of guides here are below "
                f"{self.guides}"
            )
        self.phase = Phase(bool(agent), tuple(guides), int(earlier))


@checked
class DynamicCoil(PPO):
    """The learner of Dynamic COIL: PPO with guides in front of the agent, and a phase schedule.

    A value out of range, a guide without parameters, or guides that share parameters are a
    `ValueError`.

    Args:
        env: the env, for its specs; actions must be continuous.
        in_keys: entries that agent and critic observe; the agent also observes the advice.
        guides: guide networks by name; each writes `action`.
        phases: makes the phase schedule for a number of guides.
        guide_learning_rate: of the guides, a number or a schedule.
        shrink: factor on the learning rate from each phase to the next of its kind.
        critic_phases: phases in which the critic learns: "both", "agent" or "guide".
        settings: further ones of `PPO`; a network without a memory, and no compilation.
    """

    kind = "guides"
    parts = (*PPO.parts, "phases")
    with_memory = compilable = False  # some networks are frozen in each phase

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        guides: Mapping[str, TensorDictModuleBase],
        phases: Callable[[int], PhaseSchedule] = PhaseSchedule,
        guide_learning_rate: NonNegative | Schedule = Linear(3e-4, 0.0),
        shrink: Annotated[float, Interval(gt=0, le=1)] = 0.9,
        critic_phases: Literal["both", "agent", "guide"] = "both",
        **settings: Unpack[PPOSettings],
    ) -> None:
        if not env.action_spec.dtype.is_floating_point:
            raise ValueError(
                "Dynamic COIL needs continuous actions, but this env has discrete ones; take "
                "method=coil_anchored"
            )
        self.guide_learning_rate = schedule(guide_learning_rate)
        self.advice = Guides(guides, trainable=True)
        self.advice.units = given_units(env)
        parameters = [parameter for guide in guides.values() for parameter in guide.parameters()]
        if len({id(parameter) for parameter in parameters}) < len(parameters):
            raise ValueError(
                "two guides share parameters, so one of them cannot be frozen while the other "
                "learns"
            )
        self.guides: dict[str, TensorDictModuleBase] = dict(guides)
        self.initial = [
            {name: p.detach().clone() for name, p in guide.named_parameters()}
            for guide in guides.values()
        ]
        self.phases = phases(len(guides))
        self.shrink, self.critic_phases = shrink, critic_phases
        super().__init__(env, in_keys, **settings)

    def build_policy(
        self, env: EnvBase, in_keys: Sequence[NestedKey], network: Mlp, **options: Any
    ) -> Policy:
        """Return the guides followed by the agent."""
        shapes = {"guide_action": torch.Size([len(self.guides), *env.action_spec_unbatched.shape])}
        observed = [*in_keys, *self.advice.out_keys]
        agent = super().build_policy(env, observed, network, shapes=shapes, **options)
        self.agent_parameters = list(agent.parameters())
        return Policy(self.advice, *agent.module)

    def parameter_groups(self) -> list[list[nn.Parameter]]:
        """Return the parameters of the agent, of the critic, and of each guide."""
        guides = [list(guide.parameters()) for guide in self.guides.values()]
        return [self.agent_parameters, list(self.critic.parameters()), *guides]

    def learning_rates(self, progress: float) -> list[float]:
        """Return the learning rates of the parameter groups in this phase; 0: frozen."""
        phase = self.phases.phase
        factor = self.shrink**phase.earlier
        agent, guide = self.learning_rate(progress), self.guide_learning_rate(progress) * factor
        critic_learns = self.critic_phases in ("both", "agent" if phase.agent else "guide")
        guides = [guide if index in phase.guides else 0.0 for index in range(len(self.guides))]
        return [agent * factor if phase.agent else 0.0, agent if critic_learns else 0.0, *guides]

    def prepare(self, batch: TensorDictBase, progress: float) -> Entries:
        """Freeze the networks that do not learn in this phase, and do what `PPO` does."""
        for group, rate in zip(self.gradient.groups, self.learning_rates(progress), strict=True):
            for parameter in group:
                parameter.requires_grad_(rate > 0)
        return super().prepare(batch, progress)

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Learn from a batch of rollouts; arguments as for `PPO.update`.

        Returns:
            The metrics of `PPO`; the number of the `phase`; the index of the `guide` that learns,
            -1 if none does and n if all do; `guides_changed`, whether a phase has ended in which a
            guide learned; `guide_learning_rate`; and for each guide `moved_NAME`, the mean absolute
            difference of its action to that of the initial guide.
        """
        number, phase, rates = self.phases.number, self.phases.phase, self.learning_rates(progress)
        metrics = super().update(batch, progress)
        ended = self.phases.advance(batch.numel(), float(batch["next", "reward"].mean()))
        learning_guide = phase.guides[0] if len(phase.guides) == 1 else len(phase.guides) or -1
        metrics |= {
            "phase": number,
            "guides_changed": float(ended and bool(phase.guides)),
            "guide": learning_guide,
            "learning_rate": rates[0],
            "guide_learning_rate": max(rates[2:]),
        }
        return metrics | self.moved(batch)

    @torch.no_grad()
    def moved(self, batch: TensorDictBase) -> dict[str, float]:
        """Return the mean absolute change of the action of each guide since the start."""
        distances = {}
        for (name, guide), initial in zip(self.guides.items(), self.initial, strict=True):
            observed = batch.select(*guide.in_keys)
            before = functional_call(guide, initial, (observed.copy(),))["action"]
            change = guide(observed)["action"] - before
            if self.advice.units is not None:
                change = change / self.advice.units.unit
            distances[f"moved_{name}"] = float(change.abs().mean())
        return distances
