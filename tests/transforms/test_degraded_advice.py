import math
from pathlib import Path

import pytest
import torch
import worlds
from hydra import compose, initialize_config_module
from hydra.utils import instantiate
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, PendulumEnv, SerialEnv, TransformedEnv

from coil_rl.envs import ConeTrackEnv, random_tracks
from coil_rl.guides import ConstantGuide, RandomGuide, SplineGuide, ZeroGuide
from coil_rl.testing import check_env
from coil_rl.transforms import (
    BiasedAdvice,
    DelayedAdvice,
    GuideActions,
    NoisyAdvice,
    PartialAdvice,
    RandomAdvice,
    RemovedAdvice,
    ScaledAdvice,
    ShuffledAdvice,
)

CONF = Path(__file__).parents[2] / "conf" / "degrade"
NAMES = sorted(file.stem for file in CONF.glob("*.yaml"))
CARS = 6
WORLD = ConeTrackEnv(random_tracks(count=1, seed=5), CARS)


class Counting(TensorDictModule):
    """Guide with another action at every call and in every row: 0.01 * calls + 0.1 * row."""

    def __init__(self):
        super().__init__(self.count, in_keys=["steering"], out_keys=["action"])
        self.calls = -1

    def count(self, steering):
        self.calls += 1
        return (0.01 * self.calls + 0.1 * torch.arange(len(steering))).unsqueeze(-1)


def configs(*names):
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        return compose(overrides=[f"+degrade=[{','.join(names)}]", "+seed=3"]).degrade


def configured(*names):
    return [instantiate(node) for node in configs(*names).values()]


def cone_env(*degraders, guide=None):
    return TransformedEnv(WORLD, Compose(GuideActions({"guide": guide or SplineGuide()}), *degraders))


def counting_env(*degraders):
    return cone_env(*degraders, guide=Counting())


def hundredths(data):
    """Advice of a counting env, [CARS, ...]: the tens are the row, the ones the call."""
    return (data["guide_action"] * 100).round().int().squeeze(-1).squeeze(-1)


def straight(td):
    return td.set("action", torch.zeros(CARS, 1))


def steps(env, carrier, count):
    for _ in range(count):
        carrier = env.step(straight(carrier))["next"]
    return carrier


def reset_rows(env, data, *rows):
    mask = torch.zeros(CARS, 1, dtype=torch.bool)
    mask[list(rows)] = True
    return env.reset(data.clone().set("_reset", mask))


def degraded(transform, *advice):
    """Degraded advice of one guide, one number a row."""
    data = TensorDict({"guide_action": torch.tensor(advice).view(-1, 1, 1)}, [len(advice)])
    return transform(data)["guide_action"].flatten().tolist()


@pytest.mark.parametrize("name", NAMES)
def test_specs_hold_in_every_env(name):
    envs = worlds.everywhere(lambda: configured(name)[0]) if name != "shuffled" else [worlds.carts(*configured(name))]
    for env in envs:
        check_env(env, steps=4)


def test_specs_hold_for_all_of_them_in_a_chain_with_several_guides_and_another_key():
    check_env(worlds.cones(*configured(*NAMES)), steps=10)
    key, classes = ("advice", "middle"), (NoisyAdvice, ShuffledAdvice, DelayedAdvice, RemovedAdvice)
    guides = GuideActions({"constant": ConstantGuide(0.5), "spline": SplineGuide()}, out_key=key)
    env = TransformedEnv(WORLD, Compose(guides, *(make(key=key) for make in classes)))
    check_env(env)
    assert env.reset()[key].eq(0).all()


