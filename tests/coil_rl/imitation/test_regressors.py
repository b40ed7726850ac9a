import os

import pytest
import skops.io
import torch
from sklearn.cluster import KMeans
from sklearn.ensemble import (
    BaggingRegressor,
    ExtraTreesRegressor,
    GradientBoostingRegressor,
    HistGradientBoostingRegressor,
    RandomForestRegressor,
)
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.linear_model import GammaRegressor, LinearRegression, Ridge
from sklearn.model_selection import GridSearchCV
from sklearn.multioutput import MultiOutputRegressor
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, PowerTransformer, StandardScaler
from sklearn.svm import SVR

from coil_rl.errors import UserError
from coil_rl.imitation import NetworkRegressor, SklearnRegressor
from coil_rl.run import checkpoint
from coil_rl.schedules import Linear


def scaled_data():
    """Inputs and outputs with different units, one input constant."""
    x = torch.rand(400, 3, generator=torch.Generator().manual_seed(0))
    return x * torch.tensor([1.0, 1e3, 0.0]), torch.stack([100 + x[:, 0], x[:, 1].square()], -1)


def fitted_network(**changes):
    options = {
        "hidden": (16,),
        "epochs": 80,
        "minibatch": 64,
        "learning_rate": Linear(1e-2, 0),
    } | changes
    network = NetworkRegressor(**options).fresh(3, 2)
    network.fit(*scaled_data())
    return network


def test_network_error_does_not_depend_on_units():
    x, y = scaled_data()
    with torch.no_grad():
        error = (fitted_network()(x) - y).square().mean(0)
    assert (error < 0.02 * y.var(0)).all()


def test_network_fit_follows_from_the_data_and_the_seed_and_leaves_the_global_generator_alone():
    first, x = fitted_network(epochs=3), scaled_data()[0]
    torch.manual_seed(99)
    state = torch.get_rng_state()
    second, other = fitted_network(epochs=3), fitted_network(epochs=3, seed=1)
    second.fit(*scaled_data())
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(first(x), second(x))
    assert not torch.equal(first(x), other(x))
    fresh = NetworkRegressor((16,)).fresh(3, 2)
    assert (fresh(x) == 0).all()
    fresh.load_state_dict(first.state_dict())
    assert torch.equal(first(x), fresh(x))


ESTIMATORS = [
    LinearRegression(),
    RandomForestRegressor(4),
    GradientBoostingRegressor(n_estimators=3),
    HistGradientBoostingRegressor(max_iter=3),
    KNeighborsRegressor(),
    GaussianProcessRegressor(),
    make_pipeline(StandardScaler(), SVR()),
    MultiOutputRegressor(Ridge()),
]
UNSAFE = make_pipeline(FunctionTransformer(torch.from_numpy), LinearRegression())


def data(outputs=1):
    x = torch.randn(60, 4, generator=torch.Generator().manual_seed(0))
    return x, x[:, :outputs].sin()


def fitted(estimator, outputs=1):
    regressor = SklearnRegressor(estimator).fresh(4, outputs)
    regressor.fit(*data(outputs))
    return regressor


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda estimator: type(estimator).__name__)
def test_restored_regressor_and_equal_fit_predict_the_same(estimator, tmp_path):
    first, second, x = fitted(estimator), SklearnRegressor(estimator).fresh(4, 1), data()[0]
    checkpoint.save(first.state_dict(), tmp_path / "state.pt")
    second.load_state_dict(checkpoint.load(tmp_path / "state.pt"))
    assert torch.equal(first(x), second(x))
    assert torch.equal(second.get_extra_state(), first.get_extra_state())
    assert torch.equal(first(x), fitted(estimator)(x))
    assert first(x).dtype == torch.float32


