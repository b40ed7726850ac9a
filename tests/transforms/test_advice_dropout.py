import pytest
import torch
import worlds

from coil_rl.testing import check_transform
from coil_rl.transforms import AdviceDropout


def given(env, steps=30):
    """Return whether there is advice, whether it is zero, and where episodes begin.

    Each is [steps, rows].
    """
    still = torch.zeros(*env.batch_size, 1)
    data = env.rollout(steps, lambda td: td.set("action", still), break_when_any_done=False)
    shown, advice = data["advice_given"].squeeze(-1), data["guide_action"]
    assert advice[~shown].eq(0).all()
    return shown.T, (advice.abs().sum((2, 3)) > 0).T, data["next", "done"].squeeze(-1).T


def test_advice_is_missing_in_whole_episodes_as_often_as_asked_for():
    torch.manual_seed(0)
    env = worlds.cones(AdviceDropout(0.25, seed=1), cars=400).train()
    shown, nonzero, done = given(env)
    assert float(shown[0].float().mean()) == pytest.approx(0.75, abs=0.06)
    assert torch.equal(nonzero, shown & nonzero)
    within = ~done[:-1]
    assert torch.equal(shown[1:][within], shown[:-1][within]), "within an episode nothing changes"
    assert (shown[1:][done[:-1]] != shown[:-1][done[:-1]]).any(), "an episode draws anew"


@pytest.mark.parametrize("in_evaluation", [True, False])
def test_evaluation_is_with_advice_or_without(in_evaluation):
    env = worlds.cones(AdviceDropout(0.5, in_evaluation), cars=50).eval()
    shown, nonzero, _ = given(env, steps=3)
    assert (shown == in_evaluation).all()
    assert nonzero.any() == in_evaluation


def test_it_is_a_valid_transform_whose_second_one_has_the_last_word():
    check_transform(worlds.cones(), AdviceDropout(0.5).train())
    env = worlds.cones(AdviceDropout(0.0), AdviceDropout(in_evaluation=False)).eval()
    assert not env.reset()["advice_given"].any()
