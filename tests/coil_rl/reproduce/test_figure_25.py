import csv
import re

import numpy as np
import pytest
from PIL import Image

from coil_rl.envs import RecordingError, read_recording, save_drive, simulated_drive
from coil_rl.envs.robot.drives import record_labelling_drives, surveyed_drive
from coil_rl.errors import UserError
from coil_rl.reproduce import Figure25
from coil_rl.robot.classifier import accuracy, label_clusters, load_classifier


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    return record_labelling_drives(tmp_path_factory.mktemp("drives"), pairs=2, both=1)


def test_the_page_says_what_the_written_classifier_does_on_the_recordings(drives, tmp_path):
    page = Figure25(**drives).make(tmp_path / "figure_25")
    tested = surveyed_drive(read_recording(drives["both"][0]))
    told = accuracy(load_classifier(tmp_path / "cones.json"), label_clusters([tested]))
    assert page.startswith("## Figure 25: thin cones and thick ones (simulated)\n")
    for name, share in told.items():
        assert re.search(rf"\| {re.escape(name)} +\| +{share.share:.4f} \|.*\| +{share.total} \|", page)
    assert re.search(r"\| paper, its own robot \| 0\.9877 \| +0\.964\d \| 0\.995\d \| +3 \| +243 \|", page)
    assert page.count("Recall of") == 2
    assert Image.open(tmp_path / "figure_25.png").width == 1600
    with (tmp_path / "figure_25.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    (measured,) = (row for row in rows if (row["measure"], row["of"]) == ("accuracy", "all"))
    assert float(measured["share"]) == told["all"].share > 0.97


def test_without_drives_past_both_sides_there_is_the_cross_validation_alone(drives, tmp_path):
    page = Figure25(drives["left"], drives["right"]).make(tmp_path / "figure_25")
    assert "| cross-validation " in page
    assert "Recall" not in page
    assert (tmp_path / "cones.json").exists()


def test_drives_that_cannot_be_used_are_refused_before_anything_is_done(drives, tmp_path):
    with pytest.raises(ValueError, match="must both be given"):
        Figure25(left=drives["left"])
    with pytest.raises(ValueError, match="pairs=1 must be at least 2"):
        Figure25(pairs=1)
    with pytest.raises(RecordingError, match="lacks the positions of its cones"):
        Figure25(drives["left"], drives["right"], both=drives["left"])
    with pytest.raises(UserError, match="are too few to learn from"):
        Figure25(drives["left"][:1], drives["right"]).make(tmp_path / "figure_25")


def test_the_truth_of_a_recorded_drive_is_that_of_the_simulated_one(tmp_path):
    drive = simulated_drive("both", seed=7)
    save_drive(drive, tmp_path / "both.mcap")
    again = surveyed_drive(read_recording(tmp_path / "both.mcap"))
    kept = len(drive.seconds) - 1
    assert np.array_equal(again.ranges, drive.ranges[:kept])
    assert (again.hit == drive.hit[:kept]).float().mean() > 0.999
    assert (again.visibility - drive.visibility[:kept]).abs().max() < 0.2
    assert (again.visibility - drive.visibility[:kept]).abs().mean() < 1e-3
    assert np.array_equal(again.thick, drive.thick)
