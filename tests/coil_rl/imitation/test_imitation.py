import math

import pytest
import torch
import worlds
from any_env import AnyEnv
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded, Unbounded
from torchrl.envs import SerialEnv, TransformedEnv

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.errors import UserError
from coil_rl.guides import RandomGuide, SplineGuide
from coil_rl.imitation import ForestRegressor, Imitation, LinearRegressor, NetworkRegressor
from coil_rl.run import checkpoint
from coil_rl.run.rollout import Rollout
from coil_rl.transforms import GuideActions

REGRESSORS = {
    "linear": LinearRegressor,
    "forest": lambda: ForestRegressor(5, max_depth=6),
    "network": lambda: NetworkRegressor((8,), epochs=3),
}


def cone_env(guides=None, cars=7):
    env = ConeTrackEnv(shipped_tracks("train"), cars, assignment="cyclic")
    return TransformedEnv(env, GuideActions(guides or {"middle": SplineGuide()}))


@pytest.fixture(scope="module")
def env():
    return cone_env()


def linear(**changes):
    return {"regressor": LinearRegressor(), "validate": False} | changes


@pytest.fixture(scope="module")
def batches(env):
    """Two batches of random driving with crashes and resets, with all that a guide may read."""
    torch.manual_seed(1)
    rollout = Rollout(
        env,
        TensorDictModule(lambda x: torch.rand_like(x[..., :1]) - 0.5, ["observation"], ["action"]),
        60,
    )
    return rollout.collect(), rollout.collect()


@pytest.mark.slow
def test_samples_are_the_actions_of_the_guide_in_the_same_states(env, batches):
    learner, guide, batch = Imitation(env, **linear()), SplineGuide(), batches[1]
    assert batch["next", "done"].any()
    learner.update(batch.select(*learner.keys))
    expected = guide(batch.select(*guide.in_keys).reshape(-1).clone())["action"]
    torch.testing.assert_close(learner.dataset["action"], expected)
    assert torch.equal(learner.dataset["observation"], batch["observation"].flatten(0, 1))
    assert torch.equal(
        learner.dataset["info", "track"], torch.arange(7).repeat_interleave(60).unsqueeze(-1)
    )


def test_a_batch_without_anything_to_learn_changes_nothing(env, batches):
    def keeping():
        """Return a learner of a recording, whose env says what is to be learned."""
        learner = Imitation(env, **linear())
        learner.kept_key = "usable"
        learner.keys.append("usable")
        return learner

    usable = torch.ones(7, 60, 1, dtype=torch.bool)
    some, none = batches[0].clone().set("usable", usable), batches[1].clone().set("usable", ~usable)
    learner = keeping()
    first, second = learner.update(some), learner.update(none)
    assert (first["samples"], second["samples"], second["left_out"]) == (420, 420, 420)
    assert second["mse_training"] == first["mse_training"]
    assert "mse_ahead" not in second
    with pytest.raises(UserError, match="none of 420 steps is to be learned"):
        keeping().update(none)


def test_any_row_of_the_advice_can_be_imitated():
    env = cone_env({"middle": SplineGuide(), "random": RandomGuide(low=0.25, high=0.75)})
    learner = Imitation(env, **linear(guide=1))
    learner.update(Rollout(env, learner.policy, 5, learner.keys).collect())
    assert learner.dataset["action"].min() >= 0.25


def test_linear_guide_is_recovered():
    weights = torch.linspace(-0.04, 0.04, 20).unsqueeze(-1)
    guide = TensorDictModule(lambda x: x @ weights + 0.1, ["observation"], ["action"])
    env = cone_env({"linear": guide}, cars=14)
    learner = Imitation(env, **linear(validate=True))
    metrics = learner.update(Rollout(env, learner.policy, 40, learner.keys).collect())
    assert metrics["r2_training"] == pytest.approx(1)
    assert metrics["r2_random_split"] == pytest.approx(1)
    assert metrics["mse_by_track"] < 1e-9
    assert metrics.keys() >= {"samples", "target_variance", "mse_ahead", "r2_ahead", "r2_by_track"}
    assert all(math.isfinite(value) for value in metrics.values())
    fresh = env.rollout(20, break_when_any_done=False)
    torch.testing.assert_close(
        learner.policy(fresh.clone())["action"], fresh["guide_action"][..., 0, :]
    )


def test_data_set_grows_with_every_batch_and_can_come_from_another_run(env, batches, tmp_path):
    learner, both = Imitation(env, **linear()), Imitation(env, **linear())
    assert learner.update(batches[0])["samples"] == 420
    learner.export(tmp_path)
    other = Imitation(env, **linear(dataset=tmp_path / "dataset.pt"))
    assert (other.dataset == learner.dataset).all()
    assert learner.update(batches[1])["samples"] == other.update(batches[1])["samples"] == 840
    both.update(torch.cat(batches, 1))
    first, second, third = (
        each.policy(batches[0].clone())["action"] for each in (learner, other, both)
    )
    assert torch.equal(first, second)
    torch.testing.assert_close(first, third)


