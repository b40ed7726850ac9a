"""A random forest as arrays: fitted by scikit-learn, predicted and restored without it."""

from __future__ import annotations

import os
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from coil_rl.errors import UserError
from coil_rl.extras import require
from coil_rl.imitation.regressors import Regressor
from coil_rl.ranges import Count, Interval, checked

MOST_TREES = 10_000
AT_ONCE = 16_384  # rows times trees, whose nodes fit into the cache
# The arrays of all trees, one after the other: dtype, and shape of a node.
ARRAYS = {
    "roots": (torch.int64, ()),  # node of each tree
    "features": (torch.int64, ()),  # by which a node is split; 0 in a leaf
    "thresholds": (torch.float64, ()),  # up to which a sample goes to the first child
    "children": (torch.int64, (2,)),  # a leaf is its own
    "values": (torch.float64, (-1,)),  # predicted in a leaf
}


@checked
class ForestRegressor(Regressor):
    """A random forest (Breiman 2001), with the fit and the predictions of scikit-learn.

    Its state is a few arrays of numbers, see `ARRAYS`; empty before the first fit.

    Args:
        n_estimators: number of trees.
        max_depth: of a tree; None: no limit.
        random_state: seed of the fit.
        n_jobs: processes of the fit, at most the number of processors.

    Raises:
        ValueError: for a value out of range.

    Example:
        >>> x = torch.rand(8, 2)
        >>> regressor = ForestRegressor(n_estimators=3).fresh(inputs=2, outputs=1)
        >>> regressor.fit(x, torch.ones(8, 1))
        >>> regressor(torch.tensor([3.0, 1.0]))
        tensor([1.])
    """

    is_network: ClassVar[bool] = False

    def __init__(
        self,
        n_estimators: Annotated[int, Interval(ge=1, le=MOST_TREES)] = 200,
        max_depth: Count | None = 20,
        random_state: Annotated[int, Interval(ge=0, le=2**32 - 1)] = 0,
        n_jobs: int = 1,
    ) -> None:
        super().__init__()
        self.options: dict[str, Any] = {
            "n_estimators": n_estimators,
            "max_depth": max_depth,
            "random_state": random_state,
            "n_jobs": max(-1, min(n_jobs, os.cpu_count() or 1)),
        }
        self.inputs, self.outputs = 0, 1
        self.arrays: dict[str, NDArray[np.number]] = {}

    def fresh(self, inputs: int, outputs: int) -> ForestRegressor:
        """Return an unfitted forest, which predicts 0."""
        fresh = ForestRegressor(**self.options)
        fresh.inputs, fresh.outputs = inputs, outputs
        return fresh

    def fit(self, x: Tensor, y: Tensor) -> None:
        """Fit y [N, outputs] to x [N, inputs] from scratch, in double precision."""
        require("a forest", "imitate", "sklearn")
        from sklearn.ensemble import RandomForestRegressor

        target = y.squeeze(-1) if self.outputs == 1 else y
        forest = RandomForestRegressor(**self.options)
        forest.fit(x.cpu().double().numpy(), target.cpu().double().numpy())
        trees = [each.tree_ for each in forest.estimators_]
        sizes = [tree.node_count for tree in trees]
        roots = np.cumsum([0, *sizes[:-1]])
        offsets = np.repeat(roots, sizes)
        left = np.concatenate([tree.children_left for tree in trees]) + offsets
        right = np.concatenate([tree.children_right for tree in trees]) + offsets
        leaf = np.concatenate([tree.children_left for tree in trees]) == -1
        own = np.arange(len(leaf))
        children = np.where(leaf, own, [left, right]).T
        self.arrays = {
            "roots": roots,
            "features": np.maximum(np.concatenate([tree.feature for tree in trees]), 0),
            "thresholds": np.concatenate([tree.threshold for tree in trees]),
            "children": np.ascontiguousarray(children),
            "values": np.concatenate([tree.value[..., 0] for tree in trees]),
        }

    def forward(self, x: Tensor) -> Tensor:
        """Predict y [*batch, outputs] for x [*batch, inputs]; a `ValueError` if not finite."""
        if not self.arrays:
            return x.new_zeros(*x.shape[:-1], self.outputs)
        rows = x.detach().reshape(-1, self.inputs).float().cpu().numpy()
        if not np.isfinite(rows).all():
            raise ValueError("a forest predicts for finite inputs only")
        # One tree after the other, as scikit-learn adds them, so that the sums are the same.
        total = np.cumsum(self.arrays["values"][self._leaves(rows)], 0)[-1]
        prediction = torch.from_numpy(total / len(self.arrays["roots"])).to(x)
        return prediction.reshape(*x.shape[:-1], self.outputs)

    def _leaves(self, rows: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return the leaf [trees, N] that each row [N, inputs] reaches in each tree."""
        parts = 1 + self.arrays["roots"].size * len(rows) // AT_ONCE
        trees = np.array_split(self.arrays["roots"], min(parts, self.arrays["roots"].size))
        return np.concatenate([self._reached(rows, roots) for roots in trees])

    def _reached(self, rows: NDArray[np.float32], roots: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the leaf [trees, N] that each row reaches from the roots of some trees."""
        features, thresholds = self.arrays["features"], self.arrays["thresholds"]
        children, flat = self.arrays["children"].reshape(-1), rows.reshape(-1)
        first = np.arange(len(rows)) * rows.shape[1]
        nodes = np.repeat(roots[:, None], len(rows), 1)
        while True:
            right = flat.take(first + features.take(nodes)) > thresholds.take(nodes)
            following = children.take(2 * nodes + right)
            if np.array_equal(following, nodes):
                return nodes
            nodes = following

    def get_extra_state(self) -> dict[str, Tensor]:
        """Return the arrays of the fitted forest; none before the first fit."""
        return {name: torch.from_numpy(array) for name, array in self.arrays.items()}

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Restore a fitted forest from its arrays; a `UserError` if they are none."""
        if not isinstance(state, dict) or not self._is_forest(state):
            raise UserError(
                f"the state is not a forest of {self.inputs} inputs and {self.outputs} outputs; "
                "train again"
            )
        self.arrays = {name: each.cpu().contiguous().numpy() for name, each in state.items()}

    def _is_forest(self, state: dict[str, Tensor]) -> bool:
        """Return whether arrays are of trees: children come after their parents."""
        if not state:
            return True
        if state.keys() != ARRAYS.keys() or not all(map(torch.is_tensor, state.values())):
            return False
        nodes, trees = len(state["features"].reshape(-1)), len(state["roots"].reshape(-1))
        for name, (dtype, shape) in ARRAYS.items():
            rows = trees if name == "roots" else nodes
            size = (rows, *(self.outputs if each == -1 else each for each in shape))
            if state[name].dtype != dtype or state[name].shape != size:
                return False
        own = torch.arange(nodes)[:, None]
        children, leaf = state["children"], (state["children"] == own).all(-1)
        ordered = leaf | ((children > own) & (children < nodes)).all(-1)
        exist = (state["features"] >= 0) & (state["features"] < self.inputs)
        begin = (state["roots"] >= 0) & (state["roots"] < nodes)
        numbers = state["values"].isfinite().all() and not state["thresholds"].isnan().any()
        return bool(trees and ordered.all() and exist.all() and begin.all() and numbers)
