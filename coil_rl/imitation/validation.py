"""How well a regressor does on samples that it did not learn from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.metrics import mean_squared_error, r2_score
from sklearn.model_selection import GroupKFold, train_test_split
from torch import Tensor
from tqdm import tqdm

from coil_rl.errors import UserError
from coil_rl.imitation.regressor import Regressor

FOLDS = 10
TEST_SHARE = 0.2  # of the random split
FEWEST = 10

Split = tuple[NDArray[np.int64], NDArray[np.int64]]


def cross_validated(
    regressor: Regressor, x: Tensor, y: Tensor, groups: Tensor | None = None, seed: int = 0
) -> dict[str, float]:
    """The errors of fresh copies of a regressor on what they did not learn from.

    The paper draws the samples to test on at random, here a fifth of them. Consecutive states are nearly the same, so
    nearly each of these has its twin among the samples learned from. The error on whole tracks that were left out is
    what may be expected of a new track: each of ten tracks or fewer is left out once, of more a tenth at a time.

    Args:
        regressor: `fresh` ones are fitted, itself it stays as it is.
        x: [N, inputs].
        y: [N, outputs].
        groups: [N], the track of each sample; none leaves out the second kind.
        seed: of the draw.

    Returns:
        `mse_random_split`, `r2_random_split` and, with groups, `mse_by_track`, `r2_by_track`: see `scores`.

    Raises:
        UserError: if there are too few samples, or only one track.
    """
    if len(x) < FEWEST:
        raise UserError(f"{len(x)} samples are too few to validate; gather {FEWEST}, or set learner.validate=false")
    rows = np.arange(len(x))
    splits: dict[str, list[Split]] = {"random_split": [train_test_split(rows, test_size=TEST_SHARE, random_state=seed)]}
    if groups is not None:
        splits["by_track"] = group_splits(groups)
    found: dict[str, float] = {}
    with tqdm(total=sum(map(len, splits.values())), unit="fit", desc="validate", leave=False) as bar:
        for name, parts in splits.items():
            said, true = [], []
            for train, test in parts:
                learned, left_out = (torch.from_numpy(part).to(x.device) for part in (train, test))
                fresh = regressor.fresh(x.shape[-1], y.shape[-1]).to(x.device)
                fresh.fit(x[learned], y[learned])
                with torch.no_grad():
                    said.append(fresh(x[left_out]))
                true.append(y[left_out])
                bar.update()
            found |= scores(said, true, name)
    return found


def group_splits(groups: Tensor) -> list[Split]:
    """Rows to learn from and rows to test on, such that no group is in both and each row is tested once.

    Args:
        groups: [N], whole numbers.

    Raises:
        UserError: if there is only one group.
    """
    labels = groups.cpu().numpy()
    count = len(np.unique(labels))
    if count < 2:
        raise UserError(
            "all samples are from one track, so none can be left out to validate; set learner.group_key=null"
        )
    return list(GroupKFold(min(count, FOLDS)).split(labels, groups=labels))


def scores(said: Sequence[Tensor], true: Sequence[Tensor], name: str) -> dict[str, float]:
    """Mean squared error and R^2, the explained share of the variance, of all parts together.

    Args:
        said: [N, A] each, predictions.
        true: [N, A] each. Where it is constant, R^2 is 1 if all predictions are right and else 0.
        name: of the split.

    Returns:
        `mse_NAME` and `r2_NAME`, means over the A numbers.
    """
    numbers = (torch.cat(list(true)).cpu().numpy(), torch.cat(list(said)).cpu().numpy())
    return {f"mse_{name}": float(mean_squared_error(*numbers)), f"r2_{name}": float(r2_score(*numbers))}