def test_files_compose_in_the_given_order_with_the_seed():
    assert list(configs("delayed", "noisy")) == ["delayed", "noisy"]
    assert list(configs("noisy", "delayed")) == ["noisy", "delayed"]
    assert configs("noisy").noisy.seed == configs("shuffled").shuffled.seed == 3
    assert [next(iter(configs(name))) for name in NAMES] == NAMES
    late, early = cone_env(BiasedAdvice(0.5), ScaledAdvice(0.5)), cone_env(ScaledAdvice(0.5), BiasedAdvice(0.5))
    advice = cone_env().reset()["guide_action"]
    torch.testing.assert_close(late.reset()["guide_action"], (advice + 0.5).clamp(-1, 1) / 2)
    torch.testing.assert_close(early.reset()["guide_action"], advice / 2 + 0.5)


def test_known_numbers():
    assert degraded(BiasedAdvice(0.25), -0.5, 0.5) == [-0.25, 0.75]
    assert degraded(ScaledAdvice(0.5), -0.5, 1.0) == [-0.25, 0.5]
    assert degraded(ScaledAdvice(-1), -0.5, 1.0) == [0.5, -1]
    assert degraded(PartialAdvice("left"), -0.5, 0.25) == [0, 0.25]
    assert degraded(PartialAdvice("right"), -0.5, 0.25) == [-0.5, 0]


@pytest.mark.parametrize("name", ["adversarial", "biased", "partial", "undertuned", "zeroed"])
def test_env_and_stored_data_agree(name):
    def constant(td):
        return td.set("action", torch.full((CARS, 1), 0.1))

    plain, env = (cone_env(*parts).rollout(5, constant, break_when_any_done=False) for parts in ((), configured(name)))
    stored = configured(name)[0](plain.clone())
    torch.testing.assert_close(stored["guide_action"].clamp(-1, 1), env["guide_action"])


def test_advice_stays_within_the_bounds_of_the_env():
    env = worlds.pendulum(BiasedAdvice(1.75))
    assert env.observation_spec["guide_action"] == worlds.pendulum().observation_spec["guide_action"]
    advice = env.rollout(50)["guide_action"]
    assert advice.max() == 2
    assert cone_env(BiasedAdvice(3)).reset()["guide_action"].eq(1).all()
    assert worlds.carts(BiasedAdvice(0.5)).reset()["guide_action"].le(1).all()


def test_noise_is_gaussian_and_independent_for_each_guide_and_step():
    stored = TensorDict({"guide_action": torch.zeros(50_000, 2, 1)}, [50_000])
    noise = [NoisyAdvice(0.3, seed)(stored.clone())["guide_action"] for seed in (1, 1, 2)]
    assert noise[0].std() == pytest.approx(0.3, abs=0.005)
    assert noise[0].mean() == pytest.approx(0, abs=0.005)
    assert torch.equal(noise[0], noise[1])
    assert not torch.equal(noise[0], noise[2])
    assert abs(torch.corrcoef(noise[0].squeeze(-1).t())[0, 1]) < 0.02


def test_random_advice_is_uniform_and_independent_of_the_guide():
    stored = [TensorDict({"guide_action": torch.full((50_000, 1, 1), number)}, [50_000]) for number in (-1.0, 0.7)]
    advice, other = (RandomAdvice(-0.5, 1.0, seed=1)(data)["guide_action"] for data in stored)
    assert torch.equal(advice, other)
    assert -0.5 <= advice.min() < -0.49
    assert 0.99 < advice.max() <= 1
    assert advice.mean() == pytest.approx(0.25, abs=0.01)
    assert advice.std() == pytest.approx(1.5 / 12**0.5, abs=0.01)


@pytest.mark.parametrize("make", [NoisyAdvice, RandomAdvice, ShuffledAdvice, RandomGuide])
def test_draws_continue_from_a_state_dict(make):
    is_guide = make is RandomGuide
    env, again = (cone_env(guide=make(seed=seed)) if is_guide else cone_env(make(seed=seed)) for seed in (3, 4))
    env.rollout(3)
    again.load_state_dict(env.state_dict())
    assert torch.equal(env.reset()["guide_action"], again.reset()["guide_action"])


