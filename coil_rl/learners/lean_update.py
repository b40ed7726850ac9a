"""The passes of PPO over a batch as functions of tensors, with the numbers of `ClippedLoss`.

Normalised observations, which do not depend on the weights, are computed once for the whole batch,
and what is only reported at the end, for all minibatches together.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from coil_rl.learners.clipped_loss import ClippedLoss
from coil_rl.learners.gradient import GradientStep
from coil_rl.learners.lean_policy import (
    Entries,
    LeanPolicy,
    SquashedDensity,
    networks_of,
)
from coil_rl.learners.minibatches import Minibatches

OF_STEPS = ("action", "action_log_prob", "advantage", "value_target")


class LeanUpdate:
    """The steps of the optimiser for a batch.

    Args:
        policy: for which `covers` is true, with the others.
        critic: writes `state_value`.
        loss: of policy and critic.
        sampler: divides the batch.
        gradient: takes the steps.
    """

    def __init__(
        self,
        policy: Any,
        critic: Any,
        loss: ClippedLoss,
        sampler: Minibatches,
        gradient: GradientStep,
    ) -> None:
        self.policy, self.critic = LeanPolicy(policy), networks_of(critic) or []
        self.loss, self.sampler, self.gradient = loss, sampler, gradient
        networks = [self.policy.head, *self.critic]
        self.read = list(dict.fromkeys(key for each in networks for key in each.in_keys))
        self.inputs = [each for each in self.policy.inputs if set(each.out_keys) & set(self.read)]

    @classmethod
    def of(
        cls, policy: Any, critic: Any, loss: Any, sampler: Minibatches, gradient: GradientStep
    ) -> "LeanUpdate | None":
        """Return the lean form of an update with only PPO's own losses; None if it has none.

        Arguments are those of the constructor, of any kind.
        """
        covered = cls.covers(policy, critic, loss, sampler)
        return cls(policy, critic, loss, sampler, gradient) if covered else None

    @staticmethod
    def covers(policy: Any, critic: Any, loss: Any, sampler: Minibatches) -> bool:
        """Return whether an update has this form.

        It has for PPO's own loss of a policy with a lean form. The entropy of a bonus must have a
        formula: an estimate takes random numbers.
        """
        return (
            type(loss) is ClippedLoss
            and type(sampler) is Minibatches
            and LeanPolicy.covers(policy)
            and bool(networks_of(critic))
            and (
                not loss.entropy_bonus
                or not isinstance(LeanPolicy(policy).density, SquashedDensity)
            )
        )

    def __call__(self, rows: TensorDictBase, weights: Mapping[str, float]) -> dict[str, float]:
        """Take the steps, and return the means of losses and other values by name.

        Args:
            rows: [N] with what policy and critic read, `action` (the sample), `action_log_prob`,
                `advantage` and `value_target`.
            weights: of the losses.
        """
        columns, losses, seen = self._columns(rows), list[Tensor](), list[Any]()
        for order in self.sampler.orders(rows):
            for index in order.split(self.sampler.size(rows)):
                minibatch = Entries(
                    {key: column.index_select(0, index) for key, column in columns.items()}
                )
                found = self._losses(minibatch, seen)
                self.gradient.take(found, weights)
                losses.append(torch.stack([each.detach() for each in found.values()]))
        return self._report(found, torch.stack(losses), seen)

    @torch.no_grad()
    def _columns(self, rows: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Return what the losses read of all steps, [N, ...] by key."""
        entries = Entries({key: rows[key] for each in self.inputs for key in each.in_keys})
        for module in self.inputs:
            module(entries)
        observed = {key: entries[key] if key in entries else rows[key] for key in self.read}
        return observed | {key: rows[key] for key in OF_STEPS}

    def _losses(self, minibatch: Entries, seen: list[Any]) -> dict[str, Tensor]:
        """Return the losses of a minibatch [N] by name; `seen` gets what is reported later."""
        loss, density, target = self.loss, self.policy.density, minibatch["value_target"]
        self.policy.head(minibatch)
        parameters = density.parameters(minibatch)
        log_prob = density.log_prob(parameters, minibatch["action"])
        log_ratio = (log_prob - minibatch["action_log_prob"]).unsqueeze(-1)
        for module in self.critic:
            module(minibatch)
        value = minibatch["state_value"]
        losses = {"loss_objective": loss.objective(log_ratio, minibatch["advantage"])}
        if loss.entropy_bonus:
            entropy = density.entropy(parameters)
            losses["entropy"] = entropy.mean()
            losses["loss_entropy"] = loss._weighted_loss_entropy(entropy).mean()
        losses["loss_critic"] = loss.error(value, target)
        seen.append((log_ratio.detach(), value.detach(), target))
        return losses

    def _report(self, names: Iterable[str], losses: Tensor, seen: list[Any]) -> dict[str, float]:
        """Return the means over the minibatches, in the order of `ClippedLoss`."""
        log_ratio, value, target = (torch.stack(column) for column in zip(*seen, strict=True))
        means = dict(zip(names, losses.mean(0), strict=True))
        report = {"loss_objective": means.pop("loss_objective"), **self.loss.of_policy(log_ratio)}
        report |= means | self.loss.of_fit(log_ratio, value, target)
        return {name: float(each.mean()) for name, each in report.items()}
