"""Policies with a memory solve what needs one, and train, resume and are evaluated as any other."""

import copy
import shutil

import pytest
import torch
import worlds
from any_env import AnyEnv
from hydra import compose, initialize_config_module
from run_folders import make_untrained_run
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, MultiCategorical, Unbounded
from torchrl.envs import Compose, RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.config.check import check
from coil_rl.config.parts import build_guides, env_maker
from coil_rl.config.python import open_run
from coil_rl.envs.seeded_env import SeededEnv
from coil_rl.errors import UserError
from coil_rl.learners import (
    A2C,
    DQN,
    PPO,
    SAC,
    TRPO,
    DynamicCoil,
    Gru,
    KickstartLoss,
    Mlp,
    Reinforce,
)
from coil_rl.learners.encoders import ObservationNetwork
from coil_rl.learners.networks import FastTensorDictModule
from coil_rl.learners.policy import Entries
from coil_rl.programs.train import resume, train
from coil_rl.run.evaluation import evaluate_policy
from coil_rl.run.parts import TEST
from coil_rl.run.policy_batch import OnRows, policy_batch
from coil_rl.run.rollout import Rollout
from coil_rl.schedules import Linear
from coil_rl.testing import check_env
from coil_rl.transforms import DiscreteActions, Takeover

DELAY = 5
TINY = [
    "track=generated",
    "evaluation.curve.env.time_limit=1",
    "track.train.count=1",
    "track.test.count=2",
    "env.laps=1",
    "env.time_limit=1",
    "env.rate=12",
    "evaluation.repeats=1",
    "evaluation.gif=false",
    "logger=none",
    "checkpoint_every=1",
    "budget.num_envs=4",
    "budget.steps=16",
    "budget.frames=128",
    "learner.epochs=2",
    "learner.minibatches=2",
]


class Recall(SeededEnv):
    """B rows whose first observation is -1 or 1; after 5 steps of 0 the sign is the right action.

    The reward is 1 or -1 in the last step, else 0.
    """

    def __init__(self, count, seed=0):
        super().__init__(batch_size=[count])
        flag, number = Categorical(2, (count, 1), dtype=torch.bool), Unbounded((count, 1))
        self.observation_spec = Composite(
            observation=number, cue=number.clone(), clock=number.clone(), shape=(count,)
        )
        self.state_spec = Composite(cue=number.clone(), clock=number.clone(), shape=(count,))
        self.action_spec = Categorical(2, (count,))
        self.reward_spec = Bounded(-1, 1, (count, 1))
        self.full_done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=(count,)
        )
        self.generator = torch.Generator().manual_seed(seed)

    def _reset(self, tensordict=None, **_):
        cue = 2.0 * torch.randint(2, (*self.batch_size, 1), generator=self.generator) - 1
        shown = {"observation": cue, "cue": cue.clone(), "clock": torch.zeros_like(cue)}
        return TensorDict(shown | dict(self.full_done_spec.zero()), self.batch_size)

    def _step(self, tensordict):
        cue, clock = tensordict["cue"], tensordict["clock"] + 1
        done = clock >= DELAY
        right = torch.where(cue == 2 * tensordict["action"].unsqueeze(-1) - 1, 1.0, -1.0)
        entries = {
            "observation": torch.zeros_like(cue),
            "cue": cue,
            "clock": clock,
            "reward": done * right,
        }
        ends = {"done": done, "terminated": done.clone(), "truncated": torch.zeros_like(done)}
        return TensorDict(entries | ends, self.batch_size)


def around(env, gru, *transforms):
    return TransformedEnv(env, Compose(RewardSum(), *transforms, *gru.env_transforms()))


def learnt(network, updates, rows=32, steps=20):
    torch.manual_seed(0)
    env = around(Recall(rows), Gru(state=16))
    ppo = PPO(env, network=network, learning_rate=Linear(1e-2, 0.0), minibatches=4)
    rollout = Rollout(env, ppo.policy, steps, ppo.keys)
    for update in range(updates):
        ppo.update(rollout.collect(), update / updates)
    return ppo.policy


def share_of_right_answers(policy):
    return (evaluate_policy(around(Recall(200, seed=1), Gru(state=16)), policy).mean_reward + 1) / 2


@pytest.mark.slow
def test_policy_with_a_memory_solves_what_needs_one_and_one_without_cannot():
    check_env(Recall(4))
    assert share_of_right_answers(learnt(Gru((16,), state=16), updates=15)) > 0.95
    assert 0.4 < share_of_right_answers(learnt(Mlp((16,)), updates=3)) < 0.6


ACTIONS = {
    "bounded": Bounded(-1, 1, (2,)),
    "unbounded": Unbounded((2,)),
    "choice": Categorical(3, ()),
    "choices": MultiCategorical([2, 4]),
}


