import pytest
import torch
from sklearn.ensemble import RandomForestRegressor

from coil_rl.errors import UserError
from coil_rl.imitation import ForestRegressor


def data(outputs=1):
    x = torch.randn(60, 4, generator=torch.Generator().manual_seed(0))
    return x, x[:, :outputs].sin()


def fitted(outputs=1, **options):
    regressor = ForestRegressor(**{"n_estimators": 5, "max_depth": 6} | options).fresh(4, outputs)
    regressor.fit(*data(outputs))
    return regressor


@pytest.mark.parametrize("outputs", [1, 2])
@pytest.mark.parametrize("rows", [1, 300, 5000])
def test_prediction_equals_that_of_scikit_learn(outputs, rows):
    x, y = data(outputs)
    options = {"n_estimators": 8, "max_depth": None, "random_state": 3}
    expected = RandomForestRegressor(**options).fit(x.double().numpy(), y.double().numpy())
    regressor = fitted(outputs, n_jobs=2, **options)
    x = torch.randn(rows, 4, generator=torch.Generator().manual_seed(1))
    y = torch.from_numpy(expected.predict(x.numpy())).float().reshape(rows, outputs)
    assert torch.equal(regressor(x), y)
    assert torch.equal(regressor(x.reshape(1, rows, 4)), y.reshape(1, rows, outputs))
    assert torch.equal(regressor(x[0]), y[0])


def test_equal_fit_predicts_the_same():
    x = data()[0]
    assert (ForestRegressor().fresh(4, 1)(x) == 0).all()
    assert torch.equal(fitted()(x), fitted()(x))


def test_inputs_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="finite inputs"):
        fitted()(torch.full((3, 4), torch.inf))


def changed(name, index, value):
    def change(state):
        state[name][index] = value

    return change


FORGED = {
    "child out of range": changed("children", (0, 0), 10**6),
    "negative child": changed("children", (0, 1), -7),
    "cycle": changed("children", (1, 0), 0),
    "half a leaf": changed("children", (0, 0), 0),
    "negative feature": changed("features", 0, -3),
    "feature out of range": changed("features", 0, 4),
    "tree out of range": changed("roots", 1, 10**6),
    "NaN as threshold": changed("thresholds", 0, torch.nan),
    "NaN as value": changed("values", 0, torch.nan),
    "no tree": lambda state: state.update(roots=state["roots"][:0]),
    "an array is missing": lambda state: state.pop("roots"),
    "another array": lambda state: state.update(more=state["roots"]),
    "another size": lambda state: state.update(values=state["values"][:-1]),
    "two outputs": lambda state: state.update(values=state["values"].expand(-1, 2)),
    "another type": lambda state: state.update(children=state["children"].float()),
    "a number": lambda state: state.update(roots=0),
}


@pytest.mark.parametrize("forgery", FORGED)
def test_forged_state_is_refused(forgery):
    state = {name: each.clone() for name, each in fitted().get_extra_state().items()}
    FORGED[forgery](state)
    with pytest.raises(UserError, match="is not a forest of 4 inputs and 1 outputs; train again"):
        ForestRegressor().fresh(4, 1).set_extra_state(state)


def test_state_of_other_inputs_and_of_an_earlier_version_is_refused():
    for inputs, state in ((2, fitted().get_extra_state()), (4, torch.zeros(9, dtype=torch.uint8))):
        with pytest.raises(UserError, match=f"is not a forest of {inputs} inputs"):
            ForestRegressor().fresh(inputs, 1).set_extra_state(state)


@pytest.mark.parametrize(
    ("name", "value"),
    [("n_estimators", 0), ("n_estimators", 10**9), ("max_depth", 0), ("random_state", -1)],
)
def test_values_out_of_range_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name}=.* must be"):
        ForestRegressor(**{name: value})


@pytest.mark.parametrize("jobs", [100_000, -100_000, 2**40])
def test_number_of_processes_is_limited(jobs):
    assert abs(ForestRegressor(n_jobs=jobs).options["n_jobs"]) <= 1024
