"""A learner in TorchRL's Trainer."""

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.trainers import Trainer

from coil_rl import PPO, SAC, GymnasiumEnv, LearnerStepper
from coil_rl.schedules import Linear

FRAMES = 6 * 64
MAKERS = {
    "ppo": lambda env: PPO(env, hidden=[8], minibatches=4, learning_rate=Linear(1e-3, 0.0)),
    "sac": lambda env: SAC(env, hidden=[8], starts=64, batch_size=16, updates_per_step=0.015625),
}


def trainer(learner, env, **options):
    torch.manual_seed(0)
    collector = Collector(env, learner.policy, frames_per_batch=64, total_frames=FRAMES)
    return Trainer(
        collector=collector,
        total_frames=FRAMES,
        frame_skip=1,
        optim_steps_per_batch=1,
        loss_module=learner.policy,
        optimization_stepper=LearnerStepper(learner),
        progress_bar=False,
        **options,
    )


def made(name):
    torch.manual_seed(0)
    env = GymnasiumEnv("Pendulum-v1", num_envs=4, max_steps=20)
    return MAKERS[name](env), env


@pytest.mark.slow
@pytest.mark.parametrize("name", MAKERS)
def test_six_updates_in_their_trainer_are_six_updates(name):
    learner, env = made(name)
    (alone, _), batches = made(name), []

    def remember(batch):
        torch.manual_seed(len(batches))  # an update may draw, too
        batches.append(batch.clone())
        return batch

    theirs = trainer(learner, env)
    theirs.register_op("batch_process", remember)
    theirs.train()
    for number, batch in enumerate(batches):
        torch.manual_seed(number)
        alone.update(batch, number / len(batches))
    assert len(batches) == 6
    ours, weights = (each.policy.state_dict() for each in (alone, learner))
    assert ours.keys() == weights.keys()
    for key, value in ours.items():
        assert torch.equal(value, weights[key]), key


def test_checkpoint_of_their_trainer_holds_the_learner(tmp_path):
    learner, env = made("ppo")
    theirs = trainer(learner, env)
    theirs.train()
    state = theirs.optimization_stepper.state_dict()
    fresh, _ = made("ppo")
    LearnerStepper(fresh).load_state_dict(state)
    for value, weight in zip(fresh.policy.parameters(), learner.policy.parameters(), strict=True):
        assert torch.equal(value, weight)
