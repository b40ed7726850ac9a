import pytest
import torch
from hosted_guides import cones
from tensordict.nn import TensorDictModule

from coil_rl.guides import ConstantGuide, SplineGuide, ZeroGuide


def test_advice_is_the_action_of_the_guide_for_the_same_step():
    env, guide = cones({"spline": SplineGuide()}), SplineGuide()
    rollout = env.rollout(100, break_when_any_done=False)
    expected = guide(rollout.select(*guide.in_keys).reshape(-1).clone())["action"].view(6, 100, 1)
    torch.testing.assert_close(rollout["guide_action"].squeeze(2), expected)
    assert rollout["next", "done"].any(), "resets should be covered"


def test_several_guides_keep_their_order_also_in_the_state():
    guides = {"right": ConstantGuide(-0.25), "straight": ZeroGuide(), "left": ConstantGuide(0.5)}
    env = cones(guides)
    assert env.transform[0].names == ["right", "straight", "left"]
    assert env.reset()["guide_action"][0].flatten().tolist() == [-0.25, 0.0, 0.5]
    assert env.rollout(3)["guide_action"].squeeze(-1).unique(dim=1).shape == (6, 1, 3)
    cones(guides).load_state_dict(env.state_dict())
    with pytest.raises(ValueError, match="guides right, straight, left, not left, straight, right"):
        cones(dict(reversed(guides.items()))).load_state_dict(env.state_dict())


def test_guide_changes_no_other_entry():
    def overwrite(observation):
        return torch.zeros(len(observation), 1), torch.full_like(observation, 9)

    guide = TensorDictModule(overwrite, in_keys=["observation"], out_keys=["action", "observation"])
    reset = cones({"overwrite": guide}).reset()
    assert "action" not in reset
    assert (reset["observation"] <= 1).all()
