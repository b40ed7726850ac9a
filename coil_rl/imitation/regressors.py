"""Regressors for imitation: their interface, a neural network, and a linear function.

Imitation needs few things of a regressor: it fits vectors to vectors from scratch, it predicts, and
its fitted state can be saved. So the learner is the same for a network, a forest or a line.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Self

import torch
from scipy import linalg
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.modules import MLP

from coil_rl.learners.encoders import Mlp
from coil_rl.ranges import Count, NonNegative, Seed, checked
from coil_rl.schedules import Linear, Schedule, schedule


class Regressor(nn.Module, ABC):
    """Regression from vectors to vectors; the fitted state is the `state_dict`.

    The constructor makes a specification; `fresh` makes a regressor that can be fitted. It predicts
    by operations of torch, so that it can be exported.
    """

    @abstractmethod
    def fresh(self, inputs: int, outputs: int) -> Self:
        """Return an unfitted regressor for vectors of these lengths, which predicts 0."""

    @abstractmethod
    def fit(self, x: Tensor, y: Tensor) -> None:
        """Fit y [N, outputs] to x [N, inputs] from scratch.

        The result depends on these and on the arguments of the constructor only.
        """

    @abstractmethod
    def forward(self, x: Tensor) -> Tensor:
        """Predict y [*batch, outputs] for x [*batch, inputs]."""


@checked
class NetworkRegressor(Regressor):
    """A tanh network, fitted to standardised inputs and outputs by least squares with Adam.

    Args:
        hidden: widths of the hidden layers.
        epochs: passes over the data, at least 1.
        minibatch: samples in a minibatch, at least 1.
        learning_rate: of Adam, positive, a number or a schedule over the fit.
        seed: of the initial weights and of the order of minibatches, at least 0.

    Raises:
        ValueError: for a value out of range.
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
        epochs: Count = 100,
        minibatch: Count = 256,
        learning_rate: NonNegative | Schedule = Linear(3e-3, 0.0),
        seed: Seed = 0,
    ) -> None:
        super().__init__()
        self.learning_rate = schedule(learning_rate)
        Mlp(hidden)  # checks the widths
        if self.learning_rate(0) == 0:
            raise ValueError("learning_rate=0 must be more than 0 at the start of a fit")
        self.hidden, self.epochs, self.minibatch, self.seed = tuple(hidden), epochs, minibatch, seed

    def fresh(self, inputs: int, outputs: int) -> NetworkRegressor:
        """Return an unfitted regressor, which predicts 0."""
        fresh = NetworkRegressor(
            self.hidden,
            epochs=self.epochs,
            minibatch=self.minibatch,
            learning_rate=self.learning_rate,
            seed=self.seed,
        )
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            fresh.layers = Mlp(self.hidden).layers(inputs, outputs, gain=1.0)
        fresh.x_mean, fresh.x_scale = nn.Buffer(torch.zeros(inputs)), nn.Buffer(torch.ones(inputs))
        # A scale of 0 makes an unfitted regressor predict 0.
        fresh.y_mean = nn.Buffer(torch.zeros(outputs))
        fresh.y_scale = nn.Buffer(torch.zeros(outputs))
        return fresh

    @torch.enable_grad()
    def fit(self, x: Tensor, y: Tensor) -> None:
        """Fit y [N, outputs] to x [N, inputs] from scratch."""
        self.load_state_dict(self.fresh(x.shape[-1], y.shape[-1]).state_dict())
        for data, mean, scale in ((x, self.x_mean, self.x_scale), (y, self.y_mean, self.y_scale)):
            std = data.std(0, correction=0)
            mean.copy_(data.mean(0))
            scale.copy_(torch.where(std > 0, std, 1))
        inputs, targets = (x - self.x_mean) / self.x_scale, (y - self.y_mean) / self.y_scale
        optimiser = torch.optim.Adam(self.layers.parameters(), fused=True)
        generator = torch.Generator().manual_seed(self.seed)
        for epoch in range(self.epochs):
            for group in optimiser.param_groups:
                group["lr"] = self.learning_rate(epoch / self.epochs)
            order = torch.randperm(len(x), generator=generator).to(x.device)
            for rows in order.split(self.minibatch):
                optimiser.zero_grad()
                F.mse_loss(self.layers(inputs[rows]), targets[rows]).backward()
                optimiser.step()

    def forward(self, x: Tensor) -> Tensor:
        """Predict y [*batch, outputs] for x [*batch, inputs]."""
        return self.y_mean + self.y_scale * self.layers((x - self.x_mean) / self.x_scale)


class LinearRegressor(Regressor):
    """A linear function by least squares, in double precision.

    Example:
        >>> x = torch.rand(8, 2)
        >>> regressor = LinearRegressor().fresh(inputs=2, outputs=1)
        >>> regressor.fit(x, x[:, :1] - x[:, 1:])
        >>> regressor(torch.tensor([3.0, 1.0])).round(decimals=3)
        tensor([2.])
    """

    weights: Tensor
    bias: Tensor

    def fresh(self, inputs: int, outputs: int) -> LinearRegressor:
        """Return an unfitted regressor, which predicts 0."""
        fresh = LinearRegressor()
        fresh.weights = nn.Buffer(torch.zeros(inputs, outputs, dtype=torch.float64))
        fresh.bias = nn.Buffer(torch.zeros(outputs, dtype=torch.float64))
        return fresh

    def fit(self, x: Tensor, y: Tensor) -> None:
        """Fit y [N, outputs] to x [N, inputs] from scratch."""
        x_mean, y_mean = x.double().mean(0), y.double().mean(0)
        centred = (x.double() - x_mean).cpu().numpy(), (y.double() - y_mean).cpu().numpy()
        self.weights.copy_(torch.from_numpy(linalg.lstsq(*centred)[0]))
        self.bias.copy_(y_mean - x_mean @ self.weights)

    def forward(self, x: Tensor) -> Tensor:
        """Predict y [*batch, outputs] for x [*batch, inputs]."""
        return (x.double() @ self.weights + self.bias).to(x)
