import warnings
from functools import partial

import pytest
import torch
from torchrl.envs import GymEnv, PendulumEnv
from worlds import drive, reloaded, same

from coil_rl import EnvBatch, GymnasiumEnv
from coil_rl.testing import check_env

SINGLE = {"pendulum": PendulumEnv, "cartpole": partial(GymEnv, "CartPole-v1")}


@pytest.mark.parametrize("of", SINGLE.values(), ids=SINGLE)
def test_batch_fits_its_specs(of):
    check_env(EnvBatch(of, 3))


@pytest.mark.parametrize("of", SINGLE.values(), ids=SINGLE)
def test_seed_determines_all_episodes(of):
    one, other, third = (drive(EnvBatch(of, 3, seed=seed), 40)[0] for seed in (1, 1, 2))
    assert same(one, other)
    assert not same(one, third)


@pytest.mark.parametrize("of", SINGLE.values(), ids=SINGLE)
def test_saved_batch_goes_on_to_the_bit(of):
    env = EnvBatch(of, 3, seed=5)
    _, carrier = drive(env, 25)
    state, start = reloaded(env.state_dict()), carrier.clone()
    later = drive(env, 40, carrier, seed=1)[0]
    other = EnvBatch(of, 3, seed=6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        other.load_state_dict(state)
    assert other.continues
    assert same(later, drive(other, 40, start, seed=1)[0])


def test_rows_are_single_envs():
    env = EnvBatch(PendulumEnv, 3, first_seed=7, cases=2)
    single = PendulumEnv()
    single.set_seed(8)
    state = single.reset()
    batch = env.reset()
    assert torch.equal(batch["th"][1], state["th"])
    assert torch.equal(batch["th"][0], batch["th"][2])
    for _ in range(5):
        action = torch.tensor([[0.5], [-1.0], [0.5]])
        step = env.step(batch.set("action", action))
        one = single.step(state.set("action", action[1]))
        assert torch.equal(step["next", "thdot"][1], one["next", "thdot"])
        assert torch.equal(step["next", "reward"][1], one["next", "reward"])
        batch, state = env.step_mdp(step), single.step_mdp(one)


def test_finished_row_stays_as_it_is():
    env = EnvBatch(SINGLE["cartpole"], 2)
    carrier, push = env.reset(), torch.tensor([[0, 1], [0, 1]])
    for _ in range(15):  # one side only: over after about ten steps
        before, carrier = carrier, env.step(carrier.set("action", push))["next"]
    assert carrier["done"].all()
    assert torch.equal(before["observation"], carrier["observation"])
    assert carrier["reward"].tolist() == [[0.0], [0.0]]


def test_global_random_numbers_are_not_touched_by_resets():
    # TorchRL's Pendulum seeds PyTorch's generator, from which policies sample.
    env = EnvBatch(PendulumEnv, 2)
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    env.reset()
    assert torch.equal(torch.rand(2), expected)


@pytest.mark.parametrize(
    ("of", "arguments", "message"),
    [
        (partial(GymnasiumEnv, "CartPole-v1", 2), {}, r"GymnasiumEnv has the batch size \[2\]"),
        (PendulumEnv, {"cases": 3}, "cases=3 needs first_seed"),
    ],
)
def test_mistake_is_one_sentence(of, arguments, message):
    with pytest.raises(ValueError, match=message):
        EnvBatch(of, **arguments)
