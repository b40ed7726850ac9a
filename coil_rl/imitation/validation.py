"""Validation of a regressor on samples that it was not fitted to."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from coil_rl.errors import UserError
from coil_rl.extras import require
from coil_rl.imitation.regressors import Regressor
from coil_rl.output import progress

MAX_FOLDS = 10
TEST_SHARE = 0.2  # of the random split
MIN_SAMPLES = 10

Split = tuple[NDArray[np.int64], NDArray[np.int64]]  # rows for training, rows for testing


def cross_validate(
    regressor: Regressor, x: Tensor, y: Tensor, groups: Tensor | None = None, seed: int = 0
) -> dict[str, float]:
    """Return the errors of fresh regressors on a random fifth and on left-out tracks.

    They are `mse_random_split`, `r2_random_split` and, with groups, `mse_by_track`, `r2_by_track`:
    see `scores`.

    The paper tests on random samples. Consecutive states are nearly equal, so most of these have a
    near copy among the training samples. The error on left-out tracks is an estimate of the error
    on a new track. Too few samples, or only one track, are a `UserError`.

    Args:
        regressor: its `fresh` copies are fitted.
        x: [N, inputs].
        y: [N, outputs].
        groups: [N], the track of each sample; None: random split only.
    """
    if len(x) < MIN_SAMPLES:
        raise UserError(
            f"{len(x)} samples are too few to validate; use at least {MIN_SAMPLES}, or "
            "learner.validate=false"
        )
    require("the validation (learner.validate=true)", "imitate", "sklearn")
    from sklearn.model_selection import train_test_split

    rows = np.arange(len(x))
    splits: dict[str, list[Split]] = {
        "random_split": [train_test_split(rows, test_size=TEST_SHARE, random_state=seed)]
    }
    if groups is not None:
        splits["by_track"] = group_splits(groups)
    metrics: dict[str, float] = {}
    fits = sum(len(folds) for folds in splits.values())
    with progress(total=fits, unit="fit", desc="validate", leave=False) as bar:
        for name, folds in splits.items():
            predictions, targets = [], []
            for fold in folds:
                train, test = (torch.from_numpy(part).to(x.device) for part in fold)
                fresh = regressor.fresh(x.shape[-1], y.shape[-1]).to(x.device)
                fresh.fit(x[train], y[train])
                with torch.no_grad():
                    predictions.append(fresh(x[test]))
                targets.append(y[test])
                bar.update()
            metrics |= scores(predictions, targets, name)
    return metrics


def group_splits(groups: Tensor) -> list[Split]:
    """Return at most ten splits of rows; each row is tested once, no group is on both sides.

    Args:
        groups: [N], group number of each row; a single group is a `UserError`.
    """
    labels = groups.cpu().numpy()
    count = len(np.unique(labels))
    if count < 2:
        raise UserError(
            "all samples are from one track, so no track can be left out; set "
            "learner.group_key=null"
        )
    from sklearn.model_selection import GroupKFold

    return list(GroupKFold(min(count, MAX_FOLDS)).split(labels, groups=labels))


def scores(predictions: Sequence[Tensor], targets: Sequence[Tensor], name: str) -> dict[str, float]:
    """Return mean squared error and R^2 as `mse_NAME` and `r2_NAME`.

    The error is the mean over the A outputs. R^2 is that of all outputs together: outputs that
    never vary, such as choices that a guide never takes, count by their errors only. Where all
    targets are constant, R^2 is 1 for correct predictions and else 0.

    Args:
        predictions: [N, A] of each fold.
        targets: [N, A] of each fold.
    """
    y, predicted = (torch.cat(list(each)).cpu().numpy() for each in (targets, predictions))
    errors = (y - predicted) ** 2
    unexplained, spread = errors.sum(0), ((y - y.mean(0)) ** 2).sum(0)
    r2 = np.mean(unexplained == 0)
    if spread.any():
        r2 = np.average(1 - unexplained / np.where(spread, spread, 1), weights=spread)
    return {f"mse_{name}": float(errors.mean(0).mean()), f"r2_{name}": float(r2)}
