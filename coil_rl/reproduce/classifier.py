"""Figure 25 of the paper: features of thin and thick cones, and the accuracy of their classifier."""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path

import numpy as np
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike
from sklearn.decomposition import PCA
from sklearn.preprocessing import StandardScaler
from tqdm import tqdm

from coil_rl.envs.recordings.reading import read_recording
from coil_rl.envs.robot.clusters import FEATURES, Array
from coil_rl.envs.robot.drives import labelled_drive, record_labelling_drives
from coil_rl.report import markdown_table, style, write_csv
from coil_rl.reproduce.result import NO_RUNS, PAGES, Result, Runs
from coil_rl.robot import classifier as cones

PAGE = PAGES["figure_25"]
PAPER_ACCURACY = cones.share_of(*PAGE["paper"])
DRAW_EVERY = 4  # scans
ARROW_LENGTH = 2.2  # of a standard deviation of a feature, on the axes of the plot


@dataclass(eq=False)
class Figure25(Result):
    """Cone classifier, trained on recordings past cones of one side and tested on recordings past both sides.

    The classifier is saved as `cones.json` next to the picture. Without recordings, drives are
    simulated. Numbers out of range, or recordings of one side only, are a `ValueError`, an unusable
    recording is a `RecordingError`.
    """

    left: Sequence[str] = ()  # recordings past thin cones only, on the left; at least two
    right: Sequence[str] = ()  # recordings past thick cones only
    # Recordings past both sides with the cones' positions in their notes, for testing; without any,
    # there is only the cross-validation.
    both: Sequence[str] = ()
    _: KW_ONLY
    pairs: int = 5  # left and right drives to simulate
    tests: int = 3  # drives past both sides to simulate
    scan: str = "/scan"  # topic of the LiDAR
    odometry: str | None = "/odom"  # topic of the odometry

    def __post_init__(self) -> None:
        if self.pairs < 2 or self.tests < 1:
            raise ValueError(
                f"pairs={self.pairs} must be at least 2 and tests={self.tests} at least 1"
            )
        if bool(self.left) != bool(self.right) or (self.both and not self.left):
            given = f"left={list(self.left)} and right={list(self.right)}"
            raise ValueError(f"{given} must both be given, or neither and no both")
        self._read([self.left, self.right, self.both])

    def _read(self, sides: Sequence[Sequence[str]]) -> None:
        self.recordings = [
            [read_recording(path, self.scan, self.odometry, None) for path in side]
            for side in sides
        ]
        self.test_drives = [labelled_drive(recording) for recording in self.recordings[2]]

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result, see `Result`."""
        if not self.left:
            with tqdm(
                total=2 * self.pairs + self.tests, desc="record", unit="drive", leave=False
            ) as bar:
                made = record_labelling_drives(
                    stem.with_name("labelling"), self.pairs, self.tests, bar.update
                )
            self._read([made["left"], made["right"], made["both"]])
        simulated = any(recording.simulated for side in self.recordings for recording in side)
        suffix = " (simulated)" if simulated else ""
        left, right = (
            [(each.ranges, each.angles(slice(None))) for each in side]
            for side in self.recordings[:2]
        )
        training = cones.train_on_drives(left, right)
        cones.save_classifier(training.classifier, stem.with_name("cones.json"))
        classifier = training.classifier
        shares = {"paper, its own robot": {"all": PAPER_ACCURACY}}
        shares["cross-validation"] = {"all": cones.share_of(training.correct, training.total)}
        if self.test_drives:
            labelled = cones.label_clusters(self.test_drives)
            shares["accuracy"] = cones.accuracy(classifier, labelled)
            shares |= {
                f"recall of {kind} cones": of
                for kind, of in cones.recall(classifier, self.test_drives).items()
            }
            drawn = labelled.scan % DRAW_EVERY == 0
            features, thick = labelled.features[drawn], labelled.thick[drawn]
        else:
            thin_features, thick_features = (
                cones.clusters_in_range(side, DRAW_EVERY)[0] for side in (left, right)
            )
            features = np.concatenate([thin_features, thick_features])
            thick = np.arange(len(features)) >= len(thin_features)
        kind = "test" if self.test_drives else "training"
        draw_cone_features(
            features,
            thick,
            stem.with_suffix(".png"),
            wrong=classifier.classify(features) != thick,
            title=f"Figure 25: clusters of the classifier's {kind} drives{suffix}",
        )
        rows = [
            {"measure": name, "of": of, **share._asdict()}
            for name in shares
            for of, share in shares[name].items()
        ]
        write_csv(rows, stem.with_suffix(".csv"))
        folds = ", ".join(f"{share:.4f}" for share in training.accuracy)
        notes = PAGE["notes"].format(folds=folds, kind=kind)
        return f"## Figure 25: thin cones and thick ones{suffix}\n\n{markdown_table(rows, PAGE['columns'])}\n\n{notes}"


def principal_components(features: ArrayLike) -> tuple[Array, Array, Array]:
    """Return the first two principal components of standardised features [N, F], none of them constant.

    Returns:
        Coordinates of the rows, [N, 2]; directions in standardised features, [F, 2], each with its
        largest component above 0; and the shares of the variance, [2].
    """
    pca = PCA(2, svd_solver="full")
    coordinates = pca.fit_transform(
        StandardScaler().fit_transform(np.asarray(features, dtype=np.float64))
    )
    signs = np.sign(pca.components_[[0, 1], np.abs(pca.components_).argmax(axis=1)])
    return coordinates * signs, pca.components_.T * signs, pca.explained_variance_ratio_


def draw_cone_features(
    features: ArrayLike,
    thick: ArrayLike,
    path: Path,
    *,
    wrong: ArrayLike | None = None,
    title: str | None = None,
) -> None:
    """Draw clusters [N] by the two principal components of their features [N, 3]; `wrong` ones get a ring.

    Arrows show the direction in which each feature grows.
    """
    xy, directions, share = principal_components(features)
    is_thick = np.asarray(thick, dtype=bool)
    is_wrong = np.zeros(len(xy), dtype=bool) if wrong is None else np.asarray(wrong, dtype=bool)
    kinds = (
        ("thin (left)", ~is_thick, style.LEFT_CONE, "o"),
        ("thick (right)", is_thick, style.RIGHT_CONE, "s"),
    )
    handles = [
        Line2D(
            [],
            [],
            ls="",
            marker=marker,
            color=colour,
            ms=5,
            label=f"{name}, {int(rows.sum())} clusters",
        )
        for name, rows, colour, marker in kinds
    ]
    if is_wrong.any():
        label = f"misclassified, {int(is_wrong.sum())}"
        handles.append(
            Line2D([], [], ls="", marker="o", mfc="none", mec=style.INK, ms=6.5, label=label)
        )
    with style.picture(path, title, handles, 4.4) as figure:
        first, second = (
            f"principal component ({100 * part:.0f} % of the variance)" for part in share
        )
        axes = figure.add_subplot(xlabel=f"first {first}", ylabel=f"second {second}")
        axes.spines[["top", "right"]].set_visible(False)
        for _, rows, colour, marker in kinds:
            axes.plot(
                *xy[rows].T, marker, color=colour, ms=3.6, mec=style.BACKGROUND, mew=0.3, alpha=0.75
            )
        axes.plot(*xy[is_wrong].T, "o", ms=7.0, mfc="none", mec=style.INK, mew=0.9)
        low, high = xy.min(axis=0), xy.max(axis=0)
        # The upper right corner has few clusters.
        start = (high[0] - ARROW_LENGTH, high[1] - ARROW_LENGTH / 2)
        for name, direction in zip(FEATURES, directions, strict=True):
            tip = start + ARROW_LENGTH / 2 * direction
            axes.annotate(
                "", tip, start, arrowprops={"arrowstyle": "->", "color": style.QUIET, "lw": 1.2}
            )
            axes.annotate(
                name,
                tip,
                3 * np.sign(direction),
                textcoords="offset points",
                color=style.QUIET,
                size=8,
            )
        axes.set_xlim(low[0] - 0.2, high[0] + 0.4)
