import math
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_module
from hydra.utils import instantiate
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, GymEnv, PendulumEnv, SerialEnv, TransformedEnv

from coil_rl.envs import ConeTrackEnv, random_tracks
from coil_rl.guides import ConstantGuide, SplineGuide, ZeroGuide
from coil_rl.testing import check_env, check_transform
from coil_rl.transforms import (
    BiasedAdvice,
    DelayedAdvice,
    GuideActions,
    NoisyAdvice,
    PartialAdvice,
    RemovedAdvice,
    ScaledAdvice,
    ShuffledAdvice,
)

CONF = Path(__file__).parents[2] / "conf" / "degrade"
NAMES = sorted(file.stem for file in CONF.glob("*.yaml"))
STEADY = ["adversarial", "biased", "partial", "undertuned", "zeroed"]
CARS = 6
WORLD = ConeTrackEnv(random_tracks(count=1, seed=5), CARS)


def chosen(*names):
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        return compose(overrides=[f"+degrade=[{','.join(names)}]", "+seed=3"]).degrade


def named(*names):
    return [instantiate(node) for node in chosen(*names).values()]


def cone_env(*degraders, guide=None):
    return TransformedEnv(WORLD, Compose(GuideActions({"spline": guide or SplineGuide()}), *degraders))


def pendulum_env(*degraders):
    damp = TensorDictModule(lambda speed: -speed.unsqueeze(-1).clamp(-2, 2), in_keys=["thdot"], out_keys=["action"])
    push = TensorDictModule(lambda angle: angle.unsqueeze(-1).sin(), in_keys=["th"], out_keys=["action"])
    return TransformedEnv(SerialEnv(3, PendulumEnv), Compose(GuideActions({"damp": damp, "push": push}), *degraders))


def cartpole_env(*degraders):
    lean = TensorDictModule(lambda x: (x[..., 2] > 0).long(), in_keys=["observation"], out_keys=["action"])
    several = SerialEnv(3, lambda: GymEnv("CartPole-v1", categorical_action_encoding=True))
    return TransformedEnv(several, Compose(GuideActions({"lean": lean}), *degraders))


def after(transform, *advice):
    """What becomes of the advice of one guide, one number a row."""
    data = TensorDict({"guide_action": torch.tensor(advice).view(-1, 1, 1)}, [len(advice)])
    return transform(data)["guide_action"].flatten().tolist()


@pytest.mark.parametrize("name", NAMES)
def test_specs_hold_around_the_cone_env(name):
    check_transform(WORLD, Compose(GuideActions({"spline": SplineGuide()}), *named(name)))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("env", [pendulum_env, cartpole_env])
def test_specs_hold_around_other_envs_with_several_guides_and_choices(env, name):
    check_env(env(*named(name)), steps=4)


@pytest.mark.parametrize("name", [name for name in NAMES if name != "shuffled"])
def test_specs_hold_around_one_world_without_a_batch(name):
    guide = TensorDictModule(lambda x: x[..., :1].clamp(-1, 1), in_keys=["observation"], out_keys=["action"])
    check_transform(GymEnv("Pendulum-v1"), Compose(GuideActions({"one": guide}), *named(name)))


def test_all_of_them_behind_one_another_keep_the_contract():
    check_env(cone_env(*named(*NAMES)), steps=10)


def test_files_compose_in_the_order_given_and_take_the_seed():
    assert list(chosen("delayed", "noisy")) == ["delayed", "noisy"]
    assert list(chosen("noisy", "delayed")) == ["noisy", "delayed"]
    assert chosen("noisy").noisy.seed == chosen("shuffled").shuffled.seed == 3
    assert [next(iter(chosen(name))) for name in NAMES] == NAMES
    late, early = cone_env(BiasedAdvice(0.5), ScaledAdvice(0.5)), cone_env(ScaledAdvice(0.5), BiasedAdvice(0.5))
    guide = cone_env().reset()["guide_action"]
    torch.testing.assert_close(late.reset()["guide_action"], (guide + 0.5).clamp(-1, 1) / 2)
    torch.testing.assert_close(early.reset()["guide_action"], guide / 2 + 0.5)


def test_stored_advice_is_changed_by_known_numbers():
    assert after(BiasedAdvice(0.25), -0.5, 0.5) == [-0.25, 0.75]
    assert after(ScaledAdvice(0.5), -0.5, 1.0) == [-0.25, 0.5]
    assert after(ScaledAdvice(0), -0.5, 1.0) == [0, 0]
    assert after(ScaledAdvice(-1), -0.5, 1.0) == [0.5, -1]
    assert after(PartialAdvice("left"), -0.5, 0.25) == [0, 0.25]
    assert after(PartialAdvice("right"), -0.5, 0.25) == [-0.5, 0]


@pytest.mark.parametrize("name", STEADY)
def test_env_and_stored_data_give_the_same(name):
    plain, degraded = (cone_env(*parts, guide=SplineGuide()).rollout(
        5, lambda td: td.set("action", torch.full((CARS, 1), 0.1)), break_when_any_done=False
    ) for parts in ((), named(name)))  # fmt: skip
    transform = named(name)[0]
    torch.testing.assert_close(transform(plain.clone())["guide_action"].clamp(-1, 1), degraded["guide_action"])


