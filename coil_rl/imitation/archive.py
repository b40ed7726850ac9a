"""Fitted regressors of scikit-learn as bytes: read without running code, and checked.

skops constructs trusted types only. That is not enough: the compiled code of scikit-learn follows
the indices in trees and support vector machines without a check, so that forged ones read foreign
memory or never end.
"""

import types
from collections.abc import Iterator, Mapping
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
import skops.io
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, is_regressor
from sklearn.dummy import DummyRegressor
from sklearn.ensemble import (
    ExtraTreesRegressor,
    GradientBoostingRegressor,
    HistGradientBoostingRegressor,
    RandomForestRegressor,
)
from sklearn.ensemble._hist_gradient_boosting.predictor import TreePredictor
from sklearn.neighbors import KNeighborsRegressor, RadiusNeighborsRegressor
from sklearn.preprocessing import PolynomialFeatures
from sklearn.svm import SVR, NuSVR
from sklearn.tree import DecisionTreeRegressor
from sklearn.tree._tree import Tree

from coil_rl.errors import UserError
from coil_rl.trusted import ESTIMATORS, PARTS

CLASSES = {
    *(name.rpartition(".")[2] for name in ESTIMATORS),
    "FunctionTransformer",
    "LabelBinarizer",
    "_BinMapper",
}
FORESTS = (RandomForestRegressor, ExtraTreesRegressor, GradientBoostingRegressor)
LARGEST_WIDTH = 10_000  # features that are made of those of a row
FUNCTIONS = (types.FunctionType, types.BuiltinFunctionType, types.MethodType, partial)


def dump(model: BaseEstimator) -> bytes:
    """Return a fitted regressor as bytes; raises a `UserError` if `load` would refuse it.

    Args:
        model: the regressor.
    """
    content: bytes = skops.io.dumps(model)
    _types(content)
    try:
        _check(model)
    except ValueError as error:
        raise UserError(
            f"a {type(model).__name__} like this cannot be saved ({error}); use another regressor"
        ) from error
    return content


def load(content: bytes) -> BaseEstimator:
    """Return the regressor of `dump`.

    Args:
        content: its bytes; if it could run code, is damaged or is forged, a `UserError` is raised.
    """
    try:
        model = skops.io.loads(content, trusted=_types(content))
        if not isinstance(model, BaseEstimator) or not is_regressor(model):
            raise ValueError(f"it is {type(model).__name__}")
        _check(model)
    except UserError:
        raise
    except Exception as error:
        reason = str(error) if type(error) is ValueError else type(error).__name__
        raise UserError(
            f"the state is not a regressor of scikit-learn ({reason:.200}); train again"
        ) from error
    return model


def _types(content: bytes) -> list[str]:
    """Return the types that skops does not trust by default, all of which must be known here."""
    found: list[str] = skops.io.get_untrusted_types(data=content)
    unknown = sorted(set(found) - PARTS)
    if unknown:
        raise UserError(
            f"a regressor with parts of type {', '.join(unknown)} could run code; use another "
            "regressor"
        )
    return found


def _check(model: BaseEstimator) -> None:
    """Raise a `UserError` or a `ValueError` for a regressor that must not be used."""
    for part in _parts(model):
        if isinstance(part, FUNCTIONS):
            raise UserError(
                f"a regressor with the function {part!r:.100} could run code; use another regressor"
            )
        if isinstance(part, BaseEstimator):
            name = type(part).__name__
            if name not in CLASSES:
                raise UserError(
                    f"a regressor with a {name} cannot be checked; use another regressor"
                )
            _check_estimator(part, vars(part))


def _parts(model: object) -> Iterator[Any]:
    """Yield an object and all objects that it holds, each once."""
    seen, waiting = {}, [model]
    while waiting:
        part = waiting.pop()
        if id(part) in seen:
            continue
        seen[id(part)] = part
        yield part
        if isinstance(part, Mapping):
            waiting += [*part, *part.values()]
        elif isinstance(part, (list, tuple, set, frozenset)):
            waiting += part
        elif isinstance(part, np.ndarray) and part.dtype.hasobject:
            waiting += part.ravel().tolist()
        elif not isinstance(part, type) and type(part).__module__.startswith("sklearn."):
            waiting += getattr(part, "__dict__", {}).values()


def _check_estimator(part: BaseEstimator, state: Mapping[str, Any]) -> None:
    """Check what compiled code reads at a prediction; raises a `ValueError`.

    Parts that are not fitted pass.

    Args:
        part: an estimator.
        state: its attributes.
    """
    inputs = state.get("n_features_in_")
    if isinstance(part, DecisionTreeRegressor) and "tree_" in state:
        _check_tree(part, inputs)
    elif isinstance(part, FORESTS) and "estimators_" in state:
        _check_forest(part, inputs)
    elif isinstance(part, HistGradientBoostingRegressor) and "_predictors" in state:
        _check_histograms(part, state, inputs)
    elif isinstance(part, (SVR, NuSVR)) and "support_vectors_" in state:
        _check_support_vectors(part, state, inputs)
    elif isinstance(part, (KNeighborsRegressor, RadiusNeighborsRegressor)) and "_fit_X" in state:
        # Finds the neighbours by a tree of its own, made from the points.
        part.fit(part._fit_X, part._y)
    elif isinstance(part, PolynomialFeatures) and "n_output_features_" in state:
        usual = 0 < state["n_output_features_"] <= LARGEST_WIDTH
        _require(usual, f"there are more than {LARGEST_WIDTH} polynomial features")


