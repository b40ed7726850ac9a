import csv

import numpy as np
import pytest
from PIL import Image

from coil_rl.envs import McapReplayEnv, Perception, save_drive, simulated_cone_classifier, simulated_drive
from coil_rl.guides import SplineGuide
from coil_rl.reproduce import FigureScan
from coil_rl.robot.classifier import label_clusters

SCAN = 25  # in which a cone is taken for the other kind


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The page, and the numbers by part."""
    stem = tmp_path_factory.mktemp("scan") / "f"
    page = FigureScan(scan=SCAN).make(stem)
    parts: dict = {}
    with stem.with_suffix(".csv").open(newline="") as file:
        for row in csv.DictReader(file):
            parts.setdefault(row["part"], []).append(row)
    return page, parts, stem


@pytest.fixture(scope="module")
def drive():
    return simulated_drive("both", 100)


def places(rows):
    return np.array([[float(row["x"]), float(row["y"])] for row in rows])


def test_clusters_are_those_of_perception_and_the_cones_in_sight_too(made, drive):
    perception = Perception(simulated_cone_classifier())
    scan, angles = drive.ranges[[SCAN]].numpy(), drive.angles.numpy()
    rows = made[1]["cluster"]
    assert len(rows) == len(perception.clusters(scan, angles).label)
    cones, count = perception(scan, angles)
    seen = [row for row in rows if row["in sight"] == "True"]
    for side, kind in enumerate(("thin", "thick")):
        called = places([row for row in seen if row["called"] == kind])
        assert called == pytest.approx(cones[0, side, : count[0, side]] / 7)


def test_the_truth_is_that_of_the_labelled_drive(made, drive):
    labelled = label_clusters([drive])
    here = labelled.scan == SCAN
    rows = [row for row in made[1]["cluster"] if float(row["range"]) <= 1 and row["truly"] != "no cone"]
    order = np.argsort([float(row["width"]) for row in rows])
    truly = np.array([row["truly"] == "thick" for row in rows])[order]
    assert truly.tolist() == labelled.thick[here][np.argsort(labelled.features[here, 0])].tolist()
    wrong = [row["number"] for row in made[1]["cluster"] if row["called"] != row["truly"] and row["in sight"] == "True"]
    assert len(wrong) == 1
    assert f"1 of 10 in sight are taken for the other kind ({wrong[0]})" in made[0]


def test_observation_and_advice_are_those_of_a_replay_of_the_drive(made, drive, tmp_path):
    save_drive(drive, tmp_path / "both.mcap")
    env = McapReplayEnv(tmp_path / "both.mcap", Perception(simulated_cone_classifier()))
    replay = env.rollout(SCAN + 1, SplineGuide())[0, SCAN]
    told = [float(row[key]) for row in made[1]["sample"] for key in ("r", "theta")]
    assert told == pytest.approx(replay["observation"].tolist(), abs=1e-4)
    assert float(made[1]["advice"][0]["degrees"]) == pytest.approx(80 * replay["action"].item(), abs=0.1)


def test_every_near_return_is_drawn_and_belongs_to_its_cluster(made):
    points, clusters = made[1]["point"], made[1]["cluster"]
    for row in clusters:
        own = places([point for point in points if point["number"] == row["number"]])
        assert len(own) == int(row["size"])
        assert own.mean(0).tolist() == pytest.approx([float(row["x"]), float(row["y"])])
    alone = [point for point in points if not point["number"]]
    assert len(points) == len(alone) + sum(int(row["size"]) for row in clusters)
    with Image.open(made[2].with_suffix(".png")) as image:
        assert image.width == 1600


def test_mistakes_are_refused():
    with pytest.raises(ValueError, match="seed=4 must be at least 100: the classifier learns"):
        FigureScan(seed=4)
    with pytest.raises(ValueError, match="scan=219 must be 0 to 218, the scans of the drive"):
        FigureScan(scan=219)
