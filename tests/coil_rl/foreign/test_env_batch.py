from functools import partial

import pytest
import torch
from torchrl.envs import GymEnv, PendulumEnv

from coil_rl import EnvBatch, GymnasiumEnv


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
    env = EnvBatch(partial(GymEnv, "CartPole-v1"), 2)
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
