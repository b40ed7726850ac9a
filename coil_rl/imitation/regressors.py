"""Regressors for imitation: a neural network, and any regressor of scikit-learn.

Imitation needs few things of a regressor: it fits vectors to vectors from scratch, it predicts, and
its fitted state can be saved. So the learner is the same for a network, a forest or a line.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, clone, is_regressor
from sklearn.ensemble import (
    ExtraTreesRegressor,
    GradientBoostingRegressor,
    RandomForestRegressor,
)
from sklearn.utils import get_tags
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.modules import MLP

from coil_rl.envs.limits import LARGEST_SEED, check_range
from coil_rl.errors import UserError
from coil_rl.imitation import archive
from coil_rl.learners.encoders import Mlp
from coil_rl.schedules import Linear, Schedule, schedule


class Regressor(nn.Module, ABC):
    """Regression from vectors to vectors; the fitted state is the `state_dict`.

    The constructor makes a specification; `fresh` makes a regressor that can be fitted.
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
        epochs: int = 100,
        minibatch: int = 256,
        learning_rate: float | Schedule = Linear(3e-3, 0.0),
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.learning_rate = schedule(learning_rate)
        Mlp(hidden)  # checks the widths
        check_range(1, epochs=epochs, minibatch=minibatch)
        check_range(0, above=True, learning_rate=self.learning_rate(0))
        check_range(0, LARGEST_SEED, seed=seed)
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


class SklearnRegressor(Regressor):
    """A regressor of scikit-learn, which may be a pipeline or a search.

    Its state is a tensor with the bytes of a skops archive.

    Args:
        estimator: the regressor, of which only the parameters are used; a `random_state` that is
            None is set to 0, and `n_jobs` to at most the number of processors. Anything else is a
            `ValueError`, and so are boosted trees that begin with another regressor.

    Example:
        >>> from sklearn.linear_model import LinearRegression
        >>> x = torch.rand(8, 2)
        >>> regressor = SklearnRegressor(LinearRegression()).fresh(inputs=2, outputs=1)
        >>> regressor.fit(x, x[:, :1] - x[:, 1:])
        >>> regressor(torch.tensor([3.0, 1.0])).round(decimals=3)
        tensor([2.])
    """

    def __init__(self, estimator: BaseEstimator) -> None:
        super().__init__()
        if not isinstance(estimator, BaseEstimator) or not is_regressor(estimator):
            raise ValueError(
                f"estimator={estimator!r} is not a regressor of scikit-learn, such as "
                "LinearRegression()"
            )
        self.estimator = _with_parameter(
            clone(estimator), "random_state", lambda value: 0 if value is None else value
        )
        self.estimator = _with_parameter(self.estimator, "n_jobs", _possible_jobs)
        _check_boosted(self.estimator)
        self.inputs, self.outputs = 0, 1
        self.model: BaseEstimator | None = None
        self._archive: Tensor | None = torch.empty(0, dtype=torch.uint8)

    def fresh(self, inputs: int, outputs: int) -> SklearnRegressor:
        """Return an unfitted regressor, which predicts 0.

        Args:
            inputs: length of the inputs.
            outputs: length of the outputs; more than 1 is a `ValueError` for an estimator that
                predicts one number only.
        """
        if outputs > 1 and not get_tags(self.estimator).target_tags.multi_output:
            raise ValueError(
                f"{self.estimator!r} predicts one number, but an action has {outputs} here; put it "
                "into sklearn.multioutput.MultiOutputRegressor"
            )
        fresh = SklearnRegressor(self.estimator)
        fresh.inputs, fresh.outputs = inputs, outputs
        return fresh

    def fit(self, x: Tensor, y: Tensor) -> None:
        """Fit y [N, outputs] to x [N, inputs] from scratch, in double precision.

        Data that the estimator refuses are a `UserError`.
        """
        if self.outputs == 1 and get_tags(self.estimator).target_tags.single_output:
            y = y.squeeze(-1)
        try:
            fitted = clone(self.estimator).fit(x.cpu().double().numpy(), y.cpu().double().numpy())
        except Exception as error:  # whatever a library raises
            name = type(self.estimator).__name__
            raise UserError(
                f"{name} cannot be fitted to {len(x)} samples of {x.shape[-1]} inputs "
                f"({type(error).__name__}: {error!s:.300}); change its parameters, or use another "
                "regressor"
            ) from error
        # For small batches threads cost more than they save, and they sum in random order.
        self.model = _with_parameter(fitted, "n_jobs", lambda _: 1)
        self._archive = None

    def forward(self, x: Tensor) -> Tensor:
        """Predict y [*batch, outputs] for x [*batch, inputs]."""
        if self.model is None:
            return x.new_zeros(*x.shape[:-1], self.outputs)
        rows = x.detach().reshape(-1, x.shape[-1]).cpu().numpy()
        y = _predict(self.model, rows)
        if np.size(y) != len(rows) * self.outputs:
            raise UserError(
                f"{type(self.model).__name__} predicts {np.shape(y)} for {len(rows)} rows and "
                f"{self.outputs} outputs; use another regressor"
            )
        prediction = torch.from_numpy(np.asarray(y, np.float32)).to(x)
        return prediction.reshape(*x.shape[:-1], self.outputs)

    def get_extra_state(self) -> Tensor:
        """Return the fitted regressor as bytes, [n] uint8; empty before the first fit."""
        if self._archive is None:
            self._archive = torch.frombuffer(bytearray(archive.dump(self.model)), dtype=torch.uint8)
        return self._archive

    def set_extra_state(self, state: Tensor) -> None:
        """Restore a fitted regressor from its bytes, [n] uint8.

        If that could run code or if the bytes do not fit, a `UserError` is raised.
        """
        content = state.cpu()
        model = archive.load(content.numpy().tobytes()) if len(content) else None
        inputs = getattr(model, "n_features_in_", self.inputs)
        if inputs != self.inputs:
            raise UserError(
                f"the state holds a regressor of {inputs} inputs, but there are {self.inputs} here"
            )
        if model is not None:
            try:
                prediction = _predict(model, np.zeros((3, self.inputs), np.float32))
                usable = np.size(prediction) == 3 * self.outputs and np.isfinite(prediction).all()
            except Exception as error:
                raise UserError(
                    f"the state holds a regressor that cannot predict ({type(error).__name__})"
                ) from error
            if not usable:
                raise UserError(
                    f"the state is a regressor that does not predict {self.outputs} numbers; train "
                    "again"
                )
        self.model, self._archive = model, content


