"""Training of the cone classifier: a support vector machine, validated drive by drive, kept as a skops file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import skops.io
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.model_selection import GroupKFold
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

from coil_rl.envs.robot.clusters import FEATURES
from coil_rl.envs.robot.cone_classifier import ConeClassifier
from coil_rl.errors import UserError
from coil_rl.files import whole_file
from coil_rl.robot.labelling import Scans, one_sided

Array = NDArray[np.float64]
FOLDS = 5
EVERY = 4


@dataclass(frozen=True, eq=False)
class Training:
    """A trained classifier and how well others like it did on drives that they did not learn from.

    Attributes:
        pipeline: the standardisation and the support vector machine, learned from everything.
        accuracy: [folds], share of the clusters of left-out drives that were told right.
        right: how many of them all.
        total: of how many.
    """

    pipeline: Pipeline
    accuracy: Array
    right: int
    total: int


def train_classifier(
    features: Array,
    thick: NDArray[np.bool_],
    drives: NDArray[np.int64],
    folds: int = FOLDS,
    C: float = 100.0,
    gamma: float | str = "scale",
) -> Training:
    """Learn to tell thick cones from thin ones.

    Neighbouring scans show nearly the same, so a fold leaves out whole drives, never single clusters.

    Args:
        features: [N, 3] m, width, depth and girth of each cluster.
        thick: [N], which are of thick cones.
        drives: [N], from which drive. A drive past left cones and one past right cones that share a number are left out
            together, so that both kinds are tested.
        folds: of the cross-validation.
        C: how much an error costs against a wide margin.
        gamma: of the kernel, as scikit-learn has it.

    Raises:
        UserError: if there are fewer drives than folds, or only one kind of cone.
    """
    found = len(np.unique(drives))
    if found < max(2, folds):
        raise UserError(f"{found} drives are too few for {folds} folds; record more, or set folds to at most {found}")
    if thick.all() or not thick.any():
        raise UserError(f"all clusters are of {'thick' if thick.all() else 'thin'} cones; the other drive is missing")
    pipeline = make_pipeline(StandardScaler(), SVC(C=C, gamma=gamma))
    right = []
    for train, test in GroupKFold(folds).split(features, thick, drives):
        if len(np.unique(thick[train])) < 2:
            raise UserError("without one fold of drives only one kind of cone is left; number the drives in pairs")
        fitted = clone(pipeline).fit(features[train], thick[train])
        right.append(fitted.predict(features[test]) == thick[test])
    accuracy = np.array([fold.mean() for fold in right])
    return Training(pipeline.fit(features, thick), accuracy, sum(int(fold.sum()) for fold in right), len(features))


def train_on_drives(left: Sequence[Scans], right: Sequence[Scans], folds: int = FOLDS, every: int = EVERY) -> Training:
    """Learn from drives past left cones alone and drives past right cones alone: nobody has to label anything.

    Args:
        left: scans of the former.
        right: scans of the latter; the k-th drives of both are left out together.
        folds: of the cross-validation, at most.
        every: of so many scans one is learned from, for neighbouring ones show nearly the same.

    Raises:
        UserError: as `train_classifier`.
    """
    if min(len(left), len(right)) < 2:
        found = f"{len(left)} drives past left cones and {len(right)} past right ones"
        raise UserError(f"{found} are too few to learn from; record two of each, better five")
    pairs = min(len(left), len(right))
    thin, thick = one_sided(left, every), one_sided(right, every)
    features = np.concatenate([thin.features, thick.features])
    kind = np.arange(len(features)) >= len(thin.features)
    return train_classifier(features, kind, np.concatenate([thin.drive, thick.drive]) % pairs, min(folds, pairs))


def cone_classifier(pipeline: Pipeline) -> ConeClassifier:
    """The numbers of a fitted pipeline, which decide the same without scikit-learn."""
    scaler, machine = (step for _, step in pipeline.steps)
    # What "scale" stood for when it was fitted has no public name.
    return ConeClassifier(
        mean=scaler.mean_,
        scale=scaler.scale_,
        support=machine.support_vectors_,
        weights=machine.dual_coef_[0],
        intercept=float(machine.intercept_[0]),
        gamma=float(machine._gamma),
    )


def save_classifier(pipeline: Pipeline, path: str | os.PathLike[str]) -> None:
    """Write a fitted pipeline as a skops file."""
    with whole_file(path) as unfinished:
        skops.io.dump(pipeline, unfinished)


def load_classifier(path: str | os.PathLike[str]) -> ConeClassifier:
    """Read a skops file of `save_classifier`.

    Raises:
        UserError: if it is not there, cannot be read, holds anything that could run code or is no cone classifier.
    """
    try:
        pipeline = skops.io.load(Path(path), trusted=[])
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}); give a classifier of coil_rl.robot") from None
    except Exception as error:
        raise UserError(f"{path} holds no classifier to be trusted ({type(error).__name__}); train again") from None
    if not _is_cone_classifier(pipeline):
        raise UserError(f"{path} holds a {type(pipeline).__name__}, not a fitted cone classifier; train one")
    return cone_classifier(pipeline)


def _is_cone_classifier(pipeline: object) -> bool:
    if not isinstance(pipeline, Pipeline) or [type(step) for _, step in pipeline.steps] != [StandardScaler, SVC]:
        return False
    scaler, machine = (step for _, step in pipeline.steps)
    fitted = hasattr(machine, "support_vectors_") and hasattr(scaler, "mean_")
    return bool(fitted and machine.kernel == "rbf" and machine.n_features_in_ == len(FEATURES))
