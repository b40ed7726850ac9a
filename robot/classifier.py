"""Training and evaluation of the cone classifier.

It consists of support vector machines on the features of LiDAR clusters.
"""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.stats import binomtest
from sklearn.model_selection import GroupKFold, cross_validate
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC, OneClassSVM

from coil_rl import UserError, write_text
from coil_rl.envs import ConeClassifier
from coil_rl.envs.robot import RANGE_MIN, SimulatedDrive
from coil_rl.envs.robot.clusters import (
    FEATURES,
    Array,
    Integers,
    measure,
    points_of,
    single_linkage,
)
from coil_rl.for_guests import LARGEST_NUMBERS, read_text

Flags = NDArray[np.bool_]
# Ranges [N, P] m, and their bearings, [P] or [N, P] radians.
Scans = tuple[NDArray[np.floating], NDArray[np.floating]]

FOLDS = 5
EVERY = 4  # scans, as neighbouring scans are nearly equal
UNUSUAL = 0.002  # upper bound of the share of training clusters that are no cones to the classifier
RANGE = 1.0  # m
MARGIN = 0.15  # m, points this far beyond are clustered too
RANGE_BINS = (RANGE_MIN, 0.25, 0.5, 0.75, 1.0)  # m
VISIBILITY_BINS = (0.0, 0.5, 0.999, 1.0)


@dataclass(frozen=True, eq=False)
class Training:
    """A trained classifier, and how well it tells thin from thick cones in cross-validation.

    Attributes:
        classifier: trained on all clusters.
        accuracy: [folds], share of correctly classified clusters in each fold.
        correct: number of correctly classified clusters in all folds.
        total: number of clusters.
    """

    classifier: ConeClassifier
    accuracy: Array
    correct: int
    total: int


class Share(NamedTuple):
    """A share of clusters that are classified correctly.

    Attributes:
        share: the share; NaN without any cluster.
        low: lower end of its 95 % interval (Wilson), which assumes independent clusters.
        high: upper end of it.
        wrong: number of wrongly classified clusters.
        total: number of all clusters.
    """

    share: float
    low: float
    high: float
    wrong: int
    total: int


def share_of(correct: int, total: int) -> Share:
    """Return the share that was classified correctly."""
    if not total:
        return Share(np.nan, np.nan, np.nan, 0, 0)
    low, high = binomtest(correct, total).proportion_ci(method="wilson")
    return Share(correct / total, float(low), float(high), total - correct, total)


def train_classifier(features: Array, thick: Flags, drives: Integers, folds: int) -> Training:
    """Train a classifier, with cross-validation over drives, as clusters of one drive are alike.

    Outliers next to a cone make unusual clusters, so a one-class machine (Schoelkopf et al. 2001)
    with a small share of exceptions tells cones from other objects.

    Args:
        features: [N, 3] m, width, depth and girth of each cluster.
        thick: [N], whether the cone is thick.
        drives: [N], group of each cluster; a group is held out as a whole and should have both
            kinds of cone.
        folds: at most the number of groups.

    Raises:
        UserError: if there is only one kind of cone, or without one fold.
    """
    if thick.all() or not thick.any():
        kind = "thick" if thick.all() else "thin"
        raise UserError(f"all clusters are of {kind} cones; the other drive is missing")
    pipeline = make_pipeline(StandardScaler(), SVC(C=100.0))
    splits = GroupKFold(folds).split(features, thick, drives)
    try:
        predicted = cross_validate(
            pipeline, features, thick, cv=splits, return_indices=True, error_score="raise"
        )
    except ValueError:
        raise UserError(
            "without one fold only one kind of cone is left; number the drives in pairs"
        ) from None
    accuracy = predicted["test_score"]
    folds_and_rows = zip(accuracy, predicted["indices"]["test"], strict=True)
    correct = round(sum(score * len(rows) for score, rows in folds_and_rows))
    (_, scaler), (_, machine) = pipeline.fit(features, thick).steps
    known = OneClassSVM(nu=UNUSUAL, gamma=machine.gamma).fit(scaler.transform(features))
    return Training(_joined(scaler, machine, known), accuracy, correct, len(features))


