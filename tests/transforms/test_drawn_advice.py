import pytest
import torch
import worlds
from tensordict import TensorDict

from coil_rl.transforms import RandomAdvice


def test_random_advice_is_uniform_whatever_the_guide_says():
    drawn = [
        RandomAdvice(-0.5, 1.0, seed=1)(TensorDict({"guide_action": torch.full((50_000, 1, 1), says)}, [50_000]))
        for says in (-1.0, 0.7)
    ]
    advice = drawn[0]["guide_action"]
    assert torch.equal(advice, drawn[1]["guide_action"])
    assert -0.5 <= advice.min() < -0.49
    assert 0.99 < advice.max() <= 1
    assert advice.mean() == pytest.approx(0.25, abs=0.01)
    assert advice.std() == pytest.approx(1.5 / 12**0.5, abs=0.01)


def test_random_advice_is_new_at_every_step_for_every_car():
    rollout = worlds.cones(RandomAdvice()).rollout(12, break_when_any_done=False)
    assert rollout["guide_action"].unique().numel() == 6 * 12


def test_draws_go_on_where_a_state_dict_left_them():
    env, again = worlds.cones(RandomAdvice(seed=3)), worlds.cones(RandomAdvice(seed=4))
    env.rollout(3)
    again.load_state_dict(env.state_dict())
    assert torch.equal(env.reset()["guide_action"], again.reset()["guide_action"])


def test_no_range_is_refused():
    with pytest.raises(ValueError, match=r"low=1\.0 must be less than high=0\.5, and both finite"):
        RandomAdvice(1.0, 0.5)
