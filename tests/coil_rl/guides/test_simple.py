import torch
from tensordict import TensorDict

from coil_rl.guides import ConstantGuide, RandomGuide, ZeroGuide

DATA = TensorDict({"observation": torch.zeros(5, 20)}, [5])


def test_constant_and_zero_are_the_same_in_each_row():
    for guide, expected in (
        (ConstantGuide([0.1, -0.2]), [0.1, -0.2]),
        (ZeroGuide(size=3), [0, 0, 0]),
    ):
        assert torch.equal(guide(DATA.copy())["action"], torch.tensor(expected).expand(5, -1))


def test_random_is_uniform_and_depends_on_its_seed():
    many = TensorDict({"observation": torch.zeros(100_000, 1)}, [100_000])
    action, same, other = (
        RandomGuide(-2, 1, seed=seed)(many.copy())["action"] for seed in (7, 7, 8)
    )
    assert torch.equal(action, same)
    assert not torch.equal(action, other)
    assert -2 <= action.min() < -1.99
    assert 0.99 < action.max() < 1
    assert abs(action.mean() + 0.5) < 0.01


def test_batch_shape_is_that_of_the_data_whatever_is_observed():
    images = TensorDict({"observation": torch.zeros(5, 8, 8, 3, dtype=torch.uint8)}, [5])
    for guide in (ConstantGuide([0.1, -0.2]), ZeroGuide(size=2), RandomGuide(size=2)):
        action = guide(images.copy())["action"]
        assert action.shape == (5, 2)
        assert action.dtype == torch.float32
