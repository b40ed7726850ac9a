import pytest
import torch

from coil_rl.imitation import Network
from coil_rl.schedules import Linear


def data(outputs=1):
    x = torch.rand(400, 3, generator=torch.Generator().manual_seed(0))
    return x * torch.tensor([1.0, 1e3, 0.0]), torch.stack([100 + x[:, 0], x[:, 1].square()], -1)[:, :outputs]


def fitted(**changes):
    network = Network(**{"hidden": (16,), "epochs": 80, "minibatch": 64, "learning_rate": Linear(1e-2, 0)} | changes)
    network = network.fresh(3, 2)
    network.fit(*data(2))
    return network


def test_units_of_the_entries_do_not_matter():
    x, y = data(2)
    with torch.no_grad():
        error = (fitted()(x) - y).square().mean(0)
    assert (error < 0.02 * y.var(0)).all()


def test_a_fit_follows_from_the_data_and_the_seed_alone():
    first = fitted(epochs=3)
    torch.manual_seed(99)
    second, other = fitted(epochs=3), fitted(epochs=3, seed=1)
    second.fit(*data(2))
    x = data()[0]
    assert torch.equal(first(x), second(x))
    assert not torch.equal(first(x), other(x))


def test_fitting_leaves_the_global_draws_alone():
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    fitted(epochs=1)
    assert torch.equal(torch.rand(2), expected)


def test_a_fresh_one_predicts_0_and_takes_over_a_state():
    first, second, x = fitted(epochs=3), Network((16,)).fresh(3, 2), data()[0]
    assert (second(x) == 0).all()
    second.load_state_dict(first.state_dict())
    assert torch.equal(first(x), second(x))


@pytest.mark.parametrize(("name", "value"), [("hidden", (0,)), ("epochs", 0), ("minibatch", 0), ("learning_rate", 0)])
def test_numbers_outside_their_range_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name}=.* must be"):
        Network(**{name: value})