def _joined(scaler: StandardScaler, machine: SVC, known: OneClassSVM) -> ConeClassifier:
    """Join the machine that tells thin from thick cones and the one that knows cones."""
    machines = (machine, known)
    support = np.concatenate([each.support_vectors_ for each in machines])
    weights = block_diag(*(each.dual_coef_ for each in machines))
    intercept = np.concatenate([each.intercept_ for each in machines])
    # The value of gamma="scale" has no public name.
    return ConeClassifier(
        scaler.mean_, scaler.scale_, support, weights, intercept, float(machine._gamma)
    )


def train_on_drives(left: Sequence[Scans], right: Sequence[Scans]) -> Training:
    """Train on drives past left cones alone, which are thin, and past right cones alone.

    The k-th drives of both sides are held out together.

    Args:
        left: the scans of at least two drives past left cones.
        right: the scans of at least two drives past right cones.

    Raises:
        UserError: if there are too few drives, and as `train_classifier`.
    """
    pairs = min(len(left), len(right))
    if pairs < 2:
        raise UserError(
            f"{len(left)} drives past left cones and {len(right)} past right ones "
            "are too few to learn from; record two of each, better five"
        )
    thin, thin_drive = clusters_in_range(left, EVERY)
    thick, thick_drive = clusters_in_range(right, EVERY)
    features = np.concatenate([thin, thick])
    is_thick = np.arange(len(features)) >= len(thin)
    groups = np.concatenate([thin_drive, thick_drive]) % pairs
    return train_classifier(features, is_thick, groups, min(FOLDS, pairs))


def save_classifier(classifier: ConeClassifier, path: str | os.PathLike[str]) -> None:
    """Write a classifier as JSON."""
    # One line for each array, so that the file can be compared and read.
    lines = []
    for part in fields(classifier):
        numbers = json.dumps(getattr(classifier, part.name).tolist())
        lines.append(f'  "{part.name}": {numbers}')
    write_text(Path(path), "{\n" + ",\n".join(lines) + "\n}")


def load_classifier(path: str | os.PathLike[str]) -> ConeClassifier:
    """Read a classifier.

    Args:
        path: of a file of `save_classifier`.

    Raises:
        UserError: if the file is missing, or not a cone classifier.
    """
    try:
        classifier = ConeClassifier(**json.loads(read_text(path, LARGEST_NUMBERS)))
    except OSError as error:
        raise UserError(
            f"{path} cannot be read ({error.strerror}); give a classifier of coil_robot"
        ) from None
    except (ValueError, TypeError) as error:
        raise UserError(
            f"{path} is not a cone classifier ({error}); train one with coil-reproduce figure=25"
        ) from None
    if len(classifier.mean) != len(FEATURES):
        raise UserError(
            f"{path} has {len(classifier.mean)} features instead of {', '.join(FEATURES)}; "
            "train again"
        )
    return classifier


def clusters_in_range(drives: Sequence[Scans], every: int = 1) -> tuple[Array, Integers]:
    """Return the features of all clusters within 1 m.

    Args:
        every: only one scan of so many is used.

    Returns:
        The features, [N, 3] m, and the index of the drive, [N].
    """
    features = []
    for ranges, angles in drives:
        own_angles = np.broadcast_to(angles, ranges.shape)
        points = points_of(ranges[::every], own_angles[::every], RANGE_MIN, RANGE + MARGIN)
        clusters = measure(points, single_linkage(points))
        features.append(clusters.features[np.hypot(*clusters.centroid.T) <= RANGE])
    counts = [len(rows) for rows in features]
    return np.concatenate(features), np.repeat(np.arange(len(features)), counts)


def label_clusters(drives: Sequence[SimulatedDrive], max_distance: float = RANGE) -> pd.DataFrame:
    """Return the clusters of drives, labelled with the cone of most of their points.

    Clusters of outliers alone are left out.

    Args:
        drives: with the true cone of each range.
        max_distance: largest distance of a cluster, m.

    Returns:
        A row for each cluster, with its features in m, whether the cone is `thick`, the index of
        the `drive`, of the `scan` in it, and of the `cone` on its track, the `distance` of the
        centroid in m, and the `visibility`: the share of the cone's beams that no nearer cone
        blocks.
    """
    tables = [_label_drive(drive, max_distance).assign(drive=n) for n, drive in enumerate(drives)]
    return pd.concat(tables, ignore_index=True)


