"""Figure 25 of the paper: the features of thin and of thick cones, and how well a classifier tells them apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from coil_rl.envs.recordings.reading import Recording, read_recording
from coil_rl.envs.robot.drives import record_labelling_drives, surveyed_drive
from coil_rl.report import markdown_table, write_csv
from coil_rl.report.cone_features import draw_cone_features
from coil_rl.reproduce.result import NO_RUNS, Result, Runs
from coil_rl.robot.classifier import (
    Scans,
    Share,
    Training,
    accuracy,
    clusters_in_range,
    label_clusters,
    recall,
    save_classifier,
    train_on_drives,
)

PAPER = Share(240, 243)
DRAWN_EVERY = 4  # scans

COLUMNS = {
    "of": ("", ""),
    "share": ("share", ".4f"),
    "low": ("95 % from", ".4f"),
    "high": ("to", ".4f"),
    "wrong": ("wrong", "d"),
    "total": ("of", "d"),
}


class Figure25(Result):
    """The cone classifier, learned from recordings past the cones of one side, and measured on recordings past both.

    It leaves the classifier too, as `cones.json` beside the picture. Without any recording it simulates some.

    Args:
        left: recordings past thin cones alone, which stand on the left; at least two.
        right: recordings past thick cones alone.
        both: recordings past both that note where the cones stood, and none that was learned from; without any there
            is the cross-validation alone.
        pairs: how many of left and of right ones to simulate.
        tests: how many of both.
        scan: topic of the LiDAR.
        odometry: topic of the odometry.

    Raises:
        ValueError: for numbers out of range, or recordings of one side alone.
        RecordingError: for a recording that cannot be used.
    """

    def __init__(
        self,
        left: Sequence[str] = (),
        right: Sequence[str] = (),
        both: Sequence[str] = (),
        *,
        pairs: int = 5,
        tests: int = 3,
        scan: str = "/scan",
        odometry: str | None = "/odom",
    ) -> None:
        if pairs < 2 or tests < 1:
            raise ValueError(f"pairs={pairs} must be at least 2 and tests={tests} at least 1")
        if bool(left) != bool(right) or (both and not left):
            raise ValueError(f"left={list(left)} and right={list(right)} must both be given, or neither and no both")
        self.pairs, self.tests, self.scan, self.odometry = pairs, tests, scan, odometry
        self._read(left, right, both)

    def _read(self, left: Sequence[str], right: Sequence[str], both: Sequence[str]) -> None:
        self.left, self.right, self.both = (
            [read_recording(path, self.scan, self.odometry, None) for path in paths] for paths in (left, right, both)
        )
        # Now, for a mistake shall cost seconds.
        self.surveyed = [surveyed_drive(recording) for recording in self.both]

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make it: see `Result`."""
        if not self.left:
            with tqdm(total=2 * self.pairs + self.tests, desc="record", unit="drive", leave=False) as bar:
                made = record_labelling_drives(stem.with_name("labelling"), self.pairs, self.tests, bar.update)
            self._read(made["left"], made["right"], made["both"])
        simulated = any("simulated" in recording.notes for recording in (*self.left, *self.right, *self.both))
        where = " (simulated)" if simulated else ""
        training = train_on_drives(_scans(self.left), _scans(self.right))
        classifier = training.classifier
        save_classifier(classifier, stem.with_name("cones.json"))
        tables = {"paper, its own robot": {"all": PAPER}}
        tables["cross-validation"] = {"all": Share(training.correct, training.total)}
        if self.surveyed:
            labelled = label_clusters(self.surveyed)
            tables["accuracy"] = accuracy(classifier, labelled)
            tables |= {f"recall of {kind} cones": shares for kind, shares in recall(classifier, self.surveyed).items()}
            drawn = labelled.scan % DRAWN_EVERY == 0
            features, thick = labelled.features[drawn], labelled.thick[drawn]
        else:
            features, thick = _learned_from(self.left, self.right)
        did = "did not learn" if self.surveyed else "learned"
        draw_cone_features(
            features, thick, stem.with_suffix(".png"), wrong=classifier.thick(features) != thick,
            title=f"Figure 25: clusters of drives that the classifier {did} from{where}",
        )  # fmt: skip
        rows = [{"measure": name, **_row(*row)} for name, shares in tables.items() for row in shares.items()]
        write_csv(rows, stem.with_suffix(".csv"))
        return _page(training, tables, where)


def _scans(recordings: Sequence[Recording]) -> list[Scans]:
    return [(recording.ranges, recording.angles(0)) for recording in recordings]


def _learned_from(
    left: Sequence[Recording], right: Sequence[Recording]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    thin, thick = (clusters_in_range(_scans(side), DRAWN_EVERY)[0] for side in (left, right))
    return np.concatenate([thin, thick]), np.arange(len(thin) + len(thick)) >= len(thin)


def _page(training: Training, tables: Mapping[str, Mapping[str, Share]], where: str) -> str:
    folds = ", ".join(f"{share:.4f}" for share in training.accuracy)
    whole = {"paper, its own robot", "cross-validation"}
    first = [_row(name, shares["all"]) for name, shares in tables.items() if name in whole]
    parts = [
        f"## Figure 25: thin cones and thick ones{where}",
        f"Accuracy{where}, clusters within 1 m; the drives of the cross-validation are left out in pairs ({folds}):",
        markdown_table(first, COLUMNS),
    ]
    if "accuracy" in tables:
        parts += [
            f"On drives past both sides, which nothing was learned from{where}:",
            markdown_table([_row(*row) for row in tables["accuracy"].items()], COLUMNS),
        ]
    for name, shares in tables.items():
        if name not in {*whole, "accuracy"}:
            parts += [f"{name.capitalize()}{where}: within 1 m and met by a beam, found and told right:"]
            parts += [markdown_table([_row(*row) for row in shares.items()], COLUMNS)]
    parts += ["The intervals (Wilson) take clusters for independent, which those of neighbouring scans are not."]
    return "\n\n".join(parts)


def _row(of: str, share: Share) -> dict[str, object]:
    low, high = share.interval
    wrong = share.total - share.correct
    return {"of": of, "share": share.share, "low": low, "high": high, "wrong": wrong, "total": share.total}
