from functools import partial

import pytest
import torch
from torchrl.envs import Compose, PendulumEnv, SerialEnv, TransformedEnv

from coil_rl import EnvBatch, GymnasiumEnv
from coil_rl.foreign.batch import optional_entries


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


def test_global_random_numbers_are_not_touched_by_resets():
    # TorchRL's Pendulum seeds PyTorch's generator, from which policies sample.
    env = EnvBatch(PendulumEnv, 2)
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    env.reset()
    assert torch.equal(torch.rand(2), expected)


def test_env_that_is_a_batch_itself_is_refused():
    with pytest.raises(ValueError, match=r"GymnasiumEnv has the batch size \[2\]"):
        EnvBatch(partial(GymnasiumEnv, "CartPole-v1", 2))


def test_entries_that_may_lack_a_number_are_those_of_info():
    env = GymnasiumEnv("CartPole-v1", 2, info=["lives"])
    assert optional_entries(TransformedEnv(env, Compose())) == [("info", "lives")]
    for other in (EnvBatch(PendulumEnv, 2), SerialEnv(2, PendulumEnv)):
        assert not optional_entries(TransformedEnv(other, Compose()))
