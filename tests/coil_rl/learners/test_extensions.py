"""Extensions of learners: what is not part of an algorithm, handed over as one list."""

from pathlib import Path

import pytest
import torch
from any_env import AnyEnv
from torchrl.data import Bounded, Unbounded

from coil_rl.learners import A2C, PPO, TRPO, KickstartLoss, Reinforce
from coil_rl.learners.batches import Minibatches
from coil_rl.learners.extension import Extension, Extensions, SummedRewards
from coil_rl.learners.learner import Learner
from coil_rl.learners.policy import Entries
from coil_rl.run.rollout import Rollout


class Counting(Extension):
    """Writes down what is called, draws the policy to no noise, and halves the other losses."""

    def __init__(self):
        self.calls, self.updates = [], 0

    def prepare(self, batch):
        self.calls.append("prepare")
        batch["next", "reward"] = batch["next", "reward"] * 0

    def losses(self, policy, minibatch):
        self.calls.append("losses")
        distribution = policy.get_dist(minibatch.select(*policy.in_keys))
        return {"loss_noise": distribution.scale.mean()}

    def weights(self, weights, progress):
        self.calls.append("weights")
        return {name: weight / 2 for name, weight in weights.items()} | {"loss_noise": progress}

    def finish(self, batch, progress):
        self.calls.append("finish")
        self.updates += 1
        return {"updates": float(self.updates)}


def make(*extensions, kind=PPO, **options):
    torch.manual_seed(0)
    env = AnyEnv(4, Unbounded((2,)))
    learner = kind(env, minibatches=2, auxiliary=extensions, **options)
    return learner, Rollout(env, learner.policy, 8, learner.keys)


def test_update_calls_an_extension_in_order():
    counting = Counting()
    learner, rollout = make(counting, epochs=3)
    metrics = learner.update(rollout.collect(), 0.5)
    assert counting.calls == ["prepare", "weights", *["losses"] * 6, "finish"]
    assert metrics["updates"] == 1
    assert 0 < metrics["loss_noise"] < 1
    assert learner.loss_weights(0.5) == {
        "loss_objective": 0.5,
        "loss_critic": 0.5,
        "loss_noise": 0.5,
    }


def test_extension_changes_the_batch_before_the_advantages():
    learner, rollout = make(Counting(), gamma=0.0, gae_lambda=0.0)
    rows = learner.prepare(rollout.collect(), 0.0)
    assert (rows["value_target"] == 0).all()


@pytest.mark.parametrize("kind", [PPO, A2C, Reinforce, TRPO])
def test_loss_of_an_extension_trains_the_policy_of_each_on_policy_learner(kind):
    learner, rollout = make(Counting(), kind=kind)
    before = learner.update(rollout.collect(), 0.5)["loss_noise"]
    for _ in range(5):
        after = learner.update(rollout.collect(), 0.5)["loss_noise"]
    assert after < before


def test_extensions_act_one_after_the_other():
    both = Extensions([Counting(), KickstartLoss(3.0)])
    assert both.weights({"loss": 1.0}, 0.5) == {"loss": 0.5, "loss_noise": 0.5, "loss_guide": 3.0}
    assert both.keys == ["guide_action"]


def test_rewards_of_agents_are_summed():
    env = AnyEnv(
        8, Bounded(-1, 1, (3, 2)), {("agents", "observation"): Unbounded((3, 4))}, agents=True
    )
    learner = PPO(env, [("agents", "observation")])
    extension, _ = learner.extensions.each  # and the look at raw observations
    assert isinstance(extension, SummedRewards)
    batch = Rollout(env, learner.policy, 4, learner.keys).collect()
    extension.prepare(batch)
    assert torch.equal(batch["next", "reward"], batch["next", "agents", "reward"].sum(-2))


def test_minibatches_of_a_pass_are_all_steps_once_in_another_order_each():
    rows = Entries(number=torch.arange(6), advantage=torch.rand(6, 1))
    passes = []
    for seed in range(3):
        first, second = Minibatches(1, 2, seed).draw(rows)
        passes.append([*first["number"].tolist(), *second["number"].tolist()])
    assert all(sorted(numbers) == list(range(6)) for numbers in passes)
    assert len(set(map(tuple, passes))) > 1


def test_learner_needs_only_an_update_and_a_state():
    class Idle(Learner):
        def update(self, batch, progress=0.0):
            return {}

        def state_dict(self):
            return {}

        def load_state_dict(self, state):
            pass

    idle = Idle()
    idle.check_batch(0, 0)
    idle.export(Path("nowhere"))
    assert idle.kind == "agent"
    assert idle.callbacks(None) == []
    assert not idle.guides
    assert idle.critic is None
