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
from functools import cached_property, partial
from typing import Any, Unpack

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictSequential
from tensordict.utils import expand_as_right
from torch import Tensor
from torch.distributions import Categorical
from torchrl.envs import EnvBase, ExplorationType, exploration_type, set_exploration_type
from torchrl.objectives import LossModule, SACLoss

from coil_rl.learners.critics import Critics
from coil_rl.learners.encoders import Mlp
from coil_rl.learners.policy import Policy
from coil_rl.learners.sac import SAC, SACSettings
from coil_rl.ranges import NonNegative, checked
from coil_rl.transforms.action_space import ActionSpace

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
        if ADVICE not in env.observation_spec:
            raise KeyError(
                f"IBRL chooses between actions, but the env has no {ADVICE}; "
                "put GuideActions before it"
            )
        self.choice = partial(Proposals, guide=guide, sharpness=sharpness, edit=edit)
        super().__init__(env, in_keys, **settings)
        self.also_store(ADVICE)

    def build_loss(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey],
        network: Mlp,
        target_critics: int | None,
        arguments: dict[str, Any],
    ) -> LossModule:
        """Return the loss, with the second policy if there is one."""
        space, editor = ActionSpace(env.action_spec, len(env.batch_size)), None
        if self.choice.keywords["edit"]:
            if space.bounds is None or not torch.stack(space.bounds).isfinite().all():
                raise ValueError(
                    "edit is a fraction of the range of the action, but it has no bounds; "
                    "take edit=0"
                )
            editor = self.build_actor(env, [*in_keys, ADVICE], network)
        loss = ProposalLoss(partial(self.choice, space=space, editor=editor), arguments)
        loss.target_entropy  # noqa: B018  becomes part of the state at the first access
        return loss

    def build_policy(self) -> TensorDictSequential:
        """Return the policy that collects the batches: it chooses between the proposals."""
        before = [] if self.inputs is None else [self.inputs]
        return TensorDictSequential(*before, self.loss.proposals)

    def losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return the losses of a minibatch [N] and other values, such as the `guide_share`."""
        return super().losses(minibatch).set("guide_share", self.loss.guide_share)


class Proposals(Critics):
    """The choice between the actions of guide, policy and perhaps an editor; it writes `action`.

    Args:
        actor: the policy.
        loss: has the target critics, which rate the actions.
        space: of the actions.
        editor: the second policy, which edits the guide's action; None: there is none.
        guide: index of the guide in the advice.
        sharpness: of a random choice; None: the better one.
        edit: largest change of the guide's action, as a fraction of half the range of the action.
    """

    def __init__(
        self,
        actor: Policy,
        loss: SACLoss,
        *,
        space: ActionSpace,
        editor: Policy | None,
        guide: int,
        sharpness: float | None,
        edit: float,
    ) -> None:
        super().__init__(loss, loss.target_qvalue_network_params)
        self.in_keys, self.out_keys = list(dict.fromkeys([*actor.in_keys, ADVICE])), ["action"]
        self.actor, self.editor, self.space = actor, editor, space
        self.guide, self.sharpness, self.edit = guide, sharpness, edit

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the chosen action."""
        proposals, values = self.rate(tensordict)
        chosen = values.argmax(0)
        if self.sharpness is not None and exploration_type() == ExplorationType.RANDOM:
            chosen = Categorical(self.shares(values).movedim(0, -1)).sample()
        return tensordict.set(
            "action", proposals.gather(0, expand_as_right(chosen[None], proposals[:1]))[0]
        )

    def rate(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return the proposals, the guide's first, [P, *B, A], and their values [P, *B]."""
        proposals = [
            tensordict[ADVICE][..., self.guide, :],
            self.actor(tensordict.copy())["action"],
        ]
        if self.editor is not None:
            proposals.append(self.edited(tensordict, self.editor(tensordict.copy())["action"]))
        actions = torch.stack(proposals)
        data = tensordict.select(*self.actor.in_keys).expand(len(proposals), *tensordict.batch_size)
        return actions, self.values(data.set("action", actions)).amin(0)

    def edited(self, tensordict: TensorDictBase, change: Tensor) -> Tensor:
        """Return the guide's action with a change, which is an action of the second policy."""
        low, high = self.space.bounds  # type: ignore[misc]
        return self.space.clamp(
            tensordict[ADVICE][..., self.guide, :] + self.edit * (change - (low + high) / 2)
        )

    def shares(self, values: Tensor) -> Tensor:
        """Return the probability of each proposal from their values, [P, *B]."""
        if self.sharpness is not None:
            return (self.sharpness * values).softmax(0)
        return torch.zeros_like(values).scatter(0, values.argmax(0, keepdim=True), 1)


class ProposalLoss(SACLoss):
    """TorchRL's loss of SAC with the target of IBRL, and perhaps the loss of the second policy.

    Args:
        choice: makes `Proposals` of a policy and this loss, and has the keyword `editor`.
        arguments: of TorchRL's loss.
    """

    def __init__(self, choice: partial[Proposals], arguments: dict[str, Any]) -> None:
        super().__init__(**arguments)
        self.make_proposals = partial(choice, arguments["actor_network"])
        self.editor = choice.keywords["editor"]

    @cached_property  # no submodule, because the loss holds the weights
    def proposals(self) -> Proposals:
        """The choice between the actions."""
        return self.make_proposals(self)

    def _compute_target_v2(self, tensordict: TensorDictBase) -> Tensor:
        data = tensordict.copy()
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            _, values = self.proposals.rate(data["next"])
            shares = self.proposals.shares(values)
            self.guide_share = shares[0].mean()
            data["next", self.value_estimator.tensor_keys.value] = (
                (shares * values).sum(0).unsqueeze(-1)
            )
            target: Tensor = self.value_estimator.value_estimate(data).squeeze(-1)
        return target

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of the policy plus that of the second one, and TorchRL's other values."""
        loss, values = super().actor_loss(tensordict)
        if self.editor is None:
            return loss, values
        change, log_prob = self.editor.get_dist(tensordict).draw()
        data = tensordict.select(*self.qvalue_network.in_keys, strict=False)
        data.set("action", self.proposals.edited(tensordict, change))
        rated = self._vmap_qnetworkN0(data, self._cached_detached_qvalue_params)
        value = rated["state_action_value"].amin(0).squeeze(-1)
        return loss + (self._alpha * log_prob - value).mean(), values
