import numpy as np
import pytest
import skops.io
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GroupKFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from sklearn.svm import SVC

from coil_rl.errors import UserError
from coil_rl.robot import cone_classifier, load_classifier, save_classifier, train_classifier


def cones(count=400, drives=5, seed=0):
    """Width, depth and girth of thin and thick cones that overlap a little."""
    rng = np.random.default_rng(seed)
    thick = rng.random(count) < 0.5
    width = np.where(thick, 0.08, 0.035) + rng.normal(0, 0.012, count)
    features = np.stack([width, 0.2 * width + rng.normal(0, 0.002, count), 1.2 * width], axis=1)
    return features, thick, rng.integers(0, drives, count)


@pytest.fixture(scope="module")
def training():
    return train_classifier(*cones())


def test_the_decision_is_that_of_scikit_learn(training):
    features = np.random.default_rng(1).uniform(-0.02, 0.15, (500, 3))
    classifier = cone_classifier(training.pipeline)
    np.testing.assert_allclose(
        classifier.decision(features), training.pipeline.decision_function(features), rtol=1e-9, atol=1e-9
    )
    assert (classifier.thick(features) == training.pipeline.predict(features)).all()


def test_a_number_for_gamma_is_the_number_used():
    pipeline = train_classifier(*cones(), gamma=0.7).pipeline
    assert cone_classifier(pipeline).gamma == 0.7


def test_each_fold_leaves_out_whole_drives(training):
    features, thick, drives = cones()
    expected = []
    for train, test in GroupKFold(5).split(features, thick, drives):
        assert not set(drives[train]) & set(drives[test])
        pipeline = make_pipeline(StandardScaler(), SVC(C=100.0)).fit(features[train], thick[train])
        expected.append(pipeline.score(features[test], thick[test]))
    np.testing.assert_allclose(training.accuracy, expected)
    assert training.accuracy.min() > 0.9


def test_what_is_kept_decides_the_same(training, tmp_path):
    save_classifier(training.pipeline, tmp_path / "cones.skops")
    features, *_ = cones(seed=2)
    kept = load_classifier(tmp_path / "cones.skops").decision(features)
    assert np.array_equal(kept, cone_classifier(training.pipeline).decision(features))


def test_drives_that_cannot_be_learned_from_are_refused():
    features, thick, drives = cones()
    with pytest.raises(UserError, match="5 drives are too few for 6 folds"):
        train_classifier(features, thick, drives, folds=6)
    with pytest.raises(UserError, match="all clusters are of thick cones"):
        train_classifier(features[thick], thick[thick], drives[thick])
    with pytest.raises(UserError, match="number the drives in pairs"):
        train_classifier(features, thick, thick.astype(int), folds=2)


def test_a_file_that_is_no_classifier_is_refused(tmp_path):
    def refused(said, content=None):
        path = tmp_path / "cones.skops"
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(UserError, match=said):
            load_classifier(path)

    refused("cannot be read")
    refused("holds no classifier to be trusted", b"nothing")
    refused("holds no classifier to be trusted", skops.io.dumps(FunctionTransformer(skops.io.dumps)))
    refused("holds a LinearRegression", skops.io.dumps(LinearRegression()))
    refused("not a fitted cone classifier", skops.io.dumps(make_pipeline(StandardScaler(), SVC())))
    features, thick, _ = cones()
    linear = make_pipeline(StandardScaler(), SVC(kernel="linear")).fit(features, thick)
    refused("not a fitted cone classifier", skops.io.dumps(linear))
    narrow = make_pipeline(StandardScaler(), SVC()).fit(features[:, :2], thick)
    refused("not a fitted cone classifier", skops.io.dumps(narrow))