@pytest.mark.parametrize("transform", [NoisyAdvice(0.1, seed=3), RandomAdvice(seed=3)], ids=["noisy", "random"])
def test_every_step_and_every_partial_reset_has_its_own_draws(transform):
    env = cone_env(transform, guide=ZeroGuide())
    carrier = env.reset()
    advice = [carrier["guide_action"]]
    for _ in range(4):
        carrier = steps(env, carrier, 1)
        advice.append(carrier["guide_action"])
        carrier = reset_rows(env, carrier, 2)
        advice.append(carrier["guide_action"][2:3])
    assert torch.cat(advice).unique().numel() == CARS + 4 * (CARS + 1)


@pytest.mark.parametrize(
    "make",
    [
        lambda: [NoisyAdvice()],
        lambda: [RandomAdvice()],
        lambda: [PartialAdvice("right")],
        lambda: [DelayedAdvice(2)],
        lambda: [RemovedAdvice()],
        lambda: [NoisyAdvice(seed=1), DelayedAdvice(2), NoisyAdvice(seed=2)],
    ],
    ids=["noisy", "random", "partial", "delayed", "removed", "three"],
)
def test_advice_of_a_row_does_not_depend_on_resets_of_other_rows(make):
    def drive(resets):
        env = cone_env(*make())
        carrier, advice = env.reset(), []
        for step in range(8):
            action = torch.linspace(-0.3, 0.3, CARS).unsqueeze(-1) * math.cos(step)
            carrier = env.step(carrier.set("action", action))["next"].clone()
            if step in resets:
                carrier = reset_rows(env, carrier, *resets[step])
            advice.append(carrier["guide_action"].clone())
        return torch.stack(advice, 1)

    often, seldom = drive({1: [0, 3], 3: [0], 4: [3, 0], 5: [1]}), drive({3: [4], 5: [1, 5]})
    assert torch.equal(often[1:3], seldom[1:3])
    assert not torch.equal(often, seldom)


def test_advice_is_delayed_by_k_steps_after_the_first_advice():
    rollout = counting_env(DelayedAdvice(3)).rollout(8, straight)
    assert hundredths(rollout)[0].tolist() == [0, 0, 0, 0, 1, 2, 3, 4]
    assert hundredths(rollout)[4].tolist() == [40, 40, 40, 40, 41, 42, 43, 44]


def test_delay_starts_again_with_each_episode():
    env = counting_env(DelayedAdvice(2))
    carrier = steps(env, env.reset(), 4)
    assert hundredths(carrier).tolist() == [2, 12, 22, 32, 42, 52]
    # The guide gets the reset row alone, as row 0.
    carrier = reset_rows(env, carrier, 1)
    assert hundredths(carrier).tolist() == [2, 5, 22, 32, 42, 52]
    rows = [hundredths(carrier := steps(env, carrier, 1)).tolist()[:3] for _ in range(3)]
    assert rows == [[3, 5, 23], [4, 5, 24], [6, 16, 26]]


def test_delays_add_up_and_zero_steps_change_nothing():
    def rollout(*degraders):
        return hundredths(counting_env(*degraders).rollout(8, straight))

    assert "delayed_advice" not in counting_env(DelayedAdvice(0)).observation_spec
    assert torch.equal(rollout(DelayedAdvice(0)), rollout())
    two = [DelayedAdvice(1), DelayedAdvice(2, memory_key="delayed_again")]
    assert torch.equal(rollout(*two), rollout(DelayedAdvice(3)))