@pytest.mark.parametrize("name", REGRESSORS)
def test_resumed_learner_equals_an_uninterrupted_one(name, env, batches, tmp_path):
    first, second = (Imitation(env, regressor=REGRESSORS[name](), validate=False) for _ in range(2))

    def actions():
        return [learner.policy(batches[1].clone())["action"] for learner in (first, second)]

    second.load_state_dict(first.state_dict())
    assert first.dataset is second.dataset is None
    assert all((action == 0).all() for action in actions())
    first.update(batches[0])
    checkpoint.save(first.state_dict(), tmp_path / "state.pt")
    second.load_state_dict(checkpoint.load(tmp_path / "state.pt"))
    assert torch.equal(*actions())
    assert first.update(batches[1]) == second.update(batches[1])
    assert torch.equal(*actions())
    assert (first.dataset == second.dataset).all()


def places():
    """A batch [2, 3] of envs with two entries and an action of two numbers."""
    action = Bounded(torch.tensor([-1.0, 1.0]), torch.tensor([1.0, 3.0]))
    seen = {"place": Unbounded((2,)), "wind": Unbounded(())}
    return SerialEnv(2, lambda: AnyEnv(3, action, seen))


@pytest.mark.parametrize("name", REGRESSORS)
def test_two_dimensional_actions_and_batches(name):
    def linear(place, wind):
        centre = torch.tensor([0.0, 2.0])
        return centre + 0.1 * (wind.unsqueeze(-1) - place)  # within the bounds of the action

    pull = TensorDictModule(linear, ["place", "wind"], ["action"])
    env = TransformedEnv(places(), GuideActions({"pull": pull}))
    learner = Imitation(env, ["place", "wind"], regressor=REGRESSORS[name]())
    before = learner.policy(env.reset())["action"]
    assert torch.equal(before, torch.tensor([0.0, 1.0]).expand(2, 3, 2))
    metrics = learner.update(Rollout(env, learner.policy, 30, learner.keys).collect())
    assert learner.dataset.shape == (180,)
    assert "mse_by_track" not in metrics
    data = env.rollout(4)
    action = learner.policy(data.clone())["action"]
    assert action.shape == (2, 3, 4, 2)
    assert env.action_spec.is_in(action[:, :, 0])
    if name == "linear":
        torch.testing.assert_close(action, data["guide_action"][..., 0, :])
        far = data[..., -1].exclude("action").apply(lambda number: 1000 * number)
        assert not env.action_spec.is_in(linear(far["place"], far["wind"]))
        assert env.action_spec.is_in(learner.policy(far)["action"])


@pytest.mark.fast(1)
@pytest.mark.parametrize("categorical", [True, False])
def test_discrete_actions_are_learned_from_one_hot_advice(categorical):
    env = worlds.carts(categorical=categorical)
    learner = Imitation(env, regressor=ForestRegressor(5), validate=False)
    env.set_seed(0)
    data = Rollout(env, learner.policy, 200, learner.keys).collect()
    learner.update(data)
    expected = data["guide_action"][..., 0, :]
    assert 0 < expected[..., 0].mean() < 1
    assert torch.equal(
        learner.policy(data.clone())["action"],
        expected.argmax(-1) if categorical else expected.long(),
    )
    assert env.action_spec.is_in(learner.policy(env.reset())["action"])


def test_unusable_data_sets_envs_and_values_are_refused(env, tmp_path):
    file = tmp_path / "dataset.pt"
    with pytest.raises(UserError, match=r"there is no data set .*dataset\.pt"):
        Imitation(env, **linear(dataset=file))
    checkpoint.save({"observation": torch.zeros(5, 3), "action": torch.zeros(5, 1)}, file)
    with pytest.raises(
        UserError, match=r"of another env: observation is \[3\], but must be \[20\]"
    ):
        Imitation(env, **linear(dataset=file))
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(UserError, match=r"dataset\.pt is damaged"):
        Imitation(env, **linear(dataset=file))
    with pytest.raises(KeyError, match=r"row 0 of guide_action, .* no advice; put Guide"):
        Imitation(ConeTrackEnv(shipped_tracks("test"), 2), **linear())
    with pytest.raises(KeyError, match="row 1 of guide_action, but there is advice of 1 guides"):
        Imitation(env, **linear(guide=1))
    for option in ("guide", "seed"):
        with pytest.raises(ValueError, match=f"{option}=-1 must be at least 0"):
            Imitation(env, **linear(**{option: -1}))
