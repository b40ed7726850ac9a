import torch
from tensordict import TensorDict

from coil_rl.guides import ConstantGuide, RandomGuide, ZeroGuide
from coil_rl.testing import check_guide

DATA = TensorDict({"observation": torch.zeros(5, 20)}, [5])


def test_constant_and_zero_keep_the_contract():
    check_guide(ConstantGuide([0.1, -0.2]), DATA)
    check_guide(ZeroGuide(size=3), DATA)
    assert ConstantGuide([0.1, -0.2])(DATA.copy())["action"].shape == (5, 2)
    assert (ZeroGuide(size=3)(DATA.copy())["action"] == 0).all()


def test_random_is_uniform_and_depends_on_its_seed():
    guide, same, other = (RandomGuide(-2, 1, seed=seed) for seed in (7, 7, 8))
    many = TensorDict({"observation": torch.zeros(100_000, 1)}, [100_000])
    draw = guide(many.copy())["action"]
    assert torch.equal(draw, same(many.copy())["action"])
    assert not torch.equal(draw, other(many.copy())["action"])
    assert -2 <= draw.min() < -1.99
    assert 0.99 < draw.max() < 1
    assert abs(draw.mean() + 0.5) < 0.01