@pytest.mark.fast(3)
@pytest.mark.parametrize(
    ("action", "options", "dtype"),
    [
        *((action, {}, torch.float32) for action in ACTIONS),
        ("bounded", {"normalise": True}, torch.float32),
        ("bounded", {"squash": False}, torch.float64),
    ],
)
def test_update_sees_the_log_probabilities_and_states_of_the_rollout(action, options, dtype):
    torch.manual_seed(0)
    default, gru = torch.get_default_dtype(), Gru(state=6)
    torch.set_default_dtype(dtype)
    try:
        env = around(AnyEnv(8, ACTIONS[action], dtype=dtype), gru)
        learner = PPO(env, network=gru, minibatches=2, action_gain=3.0, **options)
        rollout = Rollout(env, learner.policy, 12, learner.keys)
        learner.update(rollout.collect())
        batch = rollout.collect()  # begins within episodes, which have 5 steps
    finally:
        torch.set_default_dtype(default)
    assert batch["is_init"].squeeze(-1).sum(1).eq(2).all()
    assert not batch["is_init"][:, 0].any()
    begins = batch["is_init"].squeeze(-1)
    assert (batch["policy_state"][begins] == 0).all()
    assert (batch["policy_state"][~begins] != 0).any(-1).all()
    goes_on = ~batch["next", "done"][:, :-1].squeeze(-1)
    assert torch.equal(
        batch["next", "policy_state"][:, :-1][goes_on], batch["policy_state"][:, 1:][goes_on]
    )
    rows = learner.prepare(batch, 0.0)
    order = torch.randperm(len(batch))
    steps = learner.sampler.remember(Entries({key: each[order] for key, each in rows.items()}))
    expected = batch[order].reshape(-1)["action_log_prob"]
    assert expected.std() > 0.1
    torch.testing.assert_close(learner.head.density(steps).log_prob(steps["action"]), expected)
    assert torch.equal(steps["observation"], batch["observation"][order].flatten(0, 1))


def test_critic_values_the_state_in_which_a_truncated_episode_ended():
    torch.manual_seed(0)
    env = around(AnyEnv(4), gru := Gru(state=6))
    learner = PPO(env, network=gru, minibatches=2)
    batch = Rollout(env, learner.policy, 7, learner.keys).collect()
    after = batch["next"][:, 4].copy()
    expected = learner.critic(after.copy())["state_value"]
    assert not torch.allclose(
        learner.critic(after.set("policy_state", 0 * after["policy_state"]))["state_value"],
        expected,
    )
    learner.prepare(batch, 0.0)
    torch.testing.assert_close(batch["next", "state_value"][:, 4], expected)
    torch.testing.assert_close(batch["next", "state_value"][:, 3], batch["state_value"][:, 4])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (PPO, {"entropy": 0.01, "auxiliary": [KickstartLoss()]}),
        (A2C, {}),
        (Reinforce, {}),
        (Reinforce, {"baseline": "none"}),
    ],
)
def test_on_policy_learners_train_all_parts_also_where_a_guide_acts(kind, options):
    torch.manual_seed(0)
    gru = Gru((8,), state=8)
    env = worlds.cones(Takeover(Linear(0.5, 0.5)), *gru.env_transforms())
    learner = kind(
        env, ["observation", "guide_action"], network=gru, minibatches=3, action_gain=1.0, **options
    )
    before = copy.deepcopy(learner.state_dict())
    rollout = Rollout(env, learner.policy, 8, learner.keys)
    batch = rollout.collect()
    assert 0 < batch["agent_acts"].float().mean() < 1
    assert torch.tensor(list(learner.update(batch).values())).isfinite().all()
    for part in ("policy", "critic"):
        assert not any(
            torch.equal(value, before[part][name])
            for name, value in learner.state_dict()[part].items()
        )
    # A learner that is restored goes on with the same numbers.
    second, batch = (
        kind(env, ["observation", "guide_action"], network=gru, minibatches=3, **options),
        rollout.collect(),
    )
    second.load_state_dict(copy.deepcopy(learner.state_dict()))
    metrics = []
    for each in (learner, second):
        torch.manual_seed(
            1
        )  # TorchRL estimates the entropy of a squashed distribution from samples
        metrics.append(each.update(batch.clone()))
    assert metrics[0] == metrics[1]


