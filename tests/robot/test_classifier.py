"""Training and evaluation of the cone classifier."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from drives import labelling_drives
from sklearn.model_selection import GroupKFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC, OneClassSVM

from coil_rl.envs import SimulatedLidar, simulated_cone_classifier, simulated_drive
from coil_rl.envs.robot import FEATURES
from coil_rl.errors import UserError
from coil_robot.classifier import (
    UNUSUAL,
    accuracy,
    label_clusters,
    load_classifier,
    recall,
    save_classifier,
    share_of,
    train_classifier,
    train_on_drives,
)


def cones(count=400, drives=5, seed=0):
    """Features of thin and thick cones that overlap a little."""
    rng = np.random.default_rng(seed)
    thick = rng.random(count) < 0.5
    width = np.where(thick, 0.08, 0.035) + rng.normal(0, 0.012, count)
    features = np.stack([width, 0.2 * width + rng.normal(0, 0.002, count), 1.2 * width], axis=1)
    return features, thick, rng.integers(0, drives, count)


@pytest.fixture(scope="module")
def training():
    return train_classifier(*cones(), folds=5)


@pytest.fixture(scope="module")
def held_out():
    """Drives past both sides, not used in training."""
    return [simulated_drive("both", seed) for seed in (100, 101)]


def test_decision_equals_that_of_scikit_learn(training):
    features, thick, _ = cones()
    pipeline = make_pipeline(StandardScaler(), SVC(C=100.0)).fit(features, thick)
    known = make_pipeline(StandardScaler(), OneClassSVM(nu=UNUSUAL)).fit(features)
    clutter = np.random.default_rng(1).uniform(-0.02, 0.15, (500, 3))
    others = np.concatenate([clutter, cones(seed=1)[0]])
    machines = [machine.decision_function(others) for machine in (pipeline, known)]
    expected = np.stack(machines, axis=1)
    np.testing.assert_allclose(training.classifier.decision(others), expected, rtol=1e-9, atol=1e-9)
    classes = training.classifier.classify(others)
    assert (classes == np.where(known.predict(others) < 0, -1, pipeline.predict(others))).all()
    assert set(classes) == {-1, 0, 1}


def test_each_fold_leaves_out_whole_drives(training):
    features, thick, drives = cones()
    expected = []
    for train, test in GroupKFold(5).split(features, thick, drives):
        assert not set(drives[train]) & set(drives[test])
        pipeline = make_pipeline(StandardScaler(), SVC(C=100.0)).fit(features[train], thick[train])
        expected.append(pipeline.score(features[test], thick[test]))
    np.testing.assert_allclose(training.accuracy, expected)
    assert training.accuracy.min() > 0.9


def test_saved_classifier_decides_equally(training, tmp_path):
    save_classifier(training.classifier, tmp_path / "cones.json")
    features, *_ = cones(seed=2)
    loaded = load_classifier(tmp_path / "cones.json").decision(features)
    assert np.array_equal(loaded, training.classifier.decision(features))


def test_unsuitable_drives_are_refused():
    features, thick, drives = cones()
    with pytest.raises(UserError, match="all clusters are of thick cones"):
        train_classifier(features[thick], thick[thick], drives[thick], folds=5)
    with pytest.raises(UserError, match="number the drives in pairs"):
        train_classifier(features, thick, thick.astype(int), folds=2)


NARROW = (
    '{"mean": [0], "scale": [1], "support": [[0]], "weights": [[1], [1]], '
    '"intercept": [0, 0], "gamma": 1}'
)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "cannot be read"),
        ("nothing", "not a cone classifier"),
        ("{}", "not a cone classifier"),
        (NARROW.replace('"gamma": 1', '"gamma": 0'), "more than 0"),
        (NARROW, "1 features instead of width"),
    ],
)
def test_other_files_are_refused(tmp_path, content, words):
    if content is not None:
        (tmp_path / "cones.json").write_text(content)
    with pytest.raises(UserError, match=words):
        load_classifier(tmp_path / "cones.json")


def test_clusters_are_labelled_with_the_kind_of_their_cone(held_out):
    labelled = label_clusters(labelling_drives([0]))
    assert np.array_equal(labelled.thick, labelled.drive == 1)
    assert len(labelled.thick) > 2000
    assert labelled.distance.max() <= 1.0
    whole = labelled[labelled.visibility == 1]
    thin, thick = (whole.width[whole.thick == is_thick] for is_thick in (False, True))
    assert 0.02 < np.median(thin) < 0.04
    assert 0.06 < np.median(thick) < 0.09
    outliers = replace(held_out[0], hit=torch.full_like(held_out[0].hit, -1))
    assert not len(label_clusters([outliers]).thick)


def test_shipped_classifier_is_as_accurate_as_the_papers(held_out):
    shares = accuracy(simulated_cone_classifier(), label_clusters(held_out))
    assert 0.964 < shares["all"].share < 0.996
    assert shares["0.15-0.25 m"].share > shares["0.75-1 m"].share
    whole, half, less = (shares[f"{seen} visible"] for seen in ("0.999-1", "0.5-0.999", "0-0.5"))
    assert whole.share > 0.98 > half.share > less.share
    assert whole.total + half.total + less.total == shares["all"].total
    for found in recall(simulated_cone_classifier(), held_out).values():
        assert found["0.999-1 visible"].share > 0.97
        assert found["0-0.5 visible"].share < 0.6
        assert found["all"].total > 2000


@pytest.mark.fast("180-0.94")
@pytest.mark.parametrize(("beams", "accurate"), [(180, 0.94), (720, 0.97), (1440, 0.97)])
def test_shipped_classifier_knows_the_cones_of_other_scanners(beams, accurate):
    labelled = label_clusters([simulated_drive("both", 102, lidar=SimulatedLidar(beams))])
    assert accuracy(simulated_cone_classifier(), labelled)["all"].share > accurate
    assert (
        simulated_cone_classifier().classify(labelled[list(FEATURES)].to_numpy()) < 0
    ).mean() < 0.008


def test_shares_have_the_interval_of_wilson():
    # The paper's classifier: 3 errors among 243 held-out clusters.
    low, high = share_of(240, 243)[1:3]
    assert (round(low, 3), round(high, 3)) == (0.964, 0.996)
    assert np.isnan(share_of(0, 0)[:3]).all()


@pytest.mark.slow
def test_shipped_classifier_is_the_result_of_training():
    """It is what `save_classifier` writes of pairs of drives, with more and more beams."""

    def scans(sides, seed):
        drive = simulated_drive(sides, seed, SimulatedLidar((180, 360, 720, 1440)[seed % 4]))
        return drive.ranges.numpy(), drive.angles.numpy()

    sides = ([scans(side, seed) for seed in range(8)] for side in ("left", "right"))
    trained, shipped = train_on_drives(*sides).classifier, simulated_cone_classifier()
    features = label_clusters(labelling_drives([7]))[list(FEATURES)].to_numpy()
    # Rounding on another processor may change a few support vectors.
    assert (trained.classify(features) == shipped.classify(features)).mean() > 0.998