def test_shuffled_advice_is_a_shift_of_the_rows():
    shuffled, plain = (
        hundredths(counting_env(*parts).rollout(40, straight, break_when_any_done=False))
        for parts in ([ShuffledAdvice(seed=1)], [])
    )
    assert torch.equal(shuffled.sort(0).values, plain.sort(0).values)
    assert (shuffled != plain).all()
    shifts = {tuple(column) for column in ((shuffled - torch.arange(40)) // 10).t().tolist()}
    assert len(shifts) == CARS - 1, "all shifts should be drawn"


@pytest.mark.parametrize("seed", range(10))
def test_a_reset_row_gets_the_previous_advice_of_another_row(seed):
    # The next transform must not halve advice twice, and advice for the rows without a reset is not used.
    env = counting_env(ShuffledAdvice(seed), ScaledAdvice(0.5))
    carrier = steps(env, env.reset(), 1)
    before, after = (
        (td["guide_action"] * 200).round().int().flatten() for td in (carrier, reset_rows(env, carrier, 1, 3))
    )
    assert torch.equal(after[[0, 2, 4, 5]], before[[0, 2, 4, 5]])
    assert after[1] in (1, 21, 31, 41, 51)
    assert after[3] in (1, 11, 21, 41, 51)


def test_reset_and_stored_rows_are_shuffled_among_themselves():
    env = counting_env(ShuffledAdvice())
    after = reset_rows(env, steps(env, env.reset(), 1), *range(CARS))
    assert sorted(hundredths(after).tolist()) == [2, 12, 22, 32, 42, 52]
    stored = TensorDict({"guide_action": torch.arange(24.0).view(2, 3, 2, 2)}, [2, 3])
    shuffled = ShuffledAdvice()(stored.clone())
    before, after = ([row.flatten().tolist() for row in td["guide_action"].flatten(0, 1)] for td in (stored, shuffled))
    assert sorted(before) == sorted(after)
    assert all(one != other for one, other in zip(before, after, strict=True))


def test_one_row_cannot_be_shuffled():
    for env in (SerialEnv(1, PendulumEnv), PendulumEnv()):
        guide = TensorDictModule(lambda speed: -speed.unsqueeze(-1), in_keys=["thdot"], out_keys=["action"])
        single = TransformedEnv(env, GuideActions({"damp": guide}))
        with pytest.raises(ValueError, match="but the batch is one row; use more"):
            single.append_transform(ShuffledAdvice()).reset()


def test_removed_advice_is_the_previous_action_and_zero_at_the_start():
    env = counting_env(RemovedAdvice())
    carrier = env.reset()
    assert hundredths(carrier).eq(0).all()
    carrier = env.step(carrier.set("action", torch.full((CARS, 1), 0.25)))["next"]
    assert carrier["guide_action"].eq(0.25).all()
    assert hundredths(reset_rows(env, carrier, 2)).tolist() == [25, 25, 0, 25, 25, 25]


@pytest.mark.parametrize("categorical", [True, False])
def test_previous_discrete_action_is_one_hot(categorical):
    env = worlds.carts(RemovedAdvice(), categorical=categorical)
    start = env.reset()
    assert start["guide_action"].eq(0).all()
    start["action"] = torch.tensor([0, 1]) if categorical else torch.eye(2, dtype=torch.int64)
    assert torch.equal(env.step(start)["next", "guide_action"].squeeze(1), torch.eye(2))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: NoisyAdvice(sigma=-1), "sigma=-1 must be a finite number of at least 0"),
        (lambda: RandomAdvice(1.0, 0.5), r"low=1\.0 must be less than high=0\.5"),
        (lambda: BiasedAdvice(math.nan), "offset=nan must be a finite number"),
        (lambda: ScaledAdvice(math.inf), "gain=inf must be a finite number"),
        (lambda: PartialAdvice("up"), "side='up' must be one of left, right"),
        (lambda: DelayedAdvice(-1), "steps=-1 must be at least 0"),
        (lambda: degraded(DelayedAdvice(), 0.0), "DelayedAdvice needs the previous steps"),
        (lambda: degraded(RemovedAdvice(), 0.0), "RemovedAdvice needs the previous steps"),
        (lambda: TransformedEnv(WORLD, BiasedAdvice()).observation_spec, "BiasedAdvice changes 'guide_action', but"),
    ],
)
def test_invalid_use_is_rejected(make, message):
    with pytest.raises((ValueError, RuntimeError, KeyError), match=message):
        make()
