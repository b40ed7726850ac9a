"""How good the cone classifier is, on simulated drives that it did not learn from: tables, and figure 25."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from coil_rl.envs.simulated_drives import simulated_drive
from coil_rl.files import whole_file
from coil_rl.perception.classifier import Training, cone_classifier, save_classifier
from coil_rl.perception.labelling import Share, accuracy, label_clusters, recall
from coil_rl.perception.simulated import SEEDS, train_on_simulated_drives
from coil_rl.report.cone_features import draw_cone_features
from coil_rl.report.table import markdown_table

TEST_SEEDS = (100, 101, 102)
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


def write_simulated_results(
    folder: str | os.PathLike[str], seeds: Sequence[int] = SEEDS, test_seeds: Sequence[int] = TEST_SEEDS
) -> Training:
    """Train on simulated labelling drives, measure on drives past both sides, and write what came out.

    Args:
        folder: gets `cones.skops` (the classifier), `classifier.md` (accuracy and recall within 1 m, by range and
            visibility) and `features.png` (figure 25).
        seeds: of the drives to learn from.
        test_seeds: of the drives to measure on, others than those.

    Returns:
        What was trained.

    Raises:
        ValueError: if a drive is both learned from and measured on.
    """
    if set(seeds) & set(test_seeds):
        raise ValueError(f"test_seeds={list(test_seeds)} must be other drives than seeds={list(seeds)}")
    folder = Path(folder)
    training = train_on_simulated_drives(seeds)
    classifier = cone_classifier(training.pipeline)
    drives = [simulated_drive("both", seed) for seed in test_seeds]
    labelled = label_clusters(drives)
    told = accuracy(classifier, labelled)
    found = recall(classifier, drives)

    save_classifier(training.pipeline, folder / "cones.skops")
    wrong = classifier.thick(labelled.features) != labelled.thick
    drawn = labelled.scan % DRAWN_EVERY == 0
    draw_cone_features(
        labelled.features[drawn], labelled.thick[drawn], folder / "features.png", wrong=wrong[drawn],
        title="Clusters of drives that the classifier did not learn from (simulated)",
    )  # fmt: skip
    with whole_file(folder / "classifier.md") as unfinished:
        unfinished.write_text(_page(training, told, found), encoding="utf-8", newline="")
    return training


def _page(training: Training, told: Mapping[str, Share], found: Mapping[str, Mapping[str, Share]]) -> str:
    folds = ", ".join(f"{share:.4f}" for share in training.accuracy)
    return "\n\n".join(
        [
            "# Cone classifier (simulated)",
            "Everything here but the row of the paper was measured on simulated scans. The intervals (Wilson) take "
            "clusters for independent, which those of neighbouring scans are not.",
            f"Cross-validation, each fold a pair of drives: {training.accuracy.mean():.4f} ({folds}).",
            "## Accuracy on clusters within 1 m of drives not learned from",
            markdown_table([_row("paper, its own robot", PAPER), *(_row(*row) for row in told.items())], COLUMNS),
            *(
                f"## Recall of {kind} cones: within 1 m and met by a beam, found and told right\n\n"
                + markdown_table([_row(*row) for row in shares.items()], COLUMNS)
                for kind, shares in found.items()
            ),
        ]
    ) + "\n"  # fmt: skip


def _row(of: str, share: Share) -> dict[str, object]:
    low, high = share.interval
    wrong = share.total - share.right
    return {"of": of, "share": share.share, "low": low, "high": high, "wrong": wrong, "total": share.total}