def test_batch_of_kept_policies_acts_and_remembers_like_each_of_them():
    torch.manual_seed(0)
    gru = Gru((8,), state=8)
    policies = [PPO(around(Recall(5), gru), network=gru, action_gain=3.0).policy for _ in range(3)]
    batch = policy_batch(policies[0], [copy.deepcopy(policy.state_dict()) for policy in policies])
    assert isinstance(batch, OnRows)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        together = around(Recall(15), gru).rollout(12, batch, break_when_any_done=False)
        for index, policy in enumerate(policies):
            part = together[5 * index : 5 * index + 5]
            for step in part.unbind(1):
                alone = policy(step.select(*policy.in_keys))
                assert torch.equal(alone["action"], step["action"])
                torch.testing.assert_close(
                    alone["next", "policy_state"], step["next", "policy_state"]
                )
    assert (together["policy_state"][:, 1] != 0).any()
    assert (together["policy_state"][:, DELAY] == 0).all()


def composed(folder, *overrides, name="train"):
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        return compose(name, [*overrides, f"run_dir={folder}"])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ppo", "coil", "jump_start"])
def test_run_resumes_to_the_bit_and_is_evaluated_in_a_new_env(method, tmp_path):
    run, stopped = tmp_path / "run", tmp_path / "stopped"
    config = composed(run, *TINY, "network=gru", f"method={method}")
    check(config)
    train(config)
    shutil.copytree(run, stopped)
    for name in ("evaluation.csv", "policy_last.pt", "checkpoint.pt"):
        (stopped / name).unlink()
    resume(stopped)
    for name in ("policy_last.pt", "metrics.csv", "evaluation.csv", "episodes.csv"):
        assert (run / name).read_bytes() == (stopped / name).read_bytes(), name
    opened = open_run(run)
    env = opened.make_env(2, TEST)
    mean = evaluate_policy(env, opened.policy(env)).mean_reward
    table = (run / "evaluation.csv").read_text().splitlines()
    (row,) = (
        line.split(",") for line in table if line.startswith(f"{config.label},,deterministic,mean,")
    )
    assert float(row[4]) == pytest.approx(mean)


@pytest.mark.slow
def test_policy_with_a_memory_is_a_guide(tmp_path):
    run = make_untrained_run(
        tmp_path / "run", *TINY, "method=ppo", "network=gru", "learner.action_gain=3"
    )
    guided = composed("unused", *TINY, "method=guide", "guide=learned", f"guide.learned.run={run}")
    opened = open_run(run)
    env = opened.make_env(3, "evaluation", count=3)
    policy = evaluate_policy(env, opened.policy(env))
    learned = evaluate_policy(*env_maker(guided).guided(3, "evaluation", count=3))
    assert [row["reward"] for row in learned.episodes] == pytest.approx(
        [row["reward"] for row in policy.episodes]
    )
    assert not any(
        parameter.requires_grad for parameter in build_guides(guided)["learned"].parameters()
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: PPO(worlds.cones(), network=Gru()),
            "the env does not carry the memory of the network; put",
        ),
        (
            lambda: PPO(worlds.cones(*Gru(state=8).env_transforms()), network=Gru()),
            "the env does not carry the memory",
        ),
        (
            lambda: SAC(worlds.cones(), network=Gru()),
            "SAC cannot train a network with a memory; take network=mlp",
        ),
        (
            lambda: DQN(worlds.cones(DiscreteActions(3)), network=Gru()),
            "DQN cannot train a network with a memory",
        ),
        (lambda: TRPO(worlds.cones(), network=Gru()), "TRPO cannot train a network with a memory"),
        (
            lambda: DynamicCoil(worlds.cones(), guides={"one": one_guide()}, network=Gru()),
            "DynamicCoil cannot train a network with a memory",
        ),
    ],
)
def test_unusable_memory_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def one_guide():
    return FastTensorDictModule(
        ObservationNetwork(worlds.cones(), ["observation"], Mlp([8]), 1, 1.0),
        ["observation"],
        ["action"],
    )


def test_more_minibatches_than_envs_are_refused():
    env = around(Recall(4), gru := Gru())
    learner = PPO(env, network=gru, minibatches=5)
    said = "minibatches=5 are more than the 4 envs, but with a memory each needs all steps"
    with pytest.raises(ValueError, match=said):
        learner.check_batch(rows=4, steps=8)
    with pytest.raises(ValueError, match=said):
        learner.update(Rollout(env, learner.policy, 8, learner.keys).collect())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        pytest.param(
            ["method=oil", "learner=linear"],
            "learner: Imitation takes no network",
            marks=pytest.mark.slow,
        ),
        (["learner=trpo"], "learner: TRPO cannot train a network with a memory"),
        (["learner.network.state=0"], "learner.network.state=0 must be at least 1"),
    ],
)
def test_mistake_in_the_configuration_is_one_sentence(overrides, message, tmp_path):
    small = [argument for argument in TINY if not argument.startswith("learner.")]
    with pytest.raises(UserError, match=message):
        check(composed(tmp_path, *small, "network=gru", *overrides))
