"""Figure 25 of the paper: features of thin and thick cones, and how well they are told apart."""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from sklearn.decomposition import PCA
from sklearn.preprocessing import StandardScaler
from tqdm import tqdm

import coil_robot as cones
from coil_paper.reproduce.result import NO_RUNS, PAGES, Result, Runs
from coil_rl.envs import read_recording
from coil_rl.envs.robot import FEATURES, labelled_drive, record_labelling_drives
from coil_rl.ranges import Count, Ge, checked
from coil_rl.report import markdown_table, style, write_csv

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

PAGE = PAGES["figure_25"]
PAPER_ACCURACY = cones.share_of(*PAGE["paper"])
DRAW_EVERY = 4  # scans
ARROW_LENGTH = 2.2  # of a standard deviation of a feature, on the axes of the plot


@checked
@dataclass(eq=False)
class Figure25(Result):
    """Classifier of cones: its accuracy, and the features that it sees.

    It is trained on recordings past cones of one side and tested on recordings past both sides. It
    is saved as `cones.json` next to the picture. Without recordings, drives are simulated.

    Args:
        left: recordings past thin cones only, on the left; at least two. Each is an MCAP file or a
            rosbag2 directory.
        right: recordings past thick cones only, on the right; at least two.
        both: recordings past both sides with the cones' positions in their notes, for testing;
            without any, there is only the cross-validation.
        pairs: number of left and right drives to simulate.
        tests: number of drives past both sides to simulate.
        scan: topic of the LiDAR.
        odometry: topic of the odometry.

    Raises:
        ValueError: if a number is out of range, or recordings of one side are missing.
        RecordingError: if a recording cannot be used.
    """

    left: Sequence[str] = ()
    right: Sequence[str] = ()
    both: Sequence[str] = ()
    _: KW_ONLY
    pairs: Annotated[int, Ge(2)] = 5
    tests: Count = 3
    scan: str = "/scan"
    odometry: str | None = "/odom"

    def __post_init__(self) -> None:
        if bool(self.left) != bool(self.right) or (self.both and not self.left):
            raise ValueError(
                f"left={list(self.left)} and right={list(self.right)} must both be given, "
                "or neither and no both"
            )
        self._read(self.left, self.right, self.both)

    def _read(self, left: Sequence[str], right: Sequence[str], both: Sequence[str]) -> None:
        """Read the recordings of all drives."""
        recordings = {"left": left, "right": right, "both": both}
        self.recordings = {
            side: [read_recording(path, self.scan, self.odometry, None) for path in paths]
            for side, paths in recordings.items()
        }
        self.test_drives = [labelled_drive(recording) for recording in self.recordings["both"]]

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result, see `Result`."""
        if not self.left:
            self._simulate(stem.with_name("labelling"))
        thin, thick = self._scans("left"), self._scans("right")
        training = cones.train_on_drives(thin, thick)
        cones.save_classifier(training.classifier, stem.with_name("cones.json"))
        labelled = cones.label_clusters(self.test_drives) if self.test_drives else None
        if labelled is not None:
            kind, drawn = "test", labelled[labelled["scan"] % DRAW_EVERY == 0]
            features, is_thick = drawn[list(FEATURES)].to_numpy(), drawn["thick"].to_numpy()
        else:
            kind = "training"
            sides = [cones.clusters_in_range(side, DRAW_EVERY)[0] for side in (thin, thick)]
            features = np.concatenate(sides)
            is_thick = np.arange(len(features)) >= len(sides[0])
        recordings = chain.from_iterable(self.recordings.values())
        suffix = " (simulated)" if any(each.simulated for each in recordings) else ""
        draw_cone_features(
            features,
            is_thick,
            training.classifier.classify(features) != is_thick,
            stem.with_suffix(".png"),
            f"Figure 25: clusters of the classifier's {kind} drives{suffix}",
        )
        rows = self._shares(training, labelled)
        write_csv(rows, stem.with_suffix(".csv"))
        table = markdown_table(rows, PAGE["columns"])
        folds = ", ".join(f"{share:.4f}" for share in training.accuracy)
        notes = PAGE["notes"].format(folds=folds, kind=kind)
        return f"## Figure 25: thin cones and thick ones{suffix}\n\n{table}\n\n{notes}"

    def _simulate(self, folder: Path) -> None:
        """Record simulated drives in a folder, and read them."""
        with tqdm(
            total=2 * self.pairs + self.tests, desc="record", unit="drive", leave=False
        ) as bar:
            made = record_labelling_drives(folder, self.pairs, self.tests, bar.update)
        self._read(made["left"], made["right"], made["both"])

    def _scans(self, side: str) -> list[cones.Scans]:
        """Return ranges and angles of the scans of each drive past one side."""
        return [(each.ranges, each.angles(slice(None))) for each in self.recordings[side]]

    def _shares(
        self, training: cones.Training, labelled: pd.DataFrame | None
    ) -> list[dict[str, Any]]:
        """Return how many clusters and cones are classified correctly, as rows of the table.

        Args:
            training: the classifier and its cross-validation.
            labelled: the clusters of the test drives; None without such drives.
        """
        shares = {"paper, its own robot": {"all": PAPER_ACCURACY}}
        shares["cross-validation"] = {"all": cones.share_of(training.correct, training.total)}
        if labelled is not None:
            shares["accuracy"] = cones.accuracy(training.classifier, labelled)
            recall = cones.recall(training.classifier, self.test_drives)
            for kind, of_kind in recall.items():
                shares[f"recall of {kind} cones"] = of_kind
        rows = []
        for measure, of_measure in shares.items():
            rows += [
                {"measure": measure, "of": of, **of_measure[of]._asdict()} for of in of_measure
            ]
        return rows


def principal_components(features: Array) -> tuple[Array, Array, Array]:
    """Return the first two principal components of standardised features.

    Args:
        features: [N, F], none of them constant.

    Returns:
        Coordinates of the rows, [N, 2]; directions in standardised features, [F, 2], each with its
        largest component above 0; and the shares of the variance, [2].
    """
    pca = PCA(2, svd_solver="full")
    coordinates = pca.fit_transform(StandardScaler().fit_transform(features))
    signs = np.sign(pca.components_[[0, 1], np.abs(pca.components_).argmax(axis=1)])
    return coordinates * signs, pca.components_.T * signs, pca.explained_variance_ratio_


def draw_cone_features(features: Array, thick: Flags, wrong: Flags, path: Path, title: str) -> None:
    """Draw clusters of thin and thick cones by the principal components of their features.

    Arrows show the direction in which each feature grows.

    Args:
        features: [N, 3], see `coil_rl.envs.robot.FEATURES`.
        thick: [N], whether each cluster is a thick cone.
        wrong: [N], whether each cluster is classified wrongly and gets a ring.
        title: above the picture.
    """
    xy, directions, share = principal_components(features)
    kinds = (
        ("thin (left)", ~thick, style.LEFT_CONE, "o"),
        ("thick (right)", thick, style.RIGHT_CONE, "s"),
    )
    handles = []
    for name, rows, colour, marker in kinds:
        label = f"{name}, {int(rows.sum())} clusters"
        handles.append(Line2D([], [], ls="", marker=marker, color=colour, ms=5, label=label))
    if wrong.any():
        label = f"misclassified, {int(wrong.sum())}"
        ring: Any = {"ls": "", "marker": "o", "mfc": "none", "mec": style.INK, "ms": 6.5}
        handles.append(Line2D([], [], label=label, **ring))
    with style.picture(path, title, handles, 4.4) as figure:
        axes = figure.add_subplot(
            xlabel=f"first principal component ({100 * share[0]:.0f} % of the variance)",
            ylabel=f"second principal component ({100 * share[1]:.0f} % of the variance)",
        )
        axes.spines[["top", "right"]].set_visible(False)
        dots: Any = {"ms": 3.6, "mec": style.BACKGROUND, "mew": 0.3, "alpha": 0.75}
        for _, rows, colour, marker in kinds:
            axes.plot(*xy[rows].T, marker, color=colour, **dots)
        axes.plot(*xy[wrong].T, "o", ms=7.0, mfc="none", mec=style.INK, mew=0.9)
        _draw_directions(axes, directions, xy.max(axis=0))
        axes.set_xlim(xy[:, 0].min() - 0.2, xy[:, 0].max() + 0.4)


def _draw_directions(axes: Axes, directions: Array, upper_right: Array) -> None:
    """Draw an arrow for each feature near the upper right corner, which has few clusters.

    Args:
        directions: [F, 2], the direction of each feature.
        upper_right: [2], the largest coordinates of the clusters.
    """
    start = (upper_right[0] - ARROW_LENGTH, upper_right[1] - ARROW_LENGTH / 2)
    arrow = {"arrowstyle": "->", "color": style.QUIET, "lw": 1.2}
    for name, direction in zip(FEATURES, directions, strict=True):
        tip = start + ARROW_LENGTH / 2 * direction
        right, up = 3 * np.sign(direction)
        axes.annotate("", tip, start, arrowprops=arrow)
        axes.annotate(
            name,
            tip,
            (right, up),
            textcoords="offset points",
            color=style.QUIET,
            size=8,
        )
