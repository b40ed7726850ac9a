import pytest
import torch
from tensordict.nn import TensorDictModule
from torch.nn.functional import one_hot
from torchrl.envs import GymEnv, PendulumEnv, TransformedEnv

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.guides import ConstantGuide, RandomGuide, SplineGuide, ZeroGuide
from coil_rl.testing import check_env, check_transform
from coil_rl.transforms import GuideActions


def cone_env(guides, cars=6):
    return TransformedEnv(ConeTrackEnv(shipped_tracks("test"), cars), GuideActions(guides))


def test_advice_is_what_the_guide_says_about_the_same_moment():
    env, guide = cone_env({"spline": SplineGuide()}), SplineGuide()
    rollout = env.rollout(200, break_when_any_done=False)
    said = guide(rollout.select(*guide.in_keys).reshape(-1).clone())["action"].view(6, 200, 1)
    torch.testing.assert_close(rollout["guide_action"].squeeze(2), said)
    assert rollout["next", "done"].any(), "random driving should have crashed, so that resets are covered"


def test_a_state_knows_whose_advice_it_goes_with():
    guides = {"straight": ZeroGuide(), "left": ConstantGuide(0.5)}
    state = cone_env(guides).state_dict()
    cone_env(guides).load_state_dict(state)
    with pytest.raises(ValueError, match="the state is of the guides straight, left, not left, straight"):
        cone_env(dict(reversed(guides.items()))).load_state_dict(state)


def test_several_guides_keep_their_order():
    guides = {"right": ConstantGuide(-0.25), "straight": ZeroGuide(), "left": ConstantGuide(0.5)}
    env = cone_env(guides)
    assert env.transform.names == ["right", "straight", "left"]
    assert env.rollout(3)["guide_action"].squeeze(-1).unique(dim=1).shape == (6, 1, 3)
    assert env.reset()["guide_action"][0].flatten().tolist() == [-0.25, 0.0, 0.5]


def test_specs_hold_around_the_cone_env():
    check_env(cone_env({"spline": SplineGuide(), "random": RandomGuide()}), steps=60)


def test_specs_hold_around_pendulum():
    damp = TensorDictModule(lambda speed: -speed.unsqueeze(-1).clamp(-2, 2), in_keys=["thdot"], out_keys=["action"])
    env = TransformedEnv(PendulumEnv(), GuideActions({"damp": damp}))
    check_env(env)
    spec = env.observation_spec["guide_action"]
    assert spec.shape == (1, 1)
    assert (spec.space.low, spec.space.high) == (-2, 2)


@pytest.mark.parametrize("categorical", [True, False])
def test_discrete_advice_is_one_hot(categorical):
    def lean(observation):
        choice = (observation[..., 2] > 0).long()
        return choice if categorical else one_hot(choice, 2)

    guide = TensorDictModule(lean, in_keys=["observation"], out_keys=["action"])
    check_transform(GymEnv("CartPole-v1", categorical_action_encoding=categorical), GuideActions({"lean": guide}))
    env = TransformedEnv(GymEnv("CartPole-v1", categorical_action_encoding=categorical), GuideActions({"lean": guide}))
    rollout = env.rollout(5)
    leaning = (rollout["observation"][..., 2] > 0).long()
    assert torch.equal(rollout["guide_action"].squeeze(1), one_hot(leaning, 2).float())


def test_nothing_but_the_action_gets_through():
    def meddle(observation):
        return torch.zeros(len(observation), 1), torch.full_like(observation, 9)

    guide = TensorDictModule(meddle, in_keys=["observation"], out_keys=["action", "observation"])
    reset = cone_env({"meddler": guide}).reset()
    assert "action" not in reset
    assert (reset["observation"] <= 1).all()


def test_random_advice_goes_on_where_a_state_dict_left_it():
    env, again = cone_env({"random": RandomGuide(seed=3)}), cone_env({"random": RandomGuide(seed=4)})
    env.rollout(3)
    again.load_state_dict(env.state_dict())
    assert torch.equal(env.reset()["guide_action"], again.reset()["guide_action"])


def test_no_guide_and_a_guide_without_an_action_are_refused():
    with pytest.raises(ValueError, match="at least one guide"):
        GuideActions({})
    mute = TensorDictModule(lambda x: x, in_keys=["observation"], out_keys=["thought"])
    with pytest.raises(ValueError, match=r"guide 'mute' must write 'action'; it writes \['thought'\]"):
        GuideActions({"mute": mute})
    with pytest.raises(ValueError, match="'half' cannot be the name of a guide"):
        GuideActions({"half": ZeroGuide()})