def _predict(model: BaseEstimator, x: NDArray[np.float32]) -> NDArray[np.floating]:
    """Predict y for x [N, inputs].

    For forests this leaves out scikit-learn's checks, which dominate for small batches.
    """
    forest = type(model) in (RandomForestRegressor, ExtraTreesRegressor)
    if forest and x.shape[1] == model.n_features_in_ and np.isfinite(x).all():
        trees = model.estimators_
        return sum(tree.tree_.predict(x.astype(np.float32)) for tree in trees) / len(trees)
    return model.predict(x)


def _possible_jobs(jobs: object) -> object:
    """Return a number of processes that is at most that of the processors."""
    most = os.cpu_count() or 1
    return max(-most, min(jobs, most)) if isinstance(jobs, int) else jobs


def _check_boosted(estimator: BaseEstimator) -> None:
    """Raise a `ValueError` for boosted trees that could not be saved.

    Args:
        estimator: the estimator, which may hold others.
    """
    for part in (estimator, *estimator.get_params().values()):
        if not isinstance(part, GradientBoostingRegressor) or part.init in (None, "zero"):
            continue
        raise ValueError(
            f"{part!r:.200} begins with another regressor, which cannot be checked when it is "
            "loaded; leave init out, or set it to zero"
        )


def _with_parameter(
    estimator: BaseEstimator, name: str, change: Callable[[object], object]
) -> BaseEstimator:
    """Change a parameter of an estimator and of the estimators inside it.

    Args:
        estimator: the outer one.
        name: of the parameter.
        change: takes the old value and returns the new one.
    """
    changed = {}
    for key, value in estimator.get_params().items():
        if key.split("__")[-1] == name:
            changed[key] = change(value)
    return estimator.set_params(**changed)
