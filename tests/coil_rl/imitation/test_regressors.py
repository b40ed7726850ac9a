import pytest
import torch
from sklearn.linear_model import LinearRegression

from coil_rl.imitation import LinearRegressor, NetworkRegressor
from coil_rl.schedules import Linear


def scaled_data():
    """Inputs and outputs with different units, one input constant."""
    x = torch.rand(400, 3, generator=torch.Generator().manual_seed(0))
    return x * torch.tensor([1.0, 1e3, 0.0]), torch.stack([100 + x[:, 0], x[:, 1].square()], -1)


def fitted_network(**changes):
    options = {"hidden": (16,), "epochs": 80, "minibatch": 64, "learning_rate": Linear(1e-2, 0)}
    network = NetworkRegressor(**options | changes).fresh(3, 2)
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


def test_linear_regression_is_that_of_scikit_learn():
    x, y = scaled_data()
    ours, theirs = LinearRegressor().fresh(3, 2), LinearRegression().fit(x.double(), y.double())
    assert (ours(x) == 0).all()
    ours.fit(x, y)
    torch.testing.assert_close(
        ours.weights, torch.from_numpy(theirs.coef_.T), rtol=1e-12, atol=1e-12
    )
    assert torch.equal(ours(x), torch.from_numpy(theirs.predict(x.numpy())).float())


def test_values_out_of_range_are_refused_before_the_fit():
    values = {"hidden": (0,), "epochs": 0, "minibatch": 0, "learning_rate": 0, "seed": -1}
    for name, value in values.items():
        with pytest.raises(ValueError, match=f"{name}(\\[0\\])?=.* must be"):
            NetworkRegressor(**{name: value})
