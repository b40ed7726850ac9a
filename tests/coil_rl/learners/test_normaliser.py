"""Running normalisation of observations."""

import copy

import numpy as np
import pytest
import torch
import worlds
from any_env import FLOAT64, AnyEnv, action_of, learning
from torchrl.data import Bounded, Categorical, Unbounded

from coil_rl.learners import A2C, DQN, PPO, SAC, TRPO, DynamicCoil, Reinforce
from coil_rl.learners.encoders import Mlp, ObservationNetwork
from coil_rl.learners.networks import FastTensorDictModule
from coil_rl.learners.normaliser import LIMIT, Moments, Normaliser
from coil_rl.run.policy_batch import policy_batch


def shifted(action=None, **options):
    """An env whose observation has mean 100 and 1000."""
    low, high = torch.tensor([99.0, 900.0]), torch.tensor([101.0, 1100.0])
    return AnyEnv(8, action, {"observation": Bounded(low, high, (2,))}, **options)


def moments(learner):
    (each,) = learner.normaliser.moments
    return each


def test_moments_are_those_of_numpy_over_everything_seen():
    torch.manual_seed(0)
    parts = [torch.randn(count, 3, 2) * 3 + 1e4 for count in (1, 7, 50)]
    found = Moments(torch.Size([2]))
    for part in parts:
        found.add(part)
    rows = np.concatenate([part.reshape(-1, 2).double().numpy() for part in parts])
    assert found.count == len(rows)
    np.testing.assert_allclose(found.mean, rows.mean(0), rtol=1e-12)
    np.testing.assert_allclose(found.variance, rows.var(0), rtol=1e-9)
    normal = found(torch.from_numpy(rows))
    np.testing.assert_allclose(normal, (rows - rows.mean(0)) / rows.std(0), rtol=1e-6, atol=1e-6)
    assert found(torch.full((2,), 1e9)).tolist() == [LIMIT, LIMIT]


@pytest.mark.fast(3)
@pytest.mark.parametrize("kind", [PPO, A2C, Reinforce, TRPO, SAC, DQN])
def test_statistics_are_those_of_all_collected_observations_and_part_of_the_policy(kind):
    torch.manual_seed(0)
    learner, rollout = learning(kind, shifted(action_of(kind)), normalise=True)
    batches = []
    for _ in range(3):
        batches.append(rollout.collect())
        metrics = learner.update(batches[-1].clone())
        assert torch.tensor(list(metrics.values())).isfinite().all()
    rows = torch.cat([batch["observation"].reshape(-1, 2).double() for batch in batches])
    torch.testing.assert_close(moments(learner).mean, rows.mean(0))
    torch.testing.assert_close(moments(learner).variance, rows.var(0, correction=0))
    other, _ = learning(kind, shifted(action_of(kind)), normalise=True)
    other.policy.load_state_dict(learner.policy.state_dict())
    assert torch.equal(moments(other).mean, moments(learner).mean)


def test_batch_is_learned_from_with_the_statistics_that_collected_it():
    learner, rollout = learning(PPO, shifted(), normalise=True, minibatches=1, epochs=1)
    for _ in range(3):
        assert abs(learner.update(rollout.collect())["kl_approx"]) < 1e-6  # the ratios are 1


def test_evaluation_does_not_change_the_statistics_and_several_policies_act_at_once():
    env = shifted()
    learner, rollout = learning(PPO, env, normalise=True)
    learner.update(rollout.collect())
    state = copy.deepcopy(learner.policy.state_dict())
    data, policies = env.reset(), policy_batch(learner.policy, [state, state])
    with torch.no_grad():
        assert policies(torch.cat([data, data]))["action"].shape == (16, 2)
        found = learner.policy.eval()
        found(data)
    assert all(torch.equal(value, state[name]) for name, value in found.state_dict().items())


def test_only_measurements_are_normalised_and_never_advice():
    env = worlds.cones(cars=4)
    learner = PPO(env, ["observation", "guide_action"], normalise=True)
    assert learner.normaliser.in_keys == ["observation"]
    with pytest.raises(ValueError, match="normalise: guide_action is advice"):
        PPO(env, ["observation", "guide_action"], normalise=["guide_action"])
    seen = {
        "a": Unbounded((2,), **FLOAT64),
        "b": Categorical(3, ()),
        "image": Unbounded((8, 8, 3)),
        "c": Unbounded(()),
    }
    mixed = AnyEnv(observations=seen)
    assert PPO(mixed, list(seen), normalise=True).normaliser.in_keys == ["a", "c"]
    assert PPO(mixed, list(seen), normalise=["c"]).normaliser.in_keys == ["c"]
    assert PPO(mixed, ["b"], normalise=True).normaliser is None
    with pytest.raises(ValueError, match=r"normalise: b has numbers of type torch\.int64"):
        Normaliser(mixed, ["b"])
    with pytest.raises(ValueError, match="normalise: c is not observed; observed are a"):
        PPO(mixed, ["a"], normalise=["c"])


def test_guides_of_dynamic_coil_see_observations_as_they_are():
    torch.manual_seed(0)
    env = shifted()
    network = ObservationNetwork(env, ["observation"], Mlp([4]), 2, 1.0)
    guide = FastTensorDictModule(network, ["observation"], ["action"])
    learner, rollout = learning(DynamicCoil, env, guides={"one": guide}, normalise=True)
    learner.update(rollout.collect())
    data = env.reset()
    with torch.no_grad():
        expected = guide(data.clone())["action"]
        assert torch.equal(learner.policy(data)["guide_action"][:, 0], expected)
    assert data["normalised", "observation"].abs().max() < 3
