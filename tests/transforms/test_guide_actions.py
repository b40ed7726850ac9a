import pytest
import torch
import worlds
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch.nn.functional import one_hot
from torchrl.envs import TransformedEnv

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.guides import ConstantGuide, RandomGuide, SplineGuide, ZeroGuide
from coil_rl.testing import check_env
from coil_rl.transforms.guide_actions import GuideActions, GuideCache, Guides


def cone_env(guides, cars=6):
    return TransformedEnv(ConeTrackEnv(shipped_tracks("test"), cars), GuideActions(guides))


def test_advice_is_the_action_of_the_guide_for_the_same_step():
    env, guide = cone_env({"spline": SplineGuide()}), SplineGuide()
    rollout = env.rollout(200, break_when_any_done=False)
    expected = guide(rollout.select(*guide.in_keys).reshape(-1).clone())["action"].view(6, 200, 1)
    torch.testing.assert_close(rollout["guide_action"].squeeze(2), expected)
    assert rollout["next", "done"].any(), "random driving should have crashed, so that resets are covered"


def test_several_guides_keep_their_order_also_in_the_state():
    guides = {"right": ConstantGuide(-0.25), "straight": ZeroGuide(), "left": ConstantGuide(0.5)}
    env = cone_env(guides)
    assert env.transform.names == ["right", "straight", "left"]
    assert env.reset()["guide_action"][0].flatten().tolist() == [-0.25, 0.0, 0.5]
    assert env.rollout(3)["guide_action"].squeeze(-1).unique(dim=1).shape == (6, 1, 3)
    cone_env(guides).load_state_dict(env.state_dict())
    with pytest.raises(ValueError, match="guides right, straight, left, not left, straight, right"):
        cone_env(dict(reversed(guides.items()))).load_state_dict(env.state_dict())


def test_specs_hold_for_cone_env_and_pendulum():
    check_env(cone_env({"spline": SplineGuide(), "random": RandomGuide()}), steps=60)
    env = worlds.pendulum()
    check_env(env)
    spec = env.observation_spec["guide_action"]
    assert (spec.shape, spec.space.low, spec.space.high) == ((1, 1), -2, 2)


@pytest.mark.parametrize("categorical", [True, False])
def test_discrete_advice_is_one_hot(categorical):
    env = worlds.carts(categorical=categorical)
    check_env(env)
    rollout = env.rollout(5)
    leaning = (rollout["observation"][..., 2] > 0).long()
    assert torch.equal(rollout["guide_action"].squeeze(-2), one_hot(leaning, 2).float())


def test_a_guide_changes_no_other_entry():
    def overwrite(observation):
        return torch.zeros(len(observation), 1), torch.full_like(observation, 9)

    guide = TensorDictModule(overwrite, in_keys=["observation"], out_keys=["action", "observation"])
    reset = cone_env({"overwrite": guide}).reset()
    assert "action" not in reset
    assert (reset["observation"] <= 1).all()


@pytest.mark.parametrize(
    ("guides", "options", "message"),
    [
        ({}, {}, "at least one guide"),
        ({"half": ZeroGuide()}, {}, "'half' cannot be the name of a guide"),
        ({"other": ZeroGuide(out_key="thought")}, {}, r"'other' must write 'action'; it writes \['thought'\]"),
        ({"zero": ZeroGuide()}, {"trainable": True}, "guide 'zero' has no parameters"),
    ],
)
def test_invalid_guides_are_rejected(guides, options, message):
    with pytest.raises(ValueError, match=message):
        Guides(guides, **options)


class CountingFunction:
    def __init__(self):
        self.rows = 0

    def __call__(self, data):
        self.rows += len(data)
        return data["x"].sum(-1, keepdim=True) + data["n"].unsqueeze(-1)


def rows(*values):
    x = torch.tensor(values, dtype=torch.float32)
    return TensorDict({"x": torch.stack([x, 2 * x], -1), "n": x.long()}, [len(values)])


def test_cached_advice_equals_the_function():
    cache, function = GuideCache(), CountingFunction()
    for data in (rows(1, 2, 1), rows(2), rows(3, 3, 1), rows(), rows(1, 2, 3)):
        assert torch.equal(cache(data, function), CountingFunction()(data))
    assert function.rows == 3, "the function should be called for new rows only"


def test_cache_is_bounded():
    cache, function = GuideCache(max_rows=3), CountingFunction()
    cache(rows(1, 2, 3), function)
    for _ in range(2):
        assert torch.equal(cache(rows(1, 4), function), CountingFunction()(rows(1, 4)))
    assert function.rows == 3 + 2 * 2
    assert len(cache.index) == 3
