"""A network as a regressor, by behavioural cloning."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictParams
from torch import Tensor
from torchrl.modules import MLP
from torchrl.objectives import BCLoss

from coil_rl.imitation.regressor import Regressor
from coil_rl.learners.networks import Keyed, tanh_layers
from coil_rl.schedules import Schedule, schedule


class _Loss(BCLoss):
    target_actor_network_params: TensorDictParams  # TorchRL warns of losses that do not say so


class Network(Regressor):
    """A tanh network, fitted by least squares with Adam.

    It learns from and to numbers of mean 0 and standard deviation 1, so that no entry counts more for its unit.
    TorchRL's `BCLoss` of a policy without a spread is the squared error. With a spread it would be the likelihood,
    which has the same best mean where the spread is the same in every state.

    Args:
        hidden: widths of the hidden layers.
        epochs: passes over the data.
        minibatch: samples in a step.
        learning_rate: of Adam, a number or a schedule over the fit.
        seed: of the weights at the start and of the order of minibatches.

    Raises:
        ValueError: for a value outside its range, naming it.

    Example:
        >>> x = torch.rand(256, 2)
        >>> network = Network(epochs=200).fresh(inputs=2, outputs=1)
        >>> network.fit(x, x[:, :1] - x[:, 1:])
        >>> bool((network(torch.tensor([0.9, 0.4])) - 0.5).abs() < 0.05)
        True
    """

    layers: MLP
    x_mean: Tensor
    x_scale: Tensor
    y_mean: Tensor
    y_scale: Tensor

    def __init__(
        self,
        hidden: Sequence[int] = (64, 64),
        *,
        epochs: int = 100,
        minibatch: int = 256,
        learning_rate: float | Schedule = 1e-3,
        seed: int = 0,
    ) -> None:
        super().__init__()
        for name, value in {"hidden": min(hidden, default=1), "epochs": epochs, "minibatch": minibatch}.items():
            if value < 1:
                raise ValueError(f"{name}={value} must be at least 1")
        if not 0 <= seed < 2**63:
            raise ValueError(f"seed={seed} must be at least 0 and at most {2**63 - 1}")
        self.learning_rate = schedule(learning_rate)
        if not self.learning_rate(0) > 0:
            raise ValueError(f"learning_rate={self.learning_rate(0)} must be more than 0")
        self.hidden, self.epochs, self.minibatch, self.seed = tuple(hidden), epochs, minibatch, seed

    def fresh(self, inputs: int, outputs: int) -> Network:
        """One that has not learned and predicts 0."""
        made = Network(
            self.hidden,
            epochs=self.epochs,
            minibatch=self.minibatch,
            learning_rate=self.learning_rate,
            seed=self.seed,
        )
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            made.layers = tanh_layers(inputs, outputs, self.hidden, gain=1.0)
        for name, value in {
            "x_mean": torch.zeros(inputs), "x_scale": torch.ones(inputs),
            "y_mean": torch.zeros(outputs), "y_scale": torch.zeros(outputs),
        }.items():  # fmt: skip
            made.register_buffer(name, value)
        return made

    @torch.enable_grad()
    def fit(self, x: Tensor, y: Tensor) -> None:
        """Forget everything and learn y [N, outputs] from x [N, inputs]."""
        self.load_state_dict(self.fresh(x.shape[-1], y.shape[-1]).state_dict())
        for name, data in {"x": x, "y": y}.items():
            getattr(self, f"{name}_mean").copy_(data.mean(0))
            scale = data.std(0, correction=0)
            getattr(self, f"{name}_scale").copy_(torch.where(scale > 0, scale, 1))
        standard = {"input": (x - self.x_mean) / self.x_scale, "action": (y - self.y_mean) / self.y_scale}
        pairs = TensorDict(standard, x.shape[:1], device=x.device)
        loss = _Loss(Keyed(self.layers, ["input"], ["action"]), loss_function="mse")
        optimiser = torch.optim.Adam(self.layers.parameters(), fused=True)
        generator = torch.Generator().manual_seed(self.seed)
        for epoch in range(self.epochs):
            for group in optimiser.param_groups:
                group["lr"] = self.learning_rate(epoch / self.epochs)
            order = torch.randperm(len(pairs), generator=generator).to(x.device)
            for rows in order.split(self.minibatch):
                optimiser.zero_grad()
                loss(pairs[rows])["loss_bc"].backward()
                optimiser.step()

    def forward(self, x: Tensor) -> Tensor:
        """[*batch, inputs] to [*batch, outputs]."""
        y: Tensor = self.y_mean + self.y_scale * self.layers((x - self.x_mean) / self.x_scale)
        return y
