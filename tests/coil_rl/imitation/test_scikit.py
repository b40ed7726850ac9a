import io
import zipfile

import numpy as np
import pytest
import skops.io
import torch
from sklearn.cluster import KMeans
from sklearn.ensemble import (
    ExtraTreesRegressor,
    GradientBoostingRegressor,
    HistGradientBoostingRegressor,
    RandomForestRegressor,
)
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.linear_model import LinearRegression, Ridge
from sklearn.multioutput import MultiOutputRegressor
from sklearn.neighbors import KNeighborsRegressor
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from sklearn.svm import SVR

from coil_rl.errors import UserError
from coil_rl.imitation import Sklearn
from coil_rl.train import checkpoint

ESTIMATORS = [
    LinearRegression(),
    RandomForestRegressor(4),
    GradientBoostingRegressor(n_estimators=3),
    HistGradientBoostingRegressor(max_iter=3),
    KNeighborsRegressor(),
    GaussianProcessRegressor(),
    MLPRegressor(hidden_layer_sizes=(4,), max_iter=20),
    make_pipeline(StandardScaler(), SVR()),
    MultiOutputRegressor(Ridge()),
]


def data(outputs=1):
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(60, 4, generator=generator)
    return x, x[:, :outputs].sin()


def fitted(estimator, outputs=1):
    regressor = Sklearn(estimator).fresh(4, outputs)
    regressor.fit(*data(outputs))
    return regressor


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda estimator: type(estimator).__name__)
def test_what_is_kept_predicts_the_same_and_is_the_same_for_an_equal_fit(estimator, tmp_path):
    first, second, x = fitted(estimator), Sklearn(estimator).fresh(4, 1), data()[0]
    checkpoint.save(first.state_dict(), tmp_path / "state.pt")
    second.load_state_dict(checkpoint.load(tmp_path / "state.pt"))
    assert torch.equal(first(x), second(x))
    assert torch.equal(second.get_extra_state(), first.get_extra_state())
    again = fitted(estimator).get_extra_state()
    assert torch.equal(again, first.get_extra_state())
    assert first(x).dtype == torch.float32


def test_the_state_is_an_archive_that_skops_reads():
    regressor, (x, _) = fitted(LinearRegression()), data()
    state = regressor.get_extra_state()
    assert state.dtype == torch.uint8
    model = skops.io.loads(state.numpy().tobytes())
    np.testing.assert_allclose(model.predict(x.numpy()), regressor(x).squeeze(-1), rtol=1e-5)


def test_predictions_are_those_of_scikit_learn_for_any_batch_shape():
    (x, y), regressor = data(2), fitted(RandomForestRegressor(4, random_state=0), 2)
    expected = RandomForestRegressor(4, random_state=0).fit(x, y).predict(x)
    np.testing.assert_allclose(regressor(x), expected, rtol=1e-6)
    assert torch.equal(regressor(x.reshape(3, 5, 4, 4)), regressor(x).reshape(3, 5, 4, 2))
    assert torch.equal(regressor(x[7]), regressor(x)[7])


def test_a_forest_is_fitted_by_its_threads_and_asked_by_one():
    regressor, alone = fitted(RandomForestRegressor(4, n_jobs=2)), fitted(RandomForestRegressor(4))
    assert (regressor.estimator.n_jobs, regressor.model.n_jobs) == (2, 1)
    assert torch.equal(regressor(data()[0]), alone(data()[0]))


@pytest.mark.parametrize("outputs", [1, 2])
@pytest.mark.parametrize("forest", [RandomForestRegressor, ExtraTreesRegressor])
def test_the_trees_of_a_forest_say_what_the_forest_says(forest, outputs, monkeypatch):
    regressor = Sklearn(forest(8)).fresh(4, outputs)
    regressor.load_state_dict(fitted(forest(8), outputs).state_dict())
    x = torch.randn(300, 4, generator=torch.Generator().manual_seed(1))
    expected = torch.from_numpy(regressor.model.predict(x.numpy())).float().reshape(300, outputs)
    monkeypatch.setattr(forest, "predict", None)
    assert torch.equal(regressor(x), expected)


def test_a_forest_refuses_what_scikit_learn_refuses():
    regressor = fitted(RandomForestRegressor(4))
    with pytest.raises(ValueError, match="contains infinity"):
        regressor(torch.full((3, 4), torch.inf))
    with pytest.raises(ValueError, match="has 3 features, but RandomForestRegressor is expecting 4"):
        regressor(torch.zeros(2, 3))


def test_an_unknown_type_is_neither_kept_nor_read():
    estimator = make_pipeline(FunctionTransformer(torch.from_numpy), LinearRegression())
    with pytest.raises(UserError, match=r"torch\.from_numpy is neither kept nor read"):
        fitted(estimator).get_extra_state()
    evil = skops.io.dumps(estimator)
    with pytest.raises(UserError, match=r"torch\.from_numpy is neither kept nor read"):
        Sklearn(LinearRegression()).set_extra_state(torch.frombuffer(bytearray(evil), dtype=torch.uint8))


def test_what_is_no_regressor_is_not_read():
    regressor = Sklearn(LinearRegression())
    for content, said in (
        (b"no archive", "BadZipFile"),
        (skops.io.dumps(KMeans()), "holds a KMeans"),
        (empty_archive(), "KeyError"),
    ):
        with pytest.raises(UserError, match=said):
            regressor.set_extra_state(torch.frombuffer(bytearray(content), dtype=torch.uint8))


def test_a_state_that_reads_other_data_is_refused():
    with pytest.raises(UserError, match="reads 4 numbers, but 6 are observed"):
        Sklearn(LinearRegression()).fresh(6, 1).load_state_dict(fitted(LinearRegression()).state_dict())


def empty_archive():
    buffer = io.BytesIO()
    zipfile.ZipFile(buffer, "w").close()
    return buffer.getvalue()


def test_what_cannot_serve_is_refused_before_it_is_fitted():
    with pytest.raises(ValueError, match=r"KMeans\(\) is no regressor"):
        Sklearn(KMeans())
    with pytest.raises(ValueError, match="no regressor"):
        Sklearn(LinearRegression)
    with pytest.raises(ValueError, match=r"SVR\(\) predicts one number, .*MultiOutputRegressor"):
        Sklearn(SVR()).fresh(4, 2)
    assert fitted(MultiOutputRegressor(SVR()), 2)(data()[0]).shape == (60, 2)