def _check_tree(part: DecisionTreeRegressor, inputs: int | None) -> None:
    """Check a tree for this number of inputs."""
    tree = part.tree_
    _require(
        isinstance(tree, Tree) and tree.n_features == inputs,
        "a tree has other features",
    )
    leaf = tree.children_left == -1
    _check_nodes(tree.children_left, tree.children_right, leaf, tree.feature, tree.n_features)
    _check_numbers(tree.value, tree.threshold)


def _check_forest(part: Any, inputs: int | None) -> None:
    """Check that a forest consists of fitted trees for this number of inputs.

    The trees themselves are parts of their own.
    """
    trees = np.ravel(part.estimators_)
    _require(len(trees) > 0, "a forest has no trees")
    for tree in trees:
        fitted = isinstance(tree, DecisionTreeRegressor) and "tree_" in vars(tree)
        alike = fitted and vars(tree).get("n_features_in_") == inputs
        _require(alike, "the trees of a forest differ")
    if isinstance(part, GradientBoostingRegressor):
        one_output = np.shape(part.estimators_) == (len(trees), 1)
        _require(one_output, "boosted trees have a wrong shape")
        _check_first_prediction(vars(part).get("init_"))


def _check_first_prediction(first: object) -> None:
    """Check what boosted trees add to: the trees write beyond its end if it has too few rows."""
    if isinstance(first, str):
        _require(first == "zero", "boosted trees begin with something unknown")
        return
    _require(type(first) is DummyRegressor, "boosted trees begin with another regressor")
    state = vars(first)
    constant: Any = state.get("constant_")
    one = np.shape(constant) == (1, 1) and state.get("n_outputs_") == 1
    _require(one, "boosted trees begin with a wrong number of predictions")
    _check_numbers(constant, constant)


def _check_histograms(
    part: HistGradientBoostingRegressor, state: Mapping[str, Any], inputs: Any
) -> None:
    """Check boosted trees on histograms for this number of inputs."""
    plain = state.get("_preprocessor") is None and not np.any(part._bin_mapper.is_categorical_)
    _require(plain and not state.get("_in_fit"), "categories cannot be checked")
    for predictor in chain.from_iterable(part._predictors):
        _require(isinstance(predictor, TreePredictor), "boosted trees have a wrong type")
        nodes = predictor.nodes
        _require(not nodes["is_categorical"].any(), "categories cannot be checked")
        leaf = nodes["is_leaf"] != 0
        _check_nodes(nodes["left"], nodes["right"], leaf, nodes["feature_idx"], inputs)
        _check_numbers(nodes["value"], nodes["num_threshold"])


def _check_support_vectors(part: Any, state: Mapping[str, Any], inputs: int | None) -> None:
    """Check a support vector machine for this number of inputs."""
    count = len(part.support_vectors_)
    shapes = {
        "support_vectors_": (count, inputs),
        "support_": (count,),
        "_dual_coef_": (1, count),
        "_intercept_": (1,),
        "_n_support": (2,),
        "_probA": (0,),
        "_probB": (0,),
    }
    fits = all(np.shape(state[name]) == shape for name, shape in shapes.items())
    usual = part.kernel in ("linear", "poly", "rbf", "sigmoid")
    known = usual and not part._sparse and "_impl" not in state
    _require(count > 0 and fits and known, "a support vector machine has wrong shapes")
    _check_numbers(part._dual_coef_, part.support_vectors_)


def _check_nodes(
    left: Any, right: Any, leaf: NDArray[np.bool_], feature: Any, features: Any
) -> None:
    """Check that nodes form one tree, as scikit-learn stores it: children come after their parents.

    Args:
        left: index of the left child of each node.
        right: index of its right child.
        leaf: whether it has no children.
        feature: by which it is split.
        features: number of features.
    """
    inner = np.flatnonzero(~leaf)
    children = np.concatenate([left[inner], right[inner]]).astype(np.int64)
    ordered = (children > np.concatenate([inner, inner])).all()
    reached = np.array_equal(np.sort(children), np.arange(1, len(leaf)))
    _require(len(leaf) > 0 and ordered and reached, "the nodes of a tree do not form a tree")
    used = feature[inner]
    exists = ((used >= 0) & (used < features)).all()
    _require(exists, "a tree splits by a feature that does not exist")


def _check_numbers(values: NDArray[np.floating], others: NDArray[np.floating]) -> None:
    """Check that predicted values are finite, and the other numbers are numbers."""
    finite = np.isfinite(values).all() and not np.isnan(others).any()
    _require(finite, "a predicted number or a threshold is not a number")


def _require(condition: object, otherwise: str) -> None:
    """Raise a `ValueError` with the text `otherwise` unless a condition holds."""
    if not condition:
        raise ValueError(otherwise)
