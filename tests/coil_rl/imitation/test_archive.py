import numpy as np
import pytest
import skops.io
from sklearn.base import clone
from sklearn.compose import TransformedTargetRegressor
from sklearn.ensemble import (
    BaggingRegressor,
    ExtraTreesRegressor,
    GradientBoostingRegressor,
    HistGradientBoostingRegressor,
    RandomForestRegressor,
    VotingRegressor,
)
from sklearn.linear_model import LinearRegression, Ridge
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures
from sklearn.svm import SVR
from sklearn.tree import DecisionTreeRegressor

from coil_rl.errors import UserError
from coil_rl.imitation import archive

X = np.random.default_rng(0).random((80, 4)).astype(np.float32)
FORESTS = [
    RandomForestRegressor(3),
    ExtraTreesRegressor(3),
    GradientBoostingRegressor(n_estimators=3),
]


def fitted(estimator):
    return clone(estimator).fit(X, X[:, 0].astype(float))


def forged(tree, change):
    """Return a copy of a tree whose state `change` has altered."""
    kind, (features, classes, outputs), state = tree.__reduce__()
    state = {
        key: value.copy() if isinstance(value, np.ndarray) else value
        for key, value in state.items()
    }
    change(state)
    copy = kind(features, classes, outputs)
    copy.__setstate__(state)
    return copy


def node(name, value, index=0):
    def change(state):
        state["nodes"][name][index] = value

    return change


def value(state):
    state["values"][0] = np.nan


def shared_child(state):
    state["nodes"]["left_child"][0] = state["nodes"]["right_child"][0]


FORGED_TREES = {
    "child out of range": (node("left_child", 10**6), "do not form a tree"),
    "negative child": (node("right_child", -7), "do not form a tree"),
    "cycle": (node("left_child", 0), "do not form a tree"),
    "shared child": (shared_child, "do not form a tree"),
    "negative feature": (node("feature", -3), "a feature that does not exist"),
    "feature out of range": (node("feature", 4), "a feature that does not exist"),
    "NaN as threshold": (node("threshold", np.nan), "is not a number"),
    "NaN as value": (value, "is not a number"),
}


@pytest.mark.parametrize(
    "estimator", [DecisionTreeRegressor(), *FORESTS], ids=lambda model: type(model).__name__
)
@pytest.mark.parametrize("forgery", FORGED_TREES)
def test_forged_tree_is_refused(estimator, forgery):
    model, (change, message) = fitted(estimator), FORGED_TREES[forgery]
    owner = (
        model if isinstance(estimator, DecisionTreeRegressor) else np.ravel(model.estimators_)[1]
    )
    owner.tree_ = forged(owner.tree_, change)
    with pytest.raises(UserError, match=message):
        archive.load(skops.io.dumps(model))


@pytest.mark.parametrize("estimator", FORESTS, ids=lambda model: type(model).__name__)
def test_forest_whose_trees_do_not_fit_is_refused(estimator):
    for change, message in (
        (lambda model: setattr(model, "estimators_", model.estimators_[:0]), "has no trees"),
        (lambda model: setattr(model, "n_features_in_", 2), "the trees of a forest differ"),
        (
            lambda model: setattr(np.ravel(model.estimators_)[0], "n_features_in_", 9),
            "differ|other features",
        ),
        (lambda model: vars(np.ravel(model.estimators_)[2]).pop("tree_"), "differ"),
    ):
        model = fitted(estimator)
        change(model)
        with pytest.raises(UserError, match=message):
            archive.load(skops.io.dumps(model))


def hist_node(name, value):
    def change(model):
        nodes = model._predictors[1][0].nodes
        nodes[name][0] = value

    return change


def begins(**changes):
    def change(model):
        vars(model.init_).update(changes)

    return change