def test_advice_stays_within_the_bounds_of_the_env():
    env = pendulum_env(BiasedAdvice(1.75))
    spec = env.observation_spec["guide_action"]
    assert spec == pendulum_env().observation_spec["guide_action"]
    advice = env.rollout(20)["guide_action"]
    assert advice.max() == 2
    assert (advice > -2).all()
    assert cone_env(BiasedAdvice(3)).reset()["guide_action"].eq(1).all()
    assert cartpole_env(BiasedAdvice(0.5)).reset()["guide_action"].le(1).all()


def test_noise_has_the_spread_asked_for_and_is_new_at_every_step():
    many = TensorDict({"guide_action": torch.zeros(50_000, 2, 1)}, [50_000])
    noise = [NoisyAdvice(0.3, seed)(many.clone())["guide_action"] for seed in (1, 1, 2)]
    assert noise[0].std() == pytest.approx(0.3, abs=0.005)
    assert noise[0].mean() == pytest.approx(0, abs=0.005)
    assert torch.equal(noise[0], noise[1])
    assert not torch.equal(noise[0], noise[2])
    assert abs(torch.corrcoef(noise[0].squeeze(-1).t())[0, 1]) < 0.02, "guides should have noise of their own"
    rollout = cone_env(NoisyAdvice(0.1), guide=ZeroGuide()).rollout(12, break_when_any_done=False)
    assert rollout["guide_action"].unique().numel() == CARS * 12


def test_draws_go_on_where_a_state_dict_left_them():
    for make in (NoisyAdvice, ShuffledAdvice):
        env, again = cone_env(make(seed=3)), cone_env(make(seed=4))
        env.rollout(3)
        again.load_state_dict(env.state_dict())
        assert torch.equal(env.reset()["guide_action"], again.reset()["guide_action"])


def test_a_reset_between_two_steps_changes_no_noise_of_other_rows_and_draws_its_own():
    env = cone_env(NoisyAdvice(0.1, seed=3), guide=ZeroGuide())
    carrier = env.reset()
    seen = [carrier["guide_action"]]
    for _ in range(4):
        step = env.step(carrier.set("action", torch.zeros(CARS, 1)))["next"]
        seen.append(step["guide_action"])
        carrier = env.reset(step.clone().set("_reset", torch.arange(CARS).unsqueeze(-1) == 2))
        seen.append(carrier["guide_action"][2:3])
    assert torch.cat(seen).unique().numel() == CARS + 4 * (CARS + 1)


@pytest.mark.parametrize(
    "make",
    [
        lambda: [NoisyAdvice()],
        lambda: [BiasedAdvice()],
        lambda: [ScaledAdvice(-1)],
        lambda: [PartialAdvice("right")],
        lambda: [DelayedAdvice(2)],
        lambda: [RemovedAdvice()],
        lambda: [NoisyAdvice(seed=1), DelayedAdvice(2), NoisyAdvice(seed=2)],
    ],
    ids=["noisy", "biased", "scaled", "partial", "delayed", "removed", "three"],
)
def test_advice_of_a_row_does_not_depend_on_resets_of_other_rows(make):
    def drive(resets):
        env = cone_env(*make())
        carrier, seen = env.reset(), []
        for step in range(8):
            action = torch.linspace(-0.3, 0.3, CARS).unsqueeze(-1) * math.cos(step)
            carrier = env.step(carrier.set("action", action))["next"].clone()
            mask = torch.zeros(CARS, 1, dtype=torch.bool)
            mask[resets.get(step, [])] = True
            if mask.any():
                carrier = env.reset(carrier.set("_reset", mask))
            seen.append(carrier["guide_action"].clone())
        return torch.stack(seen, 1)

    often, seldom = drive({1: [0, 3], 3: [0], 4: [3, 0], 5: [1]}), drive({3: [4], 5: [1, 5]})
    assert torch.equal(often[1:3], seldom[1:3])
    assert not torch.equal(often, seldom)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: NoisyAdvice(sigma=-1), "sigma=-1 must be a finite number of at least 0"),
        (lambda: BiasedAdvice(math.nan), "offset=nan must be a finite number"),
        (lambda: ScaledAdvice(math.inf), "gain=inf must be a finite number"),
        (lambda: PartialAdvice("up"), "side='up' must be one of left, right"),
        (lambda: DelayedAdvice(-1), "steps=-1 must be at least 0"),
    ],
)
def test_a_value_outside_its_range_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_an_env_without_advice_is_refused():
    with pytest.raises(KeyError, match=r"BiasedAdvice changes 'guide_action', but the env .* behind GuideActions"):
        TransformedEnv(WORLD, BiasedAdvice()).observation_spec  # noqa: B018


def test_another_key_is_served():
    key = ("advice", "middle")
    makes = (NoisyAdvice, ShuffledAdvice, DelayedAdvice, RemovedAdvice)
    guides = GuideActions({"steady": ConstantGuide(0.5)}, out_key=key)
    env = TransformedEnv(WORLD, Compose(guides, *(make(key=key) for make in makes)))
    check_env(env)
    assert env.reset()[key].eq(0).all()