def _label_drive(drive: SimulatedDrive, max_distance: float) -> pd.DataFrame:
    """Return the rows of `label_clusters` of a drive."""
    points = points_of(drive.ranges.numpy(), drive.angles.numpy(), RANGE_MIN, max_distance + MARGIN)
    label = single_linkage(points)
    clusters = measure(points, label)
    # Number of points of each cluster on each cone; the last column is for no cone, index -1.
    votes = np.zeros((int(label.max(initial=-1)) + 1, drive.cones.shape[1] + 1), dtype=np.int64)
    np.add.at(votes, (label, drive.hit.numpy()[points.scan, points.beam]), 1)
    cone = np.where(votes[:, :-1].any(1), votes[:, :-1].argmax(1), -1)[clusters.label]
    table = pd.DataFrame(clusters.features, columns=list(FEATURES))
    table["thick"] = drive.thick.numpy()[cone]
    table["scan"], table["cone"] = clusters.scan, cone
    table["distance"] = np.hypot(*clusters.centroid.T)
    table["visibility"] = drive.visibility.numpy()[clusters.scan, cone]
    return table[(table["distance"] <= max_distance) & (cone >= 0)]


def accuracy(classifier: ConeClassifier, labelled: pd.DataFrame) -> dict[str, Share]:
    """Return the share of correctly classified clusters.

    Args:
        labelled: clusters, see `label_clusters`.

    Returns:
        The share of `all` clusters, and the shares by range and by visibility of the cone.
    """
    return _shares(labelled.assign(correct=_correct(classifier, labelled)))


def recall(
    classifier: ConeClassifier, drives: Sequence[SimulatedDrive]
) -> dict[str, dict[str, Share]]:
    """Return the share of `thin` and of `thick` cones with a correctly classified cluster.

    A cone counts if its surface is in range and at least one beam hits it.

    Args:
        drives: with the true cone of each range.

    Returns:
        For either kind, the share of `all` cones, and the shares by range and by visibility.
    """
    labelled = label_clusters(drives, RANGE + MARGIN)
    known = labelled[_correct(classifier, labelled)]
    tables = []
    for number, drive in enumerate(drives):
        offset = drive.cones[:, None] - drive.poses[:2, :, 0, None]
        distance = (offset.norm(dim=0) - drive.radius).numpy()
        visibility = drive.visibility.numpy()
        recognised = np.zeros(distance.shape, dtype=bool)
        of_drive = known[known["drive"] == number]
        recognised[of_drive["scan"], of_drive["cone"]] = True
        scan, cone = np.nonzero((distance > RANGE_MIN) & (distance <= RANGE) & (visibility > 0))
        columns = {"correct": recognised, "distance": distance, "visibility": visibility}
        table = pd.DataFrame({name: values[scan, cone] for name, values in columns.items()})
        tables.append(table.assign(thick=drive.thick.numpy()[cone]))
    cones = pd.concat(tables)
    return {"thin": _shares(cones[~cones["thick"]]), "thick": _shares(cones[cones["thick"]])}


def _correct(classifier: ConeClassifier, labelled: pd.DataFrame) -> NDArray[np.bool_]:
    """Return whether each cluster is classified correctly, [N]."""
    features = labelled[list(FEATURES)].to_numpy()
    return np.asarray(classifier.classify(features) == labelled["thick"])


def _shares(rows: pd.DataFrame) -> dict[str, Share]:
    """Return the share of `correct` rows: of all, by `distance` in m, and by `visibility`."""
    groups = {"all": rows["correct"]}
    for name, column, bins in (
        ("m", rows["distance"], RANGE_BINS),
        ("visible", rows["visibility"], VISIBILITY_BINS),
    ):
        for low, high in pairwise(bins):
            groups[f"{low:g}-{high:g} {name}"] = rows["correct"][(column > low) & (column <= high)]
    return {name: share_of(int(group.sum()), len(group)) for name, group in groups.items()}