BOOSTED = GradientBoostingRegressor(n_estimators=3)
FORGED = {
    "first prediction of other rows": (
        BOOSTED,
        begins(n_outputs_=2),
        "wrong number of predictions",
    ),
    "no first prediction": (BOOSTED, begins(n_outputs_=0), "wrong number of predictions"),
    "first prediction of many": (
        BOOSTED,
        begins(constant_=np.zeros((5, 1))),
        "wrong number of predictions",
    ),
    "first prediction is no number": (
        BOOSTED,
        begins(constant_=np.full((1, 1), np.nan)),
        "is not a number",
    ),
    "another first regressor": (
        BOOSTED,
        lambda model: setattr(model, "init_", fitted(KNeighborsRegressor())),
        "begin with another regressor",
    ),
    "a list of first regressors": (
        BOOSTED,
        lambda model: setattr(model, "init_", [1.0]),
        "begin with another regressor",
    ),
    "an unknown first regressor": (
        BOOSTED,
        lambda model: setattr(model, "init_", "one"),
        "begin with something unknown",
    ),
    "inside of another": (
        BaggingRegressor(BOOSTED, 2),
        lambda model: begins(n_outputs_=7)(model.estimators_[0]),
        "wrong number of predictions",
    ),
    "many features of a row": (
        make_pipeline(PolynomialFeatures(), LinearRegression()),
        lambda model: setattr(model[0], "n_output_features_", 10**9),
        "polynomial features",
    ),
    "child of a boosted tree": (
        HistGradientBoostingRegressor(max_iter=3),
        hist_node("left", 10**6),
        "form a tree",
    ),
    "cycle of a boosted tree": (
        HistGradientBoostingRegressor(max_iter=3),
        hist_node("right", 0),
        "form a tree",
    ),
    "feature of a boosted tree": (
        HistGradientBoostingRegressor(max_iter=3),
        hist_node("feature_idx", -1),
        "feature",
    ),
    "category": (
        HistGradientBoostingRegressor(max_iter=3),
        hist_node("is_categorical", 1),
        "cannot be checked",
    ),
    "support vectors": (
        SVR(),
        lambda model: setattr(model, "support_vectors_", np.zeros((9, 1))),
        "wrong shapes",
    ),
    "coefficients": (
        SVR(),
        lambda model: setattr(model, "_dual_coef_", np.zeros((1, 1))),
        "wrong shapes",
    ),
    "kind of machine": (SVR(), lambda model: setattr(model, "_impl", "c_svc"), "wrong shapes"),
}


@pytest.mark.parametrize("forgery", FORGED)
def test_forged_numbers_of_compiled_code_are_refused(forgery):
    estimator, change, message = FORGED[forgery]
    model = fitted(estimator)
    change(model)
    with pytest.raises(UserError, match=message):
        archive.load(skops.io.dumps(model))


def test_neighbours_are_found_from_the_points_whatever_the_archive_holds():
    model = fitted(KNeighborsRegressor(algorithm="kd_tree"))
    expected = model.predict(X)
    state = list(model._tree.__getstate__())
    state[1] = np.full_like(state[1], 10**6)
    model._tree.__setstate__(tuple(state))
    assert np.array_equal(archive.load(skops.io.dumps(model)).predict(X), expected)


@pytest.mark.parametrize(
    "estimator",
    [
        BaggingRegressor(DecisionTreeRegressor(), 2),
        VotingRegressor([("a", Ridge()), ("b", LinearRegression())]),
        TransformedTargetRegressor(Ridge()),
        GradientBoostingRegressor(n_estimators=3, init="zero"),
        GradientBoostingRegressor(n_estimators=3, loss="huber"),
        make_pipeline(PolynomialFeatures(), LinearRegression()),
    ],
    ids=lambda model: type(model).__name__,
)
def test_composed_regressor_is_restored(estimator):
    model = fitted(estimator)
    assert np.array_equal(archive.load(archive.dump(model)).predict(X), model.predict(X))


@pytest.mark.parametrize("content", [[1, 2], {"predict": 3}, np.zeros(3)])
def test_archive_of_something_else_is_refused(content):
    with pytest.raises(UserError, match="is not a regressor of scikit-learn"):
        archive.load(skops.io.dumps(content))
