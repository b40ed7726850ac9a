"""What the learners with replay share: steps of the past, an optimiser, and slow copies of what judges."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule, SoftUpdate

from coil_rl.learners.limits import check_numbers
from coil_rl.learners.replay import Replay
from coil_rl.schedules import Schedule, schedule


class OffPolicy:
    """Replay, optimiser and the update; what it is that they minimise is the business of each learner.

    Such a learner names the losses that it minimises the sum of, `minimised`, and what of TorchRL's losses it reports,
    `reported`.

    Args:
        env: as for `Replay`.
        in_keys: what is observed.
        loss: TorchRL's, with networks and their slow copies.
        learning_rate: of Adam, a number or a schedule over the run.
        gamma: discount.
        tau: share of the way to the networks that their slow copies go after each minibatch.
        max_grad_norm: gradients are scaled down to this norm, those of all networks together.
        replay: everything else as for `Replay`.

    Attributes:
        keys: what a batch must hold.

    Raises:
        ValueError: for a value outside its range, or as `Replay`.
    """

    minimised: tuple[str, ...]
    reported: tuple[str, ...]

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[str],
        loss: LossModule,
        *,
        learning_rate: float | Schedule,
        gamma: float,
        tau: float,
        max_grad_norm: float,
        **replay: Any,
    ) -> None:
        self.learning_rate = schedule(learning_rate)
        check_numbers(0, 1, gamma=gamma, tau=tau)
        check_numbers(0, learning_rate=self.learning_rate(0))
        check_numbers(0, above=True, max_grad_norm=max_grad_norm)
        self.replay = Replay(env, in_keys, **replay)
        self.keys = self.replay.keys
        self.loss = loss
        self.loss.make_value_estimator(gamma=gamma)
        self.target = SoftUpdate(self.loss, tau=tau)
        self.max_grad_norm = max_grad_norm
        self.parameters = list(self.loss.parameters())
        self.optimiser = torch.optim.Adam(self.parameters, lr=self.learning_rate(0), fused=True)

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Keep the steps of a batch, and learn from steps of the past.

        Args:
            batch: [*B, T] with `keys`. A truncated episode counts as going on.
            progress: share of the run that is over, for the schedules.

        Returns:
            Means over the minibatches of what is `reported`, 0 before it begins to learn; how many `minibatches` there
            were; the steps that are `kept`; the learning rate; and what `describe` says.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate(progress)
        self.replay.add(batch)
        reports, minibatch = [], None
        for minibatch in self.replay.draws():
            reports.append(self.learn(minibatch))
        means = {
            name: float(torch.stack([report[name] for report in reports]).mean()) if reports else 0.0
            for name in self.reported
        }
        return means | {
            **self.describe(minibatch),
            "minibatches": float(len(reports)),
            "kept": float(len(self.replay)),
            "learning_rate": self.learning_rate(progress),
        }

    def learn(self, minibatch: TensorDictBase) -> TensorDictBase:
        """One step of the optimiser; returns what TorchRL says of the minibatch."""
        losses = self.loss(minibatch)
        self.optimiser.zero_grad()
        sum(losses[name] for name in self.minimised).backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, self.max_grad_norm)
        self.optimiser.step()
        self.target.step()
        learned: TensorDictBase = losses.detach()
        return learned

    def describe(self, minibatch: TensorDictBase | None) -> dict[str, float]:
        """What else is worth logging, by the last minibatch of an update; None before it begins to learn."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Everything an update depends on besides the batch."""
        return {
            "loss": self.loss.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "replay": self.replay.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over a state of `state_dict`."""
        self.loss.load_state_dict(state["loss"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.replay.load_state_dict(state["replay"])
