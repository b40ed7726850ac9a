"""A random forest as arrays: fitted by scikit-learn, predicted and restored without it."""

from __future__ import annotations

import os
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from coil_rl.errors import UserError
from coil_rl.extras import require
from coil_rl.imitation.regressors import Regressor
from coil_rl.ranges import Count, Interval, checked

MOST_TREES, MOST_DEPTH = 10_000, 1_000
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

    It predicts by operations of torch, so that it can be exported as a network can.

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
        self.inputs, self.outputs, self.depth = 0, 1, 0
        self.arrays: dict[str, Tensor] = {}

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
        arrays = {
            "roots": roots,
            "features": np.maximum(np.concatenate([tree.feature for tree in trees]), 0),
            "thresholds": np.concatenate([tree.threshold for tree in trees]),
            "children": np.ascontiguousarray(children),
            "values": np.concatenate([tree.value[..., 0] for tree in trees]),
        }
        self.arrays = {name: torch.from_numpy(array) for name, array in arrays.items()}
        self.depth = max(tree.max_depth for tree in trees)

    def forward(self, x: Tensor) -> Tensor:
        """Predict y [*batch, outputs] for x [*batch, inputs]; a `ValueError` if not finite."""
        if not self.arrays:
            return x.new_zeros(*x.shape[:-1], self.outputs)
        rows = x.detach().reshape(-1, self.inputs).float().cpu()
        if torch.compiler.is_exporting():  # an exported function cannot raise
            prediction = self._predicted(rows)
        elif not rows.isfinite().all():
            raise ValueError("a forest predicts for finite inputs only")
        else:
            parts = rows.split(max(1, AT_ONCE // len(self.arrays["roots"])))
            prediction = torch.cat([self._predicted(part) for part in parts])
        return prediction.to(x).reshape(*x.shape[:-1], self.outputs)

    def _predicted(self, rows: Tensor) -> Tensor:
        """Return the prediction [N, outputs] for rows [N, inputs]."""
        features, thresholds = self.arrays["features"], self.arrays["thresholds"]
        children, roots = self.arrays["children"].reshape(-1), self.arrays["roots"]
        count, trees, numbers = rows.shape[0], len(roots), rows.reshape(-1)
        # For each row and tree, which take half of the time in one dimension.
        first = (torch.arange(count) * self.inputs)[:, None].expand(-1, trees).reshape(-1)
        nodes = roots.repeat(count)
        for _ in range(self.depth):
            chosen = numbers.index_select(0, first + features.index_select(0, nodes))
            right = chosen.double() > thresholds.index_select(0, nodes)
            nodes = children.index_select(0, 2 * nodes + right)
        leaves = self.arrays["values"].index_select(0, nodes).reshape(count, trees, -1)
        # One tree after the other, as scikit-learn adds them, so that the sums are the same.
        return leaves.cumsum(1)[:, -1] / trees

    def get_extra_state(self) -> dict[str, Tensor]:
        """Return the arrays of the fitted forest; none before the first fit."""
        return dict(self.arrays)

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Restore a fitted forest from its arrays; a `UserError` if they are none."""
        if not isinstance(state, dict) or not self._is_forest(state):
            raise UserError(
                f"the state is not a forest of {self.inputs} inputs and {self.outputs} outputs; "
                "train again"
            )
        self.arrays = {name: each.cpu().contiguous() for name, each in state.items()}
        self.depth = self._depth()
        if self.depth > MOST_DEPTH:
            raise UserError(f"the state is a forest of more than {MOST_DEPTH} levels; train again")

    def _depth(self) -> int:
        """Return the number of steps from a root to the deepest leaf, or too many."""
        if not self.arrays:
            return 0
        children, nodes = self.arrays["children"], self.arrays["roots"].unique()
        for depth in range(MOST_DEPTH + 1):
            inner = nodes[children[nodes, 0] != nodes]
            if not len(inner):
                return depth
            nodes = children[inner].unique()
        return MOST_DEPTH + 1

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
