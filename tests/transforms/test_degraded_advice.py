import math
import warnings

import pytest
import torch
import worlds
from hydra import compose, initialize_config_module
from hydra.utils import instantiate
from programs import shipped
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, TransformedEnv

from coil_rl.envs import ConeTrackEnv, random_tracks
from coil_rl.guides import SplineGuide
from coil_rl.testing import check_env
from coil_rl.transforms import (
    ActionDelay,
    BiasedAdvice,
    DelayedAdvice,
    DiscreteActions,
    GuideActions,
    NoisyAdvice,
    PartialAdvice,
    RandomAdvice,
    RemovedAdvice,
    ScaledAdvice,
    ShuffledAdvice,
)
from coil_rl.transforms.degraded_advice import say_for_numbers

NAMES = shipped("degrade")
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


def cone_env(*degraders, guide=None):
    guides = GuideActions({"guide": guide or SplineGuide()})
    return TransformedEnv(WORLD, Compose(guides, *degraders))


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


@pytest.mark.slow
def test_files_compose_in_the_given_order_with_the_seed():
    def composed(*names):
        with initialize_config_module("coil_rl.conf", version_base="1.3"):
            return compose(overrides=[f"+degrade=[{','.join(names)}]", "+seed=3"]).degrade

    assert list(composed("noisy", "delayed")) == ["noisy", "delayed"]
    every = composed(*NAMES)
    assert list(every) == NAMES
    assert every.noisy.seed == every.shuffled.seed == 3
    check_env(worlds.cones(*(instantiate(node) for node in every.values())))


@pytest.mark.parametrize(
    ("transforms", "expected"),
    [
        ([BiasedAdvice(0.25)], [-0.25, 0.5, 0.75]),
        ([ScaledAdvice(0.5)], [-0.25, 0.125, 0.25]),
        ([ScaledAdvice(-1)], [0.5, -0.25, -0.5]),
        ([ScaledAdvice(0)], [0, 0, 0]),
        ([PartialAdvice("left")], [0, 0.25, 0.5]),
        ([PartialAdvice("right")], [-0.5, 0, 0]),
        ([BiasedAdvice(0.75), ScaledAdvice(0.5)], [0.125, 0.5, 0.5]),
        ([ScaledAdvice(0.5), BiasedAdvice(0.75)], [0.5, 0.875, 1]),
    ],
)
def test_known_numbers_within_the_bounds_of_the_env_and_in_stored_data(transforms, expected):
    advice = torch.tensor([-0.5, 0.25, 0.5] * 2).view(CARS, 1, 1)
    guide = worlds.acting(lambda _: advice.squeeze(1), "steering")
    env = cone_env(*transforms, guide=guide)
    assert env.reset()["guide_action"].flatten().tolist() == expected * 2
    if len(transforms) == 1:
        stored = transforms[0](TensorDict({"guide_action": advice}, [CARS]))
        assert stored["guide_action"].flatten().tolist() == expected * 2


def test_advice_stays_within_the_bounds_of_other_envs():
    assert worlds.pendulum(BiasedAdvice(1.75)).rollout(50)["guide_action"].max() == 2
    assert worlds.carts(BiasedAdvice(0.5)).reset()["guide_action"].le(1).all()


@pytest.mark.parametrize(
    ("degrader", "name"),
    [
        (lambda: BiasedAdvice(0.2), "biased"),
        (lambda: PartialAdvice("left"), "partial"),
        (lambda: ScaledAdvice(0.5), "undertuned"),
    ],
)
def test_advice_of_choices_that_keeps_its_meaning_is_said_once(degrader, name):
    say_for_numbers.cache_clear()
    with pytest.warns(UserWarning, match=rf"degrade={name} \(.*the action of this env is choices"):
        degraded = worlds.carts(degrader()).reset()
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "degrade=")
        worlds.carts(degrader()).reset()
    assert torch.equal(degraded["guide_action"].argmax(-1), degraded["observation"][:, 2:3] > 0)


@pytest.mark.filterwarnings("error:degrade=")
@pytest.mark.parametrize(
    "make",
    [
        lambda: ScaledAdvice(-1),
        lambda: ScaledAdvice(0),
        DelayedAdvice,
        NoisyAdvice,
        RandomAdvice,
        ShuffledAdvice,
        RemovedAdvice,
    ],
)
def test_nothing_is_said_where_choices_are_degraded(make):
    say_for_numbers.cache_clear()
    worlds.carts(make()).rollout(3, break_when_any_done=False)


@pytest.mark.filterwarnings("error:degrade=")
def test_choices_made_of_a_number_are_degraded_as_numbers():
    say_for_numbers.cache_clear()
    guide = worlds.acting(lambda _: torch.full((CARS, 1), 0.5), "steering")
    env = cone_env(ScaledAdvice(0.5), DiscreteActions(5), guide=guide)
    assert env.reset()["guide_number"].eq(0.25).all()


