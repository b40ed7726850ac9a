"""Training, evaluation and schedules of the transforms in TorchRL's collectors and batches."""

import pytest
import torch
import worlds
from torchrl.collectors import Collector
from torchrl.envs import SerialEnv, StepCounter, TransformedEnv

from coil_rl.guides import SplineGuide
from coil_rl.schedules import Linear
from coil_rl.transforms import (
    JumpStart,
    MixedAction,
    RewardCoupling,
    Takeover,
    set_progress,
)


def collected(env, steps=6):
    collector = Collector(
        env, SplineGuide(), frames_per_batch=6 * steps, auto_register_policy_transforms=False
    )
    return next(iter(collector))


@pytest.mark.parametrize(
    "make",
    [
        lambda: RewardCoupling(1),
        lambda: JumpStart(3),
        Takeover,
        lambda: MixedAction(Linear(0.0, 1.0)),
    ],
)
def test_transform_that_would_be_silently_off_in_a_collector_is_refused(make):
    with pytest.raises(RuntimeError, match=r"training only: call env.train\(\) or env.eval\(\)"):
        collected(worlds.cones(make()))


def test_transforms_work_in_a_collector():
    after = collected(worlds.cones(RewardCoupling(0.5)).train())["next"]
    torch.testing.assert_close(
        after["reward"], after["task_reward"] - 0.5 * after["guide_distance"]
    )
    assert not collected(worlds.cones(JumpStart(3)).train())["agent_acts"][:, :3].any()
    after = collected(worlds.cones(RewardCoupling(0.5)).eval())["next"]
    assert torch.equal(after["reward"], after["task_reward"])


def test_progress_moves_the_schedules_in_a_collector():
    env = worlds.cones(MixedAction(Linear(0.0, 1.0)), StepCounter())
    with pytest.raises(RuntimeError, match=r"the progress of the run: call .*set_progress\(env"):
        collected(env.train())
    for progress in (0.25, 0.75):
        set_progress(env, progress)
        assert env.transform[1].current(Linear(0.0, 1.0)) == progress
        assert collected(env).shape == (6, 6)
    assert env.eval().transform[1].current(Linear(0.0, 1.0)) == 1


def test_mode_is_asked_for_again_when_torchrl_forgets_it():
    env = worlds.cones(Takeover(0.5)).train()
    env.rollout(2)
    env.append_transform(StepCounter())
    env.rollout(2)
    with pytest.raises(RuntimeError, match="Takeover acts in training only"):
        TransformedEnv(env, StepCounter(), auto_unwrap=True).rollout(2)


def test_env_inside_a_serial_env_needs_its_mode_where_it_is_made():
    def make(mode):
        env = worlds.pendulum(RewardCoupling(0.5))
        return env.train() if mode else env

    with pytest.raises(RuntimeError, match="inside SerialEnv or ParallelEnv in the function"):
        SerialEnv(2, lambda: make(False)).train().rollout(2)
    after = SerialEnv(2, lambda: make(True)).rollout(2)["next"]
    torch.testing.assert_close(
        after["reward"], after["task_reward"] - 0.5 * after["guide_distance"]
    )
