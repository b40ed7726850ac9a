"""IBRL (Hu et al. 2024): SAC that chooses between the guide's action and its own.

The guide proposes g and the policy b. The executed one has the larger value, the minimum of the
target critics, and the critics learn from the same choice in the next state, without an entropy
reward:

    a = argmax over {g, b} of min Q'(s, .),  y = r + gamma * max over {g', b'} of min Q'(s', .)

So the guide's actions help from the first step on, and are dropped where the policy's are better.
PEX (Zhang et al. 2023) draws a proposal instead. EXPO (Dong et al. 2025) adds a third one: g with
an edit by a second policy.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any, Unpack

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import expand_as_right
from torch import Tensor
from torch.distributions import Categorical
from torchrl.envs import EnvBase, ExplorationType, exploration_type, set_exploration_type

from coil_rl.learners.critics import Critics
from coil_rl.learners.encoders import Mlp
from coil_rl.learners.gradient import Weights
from coil_rl.learners.policy import ByKey, Entries, KeyModule, Policy, next_of
from coil_rl.learners.rewards import discounted
from coil_rl.learners.sac import SAC, SACSettings
from coil_rl.ranges import NonNegative, checked
from coil_rl.transforms.action_space import ActionSpace
from coil_rl.transforms.guide_transform import check_advised

ADVICE = "guide_action"


@checked
class IBRL(SAC):
    """The IBRL learner.

    The env writes `guide_action`, else that is a `KeyError`; the networks need not observe it. What
    `SAC` refuses, an option that it does not take, and `edit` for an action without bounds are a
    `ValueError`.

    Args:
        env: the env, with continuous actions and advice.
        sharpness: a proposal is drawn with probabilities softmax(sharpness * min Q'), and y has its
            mean value, as in PEX; None: the better one. In evaluation it is always the better one.
        edit: largest change of the guide's action by the third proposal, as a fraction of half the
            range of the action, as in EXPO; 0: there is none.
        guide: index of the guide in the advice.
        settings: further ones of `SAC`, but `target_critics`, `uncertainty` and `anchor`: all
            critics are compared, and the guide acts from the first step on.
    """

    reported = (*SAC.reported, "guide_share")
    advice_key = ADVICE

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        sharpness: NonNegative | None = None,
        edit: NonNegative = 0.0,
        guide: int = 0,
        **settings: Unpack[SACSettings],
    ) -> None:
        if any(settings.get(name) for name in ("target_critics", "uncertainty", "anchor")):
            raise ValueError(
                "IBRL compares all critics; leave target_critics, uncertainty and anchor out"
            )
        self.guide, self.sharpness, self.edit = guide, sharpness, edit
        check_advised(env.observation_spec, self)
        super().__init__(env, in_keys, **settings)
        self.also_store(ADVICE)

    def build_actor(self, env: EnvBase, in_keys: Sequence[NestedKey], network: Mlp) -> Policy:
        """Return the policy, and build the second one if there is one."""
        self.space, self.editor = ActionSpace(env.action_spec, len(env.batch_size)), None
        if self.edit:
            if self.space.bounds is None or not torch.stack(self.space.bounds).isfinite().all():
                raise ValueError(
                    "edit is a fraction of the range of the action, but it has no bounds; "
                    "take edit=0"
                )
            self.editor = super().build_actor(env, [*in_keys, ADVICE], network)
        return super().build_actor(env, in_keys, network)

    def build_policy(self) -> TensorDictModuleBase:
        """Return the policy that collects the batches: it chooses between the proposals."""
        self.proposals = Proposals(
            self.actor,
            self.target,
            space=self.space,
            editor=self.editor,
            guide=self.guide,
            sharpness=self.sharpness,
            edit=self.edit,
        )
        return self.proposals if self.inputs is None else ByKey(self.inputs, self.proposals)

    def further_weights(self) -> list[Weights]:
        """Return the weights of the second policy."""
        self.of_editor = [] if self.editor is None else [Weights(self.editor)]
        return self.of_editor

    def losses(self, minibatch: Entries) -> dict[str, Tensor]:
        """Return the losses of a minibatch [N] and other values, such as the `guide_share`."""
        with ExitStack() as stack:
            for weights in self.of_editor:
                stack.enter_context(weights.used())
            return super().losses(minibatch)

    def critic_losses(self, minibatch: Entries) -> dict[str, Tensor]:
        """Return the loss of all critics, and the share of the guide in the choice."""
        with torch.no_grad(), self.of_target.used(), set_exploration_type(ExplorationType.RANDOM):
            _, values = self.proposals.rate(next_of(minibatch))
            shares = self.proposals.shares(values)
            value = (shares * values).sum(0)
            reward = minibatch["next", "reward"].squeeze(-1).to(value.dtype)
            target = (reward + discounted(minibatch, self.gamma, value)).unsqueeze(-1)
        losses = self.distances(self.critics.outputs(minibatch, train=True), target)
        return losses | {"guide_share": shares[0].mean()}

    def actor_losses(self, minibatch: Entries) -> dict[str, Tensor]:
        """Return the losses of both policies and of the temperature."""
        losses = super().actor_losses(minibatch)
        if self.editor is None:
            return losses
        states = minibatch.copy()
        change, log_prob = self.editor.density(states).draw()
        states.set("action", self.proposals.edited(states, change))
        value = self.critics.values(states).amin(0)
        losses["loss_actor"] = losses["loss_actor"] + (self.alpha * log_prob - value).mean()
        return losses


class Proposals(KeyModule):
    """The choice between the actions of guide, policy and perhaps an editor; it writes `action`.

    Args:
        actor: the policy.
        critics: rate the actions.
        space: of the actions.
        editor: the second policy, which edits the guide's action; None: there is none.
        guide: index of the guide in the advice.
        sharpness: of a random choice; None: the better one.
        edit: largest change of the guide's action, as a fraction of half the range of the action.
    """

    def __init__(
        self,
        actor: Policy,
        critics: Critics,
        *,
        space: ActionSpace,
        editor: Policy | None,
        guide: int,
        sharpness: float | None,
        edit: float,
    ) -> None:
        super().__init__(list(dict.fromkeys([*actor.in_keys, ADVICE])), ["action"])
        self.actor, self.critics, self.editor, self.space = actor, critics, editor, space
        self.guide, self.sharpness, self.edit = guide, sharpness, edit

    def forward(self, tensordict: Any) -> Any:
        """Write the chosen action."""
        proposals, values = self.rate(tensordict)
        chosen = values.argmax(0)
        if self.sharpness is not None and exploration_type() == ExplorationType.RANDOM:
            chosen = Categorical(self.shares(values).movedim(0, -1)).sample()
        index = expand_as_right(chosen[None], proposals[:1])
        return tensordict.set("action", proposals.gather(0, index)[0])

    def rate(self, entries: Any) -> tuple[Tensor, Tensor]:
        """Return the proposals, the guide's first, [P, *B, A], and their values [P, *B]."""
        read = Entries({key: entries[key] for key in self.in_keys})
        proposals = [read[ADVICE][..., self.guide, :], self.actor(read.copy())["action"]]
        if self.editor is not None:
            proposals.append(self.edited(read, self.editor(read.copy())["action"]))
        actions = torch.stack(proposals)
        repeated = {key: value.expand(len(actions), *value.shape) for key, value in read.items()}
        return actions, self.critics.values(Entries(repeated).set("action", actions)).amin(0)

    def edited(self, entries: Any, change: Tensor) -> Tensor:
        """Return the guide's action with a change, which is an action of the second policy."""
        low, high = self.space.bounds  # type: ignore[misc]
        return self.space.clamp(
            entries[ADVICE][..., self.guide, :] + self.edit * (change - (low + high) / 2)
        )

    def shares(self, values: Tensor) -> Tensor:
        """Return the probability of each proposal from their values, [P, *B]."""
        if self.sharpness is not None:
            return (self.sharpness * values).softmax(0)
        return torch.zeros_like(values).scatter(0, values.argmax(0, keepdim=True), 1)