def test_noise_is_gaussian_and_random_advice_uniform():
    def drawn(make, number=0.0):
        stored = TensorDict({"guide_action": torch.full((50_000, 2, 1), number)}, [50_000])
        return make(stored)["guide_action"].squeeze(-1)

    noise, advice = drawn(NoisyAdvice(0.3, seed=1)), drawn(RandomAdvice(-0.5, 1.0, seed=1))
    for sample, mean, std in ((noise, 0, 0.3), (advice, 0.25, 1.5 / 12**0.5)):
        assert sample.mean() == pytest.approx(mean, abs=0.005)
        assert sample.std() == pytest.approx(std, abs=0.005)
        assert abs(torch.corrcoef(sample.t())[0, 1]) < 0.02
    assert -0.5 <= advice.min() < -0.49 < 0.99 < advice.max() <= 1
    assert torch.equal(noise, drawn(NoisyAdvice(0.3, seed=1)))
    assert not torch.equal(noise, drawn(NoisyAdvice(0.3, seed=2)))
    assert torch.equal(advice, drawn(RandomAdvice(-0.5, 1.0, seed=1), number=0.7))


@pytest.mark.parametrize(
    "make",
    [
        lambda: [NoisyAdvice()],
        lambda: [RandomAdvice()],
        lambda: [DelayedAdvice(2)],
        lambda: [RemovedAdvice()],
        lambda: [NoisyAdvice(seed=1), DelayedAdvice(2), NoisyAdvice(seed=2)],
    ],
    ids=["noisy", "random", "delayed", "removed", "three"],
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
    def rollout(*degraders):
        return hundredths(counting_env(*degraders).rollout(8, straight))

    delayed = rollout(DelayedAdvice(3))
    assert delayed[0].tolist() == [0, 0, 0, 0, 1, 2, 3, 4]
    assert delayed[4].tolist() == [40, 40, 40, 40, 41, 42, 43, 44]
    twice = rollout(DelayedAdvice(1), DelayedAdvice(2, memory_key="delayed_again"))
    assert torch.equal(twice, delayed)
    assert torch.equal(rollout(DelayedAdvice(0)), rollout())


def test_delay_starts_again_with_each_episode():
    env = counting_env(DelayedAdvice(2))
    carrier = steps(env, env.reset(), 4)
    assert hundredths(carrier).tolist() == [2, 12, 22, 32, 42, 52]
    # The guide gets the reset row alone, as row 0.
    carrier = reset_rows(env, carrier, 1)
    assert hundredths(carrier).tolist() == [2, 5, 22, 32, 42, 52]
    rows = [hundredths(carrier := steps(env, carrier, 1)).tolist()[:3] for _ in range(3)]
    assert rows == [[3, 5, 23], [4, 5, 24], [6, 16, 26]]


def test_shuffled_advice_is_a_shift_of_the_rows():
    envs = counting_env(ShuffledAdvice(seed=1)), counting_env()
    shuffled, plain = (
        hundredths(env.rollout(40, straight, break_when_any_done=False)) for env in envs
    )
    assert torch.equal(shuffled.sort(0).values, plain.sort(0).values)
    assert (shuffled != plain).all()
    shifts = {tuple(column) for column in ((shuffled - torch.arange(40)) // 10).t().tolist()}
    assert len(shifts) == CARS - 1, "all shifts should be drawn"


@pytest.mark.parametrize("seed", range(5))
def test_reset_row_gets_the_previous_advice_of_another_row(seed):
    # The next transform must not halve advice twice, and advice for the rows without a reset is not
    # used.
    env = counting_env(ShuffledAdvice(seed), ScaledAdvice(0.5))
    carrier = steps(env, env.reset(), 1)
    before, after = (
        (td["guide_action"] * 200).round().int().flatten()
        for td in (carrier, reset_rows(env, carrier, 1, 3))
    )
    assert torch.equal(after[[0, 2, 4, 5]], before[[0, 2, 4, 5]])
    assert after[1] in (1, 21, 31, 41, 51)
    assert after[3] in (1, 11, 21, 41, 51)


def test_reset_and_stored_rows_are_shuffled_among_themselves():
    env = counting_env(ShuffledAdvice())
    after = reset_rows(env, steps(env, env.reset(), 1), *range(CARS))
    assert sorted(hundredths(after).tolist()) == [2, 12, 22, 32, 42, 52]
    stored = TensorDict({"guide_action": torch.arange(24.0).view(2, 3, 2, 2)}, [2, 3])
    before = stored["guide_action"].view(6, 4).tolist()
    after = ShuffledAdvice()(stored)["guide_action"].view(6, 4).tolist()
    assert sorted(before) == sorted(after)
    assert all(one != other for one, other in zip(before, after, strict=True))


def test_removed_advice_is_the_previous_action_and_zero_at_the_start():
    env = counting_env(RemovedAdvice())
    carrier = env.reset()
    assert hundredths(carrier).eq(0).all()
    carrier = env.step(carrier.set("action", torch.full((CARS, 1), 0.25)))["next"]
    assert carrier["guide_action"].eq(0.25).all()
    assert hundredths(reset_rows(env, carrier, 2)).tolist() == [25, 25, 0, 25, 25, 25]


def test_removed_advice_is_the_action_that_the_agent_chose_where_actions_are_late():
    advised = GuideActions({"guide": SplineGuide()})
    env = TransformedEnv(WORLD, Compose(ActionDelay(2, 2), advised, RemovedAdvice()))
    data = env.rollout(5, lambda td: td.set("action", torch.rand(CARS, 1)))
    assert torch.equal(data["next", "guide_action"].squeeze(2), data["action"])
    assert not torch.equal(data["next", "steering"][:, 1:], data["action"][:, 1:])