@pytest.mark.parametrize("outputs", [1, 2])
@pytest.mark.parametrize("forest", [RandomForestRegressor, ExtraTreesRegressor])
def test_fast_prediction_of_a_forest_equals_that_of_scikit_learn(forest, outputs, monkeypatch):
    regressor = fitted(forest(8, n_jobs=2), outputs)
    assert (regressor.estimator.n_jobs, regressor.model.n_jobs) == (2, 1), (
        "threads are for the fit only"
    )
    x = torch.randn(300, 4, generator=torch.Generator().manual_seed(1))
    expected = torch.from_numpy(regressor.model.predict(x.numpy())).float().reshape(300, outputs)
    monkeypatch.setattr(forest, "predict", None)
    assert torch.equal(regressor(x), expected)
    assert torch.equal(regressor(x.reshape(3, 5, 20, 4)), expected.reshape(3, 5, 20, outputs))
    assert torch.equal(regressor(x[7]), expected[7])
    monkeypatch.undo()
    with pytest.raises(ValueError, match="contains infinity"):
        regressor(torch.full((3, 4), torch.inf))
    with pytest.raises(ValueError, match=f"has 3 features, but {forest.__name__} is expecting 4"):
        regressor(torch.zeros(2, 3))


def test_states_that_could_run_code_or_do_not_fit_are_refused():
    with pytest.raises(UserError, match=r"torch\.from_numpy could run code"):
        fitted(UNSAFE).get_extra_state()
    regressor = SklearnRegressor(LinearRegression()).fresh(6, 1)
    for content, message in (
        (skops.io.dumps(UNSAFE), r"torch\.from_numpy could run code"),
        (b"no archive", "is not a regressor of scikit-learn .BadZipFile"),
        (
            skops.io.dumps(fitted(LinearRegression()).model),
            "a regressor of 4 inputs, but there are 6 here",
        ),
    ):
        with pytest.raises(UserError, match=message):
            regressor.set_extra_state(torch.frombuffer(bytearray(content), dtype=torch.uint8))


def test_unusable_estimators_and_values_out_of_range_are_refused_before_the_fit():
    for name, value in (
        ("hidden", (0,)),
        ("epochs", 0),
        ("minibatch", 0),
        ("learning_rate", 0),
        ("seed", -1),
    ):
        with pytest.raises(ValueError, match=f"{name}=.* must be"):
            NetworkRegressor(**{name: value})
    for estimator in (KMeans(), LinearRegression):
        with pytest.raises(ValueError, match="is not a regressor of scikit-learn"):
            SklearnRegressor(estimator)
    with pytest.raises(ValueError, match=r"SVR\(\) predicts one number, .*MultiOutputRegressor"):
        SklearnRegressor(SVR()).fresh(4, 2)
    assert fitted(MultiOutputRegressor(SVR()), 2)(data()[0]).shape == (60, 2)


@pytest.mark.parametrize(
    ("estimator", "words"),
    [
        (GammaRegressor(), "GammaRegressor cannot be fitted to 50 samples of 2 inputs"),
        (BaggingRegressor(max_samples=2.0), "BaggingRegressor cannot be fitted"),
        (make_pipeline(PowerTransformer(method="box-cox"), Ridge()), "Pipeline cannot be fitted"),
        (GridSearchCV(Ridge(), {"alpah": [1]}), "GridSearchCV cannot be fitted.*alpah"),
    ],
    ids=lambda part: type(part).__name__,
)
def test_estimator_that_refuses_its_data_is_named(estimator, words):
    x = torch.rand(50, 2) - 0.5
    with pytest.raises(UserError, match=words):
        SklearnRegressor(estimator).fresh(2, 1).fit(x, x[:, :1])


@pytest.mark.parametrize("jobs", [100_000, -100_000, 2**40])
def test_number_of_processes_is_limited(jobs):
    regressor = SklearnRegressor(
        BaggingRegressor(RandomForestRegressor(2, n_jobs=jobs), n_jobs=jobs)
    )
    most = os.cpu_count()
    parameters = regressor.estimator.get_params()
    assert abs(parameters["n_jobs"]) <= most
    assert abs(parameters["estimator__n_jobs"]) <= most


def test_boosted_trees_that_begin_with_another_regressor_are_refused():
    for estimator in (
        GradientBoostingRegressor(init=Ridge()),
        BaggingRegressor(GradientBoostingRegressor(init=Ridge())),
    ):
        with pytest.raises(ValueError, match="leave init out"):
            SklearnRegressor(estimator)
