import re

import pytest
from PIL import Image

from coil_rl.envs import simulated_drive
from coil_rl.perception import accuracy, label_clusters, load_classifier, write_simulated_results


def test_the_page_says_what_the_written_classifier_does(tmp_path):
    training = write_simulated_results(tmp_path, seeds=(0, 1), test_seeds=(50,))
    told = accuracy(load_classifier(tmp_path / "cones.skops"), label_clusters([simulated_drive("both", 50)]))
    page = (tmp_path / "classifier.md").read_text(encoding="utf-8")
    assert page.startswith("# Cone classifier (simulated)\n")
    assert f"{training.accuracy.mean():.4f}" in page
    for name, share in told.items():
        assert re.search(rf"\| {re.escape(name)} +\| +{share.share:.4f} \|.*\| +{share.total} \|", page)
    assert re.search(r"\| paper, its own robot \| 0\.9877 \| +0\.964\d \| 0\.995\d \| +3 \| +243 \|", page)
    assert page.count("## Recall of") == 2
    assert Image.open(tmp_path / "features.png").width == 1600


def test_nothing_is_measured_on_what_was_learned_from(tmp_path):
    with pytest.raises(ValueError, match="must be other drives"):
        write_simulated_results(tmp_path, seeds=(0, 1), test_seeds=(1,))
