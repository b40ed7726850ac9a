import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.guides import ConstantGuide, SplineGuide, ZeroGuide
from coil_rl.transforms.guide_actions import GuideActions


def cone_env(guides, cars=6):
    return TransformedEnv(ConeTrackEnv(shipped_tracks("test"), cars), GuideActions(guides))


def test_advice_is_the_action_of_the_guide_for_the_same_step():
    env, guide = cone_env({"spline": SplineGuide()}), SplineGuide()
    rollout = env.rollout(100, break_when_any_done=False)
    expected = guide(rollout.select(*guide.in_keys).reshape(-1).clone())["action"].view(6, 100, 1)
    torch.testing.assert_close(rollout["guide_action"].squeeze(2), expected)
    assert rollout["next", "done"].any(), "resets should be covered"


def test_several_guides_keep_their_order_also_in_the_state():
    guides = {"right": ConstantGuide(-0.25), "straight": ZeroGuide(), "left": ConstantGuide(0.5)}
    env = cone_env(guides)
    assert env.transform.names == ["right", "straight", "left"]
    assert env.reset()["guide_action"][0].flatten().tolist() == [-0.25, 0.0, 0.5]
    assert env.rollout(3)["guide_action"].squeeze(-1).unique(dim=1).shape == (6, 1, 3)
    cone_env(guides).load_state_dict(env.state_dict())
    with pytest.raises(ValueError, match="guides right, straight, left, not left, straight, right"):
        cone_env(dict(reversed(guides.items()))).load_state_dict(env.state_dict())


def test_guide_changes_no_other_entry():
    def overwrite(observation):
        return torch.zeros(len(observation), 1), torch.full_like(observation, 9)

    guide = TensorDictModule(overwrite, in_keys=["observation"], out_keys=["action", "observation"])
    reset = cone_env({"overwrite": guide}).reset()
    assert "action" not in reset
    assert (reset["observation"] <= 1).all()
