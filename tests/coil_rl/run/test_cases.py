"""Comparisons of policies in new cases of a training: a pendulum that its guide swings up."""

import pytest
import torch
from programs import LAP, composed
from tensordict.nn import TensorDictModuleBase

from coil_rl.config.assemble import assemble
from coil_rl.config.parts import build_learner, env_maker
from coil_rl.learners.anchor import hold_of
from coil_rl.run.cases import TrainingCases, further_cases, guide_calls
from coil_rl.run.delivery import GuideActs
from coil_rl.run.parts import TESTS, TRAIN
from coil_rl.transforms.guide_transform import SeededGenerator

pytest.importorskip("gymnasium.envs.classic_control")
SHORT = ["env=pendulum", "env.max_steps=48"]  # for what an episode of any length shows


def configured(*overrides):
    """Return the configuration of a run and its learner."""
    words = ["method=coil_anchored", "budget.num_envs=2", "run_dir=unused"]
    config = composed(*words, *overrides)
    torch.manual_seed(0)
    return config, build_learner(config, env_maker(config)())


def built(*overrides, frames=100_000, seed=0):
    """Return cases of a training, and its learner."""
    config, learner = configured(*overrides)
    make_env = env_maker(config)
    return TrainingCases(lambda rows: make_env(rows, TESTS), frames, seed), learner


def test_all_policies_act_in_the_same_cases_and_each_comparison_has_others():
    cases, learner = built(*SHORT)
    cases.renew(3)
    first = cases.returns(learner.policy)
    assert torch.equal(cases.returns(learner.policy), first)
    cases.renew(3)
    assert not torch.isin(cases.returns(learner.policy), first).any()


@pytest.mark.slow
def test_cases_depend_on_the_seed_and_go_on_from_a_saved_state():
    one, learner = built(*SHORT)
    other, _ = built(*SHORT, seed=1)
    again, _ = built(*SHORT)
    returns = []
    for cases in (one, other):
        cases.renew(2)
        returns.append(cases.returns(learner.policy))
    assert not torch.equal(*returns)
    again.load_state_dict(one.state_dict())
    for cases in (one, again):
        cases.begin()
        cases.renew(2)
    assert torch.equal(one.returns(learner.policy), again.returns(learner.policy))
    assert (again.steps, again.calls) == (one.steps, one.calls)


def test_steps_and_calls_of_guides_are_counted():
    cases, learner = built(*SHORT)
    cases.renew(3)
    cases.returns(learner.policy)
    assert cases.steps == 3 * 48
    assert cases.calls == 3 * 49, "also in the first states"
    env = cases.env
    assert guide_calls(env) == cases.calls


def test_comparison_leaves_policy_and_random_numbers_alone():
    cases, learner = built(*SHORT)
    before, state = torch.get_rng_state(), learner.policy.state_dict()
    copies = {name: value.clone() for name, value in state.items()}
    cases.renew(2)
    (sampled,) = cases.compared([learner.policy], [True])
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(value, copies[name]) for name, value in state.items())
    assert torch.equal(cases.compared([learner.policy], [True])[0], sampled)
    assert not torch.equal(cases.returns(learner.policy), sampled)


@pytest.mark.parametrize("action", ["continuous", "choices"])
def test_first_policy_has_the_returns_of_its_guide(action):
    cases, learner = built(*SHORT, f"action={action}")
    cases.renew(4)
    guide = cases.returns(GuideActs(cases.env))
    assert torch.equal(cases.returns(learner.policy), guide)


def start_test(*overrides):
    """Return the weight after the start test of a run."""
    cases, learner = built(*overrides)
    (test,) = learner.callbacks(cases)
    numbers = test.after_update(0)
    return hold_of(learner.policy).weight.tolist(), numbers, cases


@pytest.mark.slow
def test_start_test_holds_a_guide_that_swings_up_and_the_opposite_of_a_reversed_one():
    good, numbers, cases = start_test("env=pendulum")
    assert good == [pytest.approx(numbers["start/weight"])]
    assert good[0] > 0
    assert cases.steps <= 0.05 * cases.frames
    assert start_test("env=pendulum", "degrade=adversarial")[0][0] < 0


@pytest.mark.slow
@pytest.mark.parametrize("degrade", ["random", "zeroed"])
def test_start_test_holds_no_useless_guide(degrade):
    assert start_test(*SHORT, f"degrade={degrade}")[0] == [0]


@pytest.mark.slow
def test_cases_of_the_cone_world_are_new_places_with_the_whole_time_limit():
    config, _ = configured("env=cone_track", "training.tests.time_limit=2.0")
    make_env = env_maker(config)
    cases = TrainingCases(lambda rows: make_env(rows, TESTS), 10_000)
    cases.renew(8)
    cases.returns(GuideActs(cases.env))
    env = cases.env.base_env
    assert cases.steps == 8 * 24, "none of the first episodes begins with a part of its limit over"
    assert len(env.start_track) == 2000
    assert make_env(2, TRAIN).base_env.assignment == "random"
    assert assemble(config).delivery == "tested"


@pytest.mark.fast(1)
@pytest.mark.parametrize(
    "words",
    [["env=pendulum"], ["guide=zero", *LAP, "training.tests.starts=30"]],
    ids=["gym", "cones"],
)
def test_rows_may_begin_in_the_same_cases(words):
    cases, learner = built(*words)
    assert cases.can_copy()
    seen = []
    cases.teach(["observation"], seen.append)
    cases.renew(2)
    cases.compared([learner.policy] * 3)
    first, *others = seen[0]["observation"][:, 0].reshape(3, 2, -1)
    assert all(torch.equal(first, each) for each in others)
    cases.renew(6)
    cases.compared([learner.policy])
    assert len(seen[1]["observation"][:, 0].unique(dim=0)) > 2


@pytest.mark.slow
def test_policies_side_by_side_have_the_returns_of_each_alone():
    cases, learner = built(*SHORT)
    cases.renew(3)
    guide = GuideActs(cases.env)
    beside = cases.compared([learner.policy, guide])
    taken, steps = cases.taken, cases.steps
    assert cases.env.batch_size == torch.Size([6])
    for policy, returns, expected in zip([learner.policy, guide], beside, taken, strict=True):
        (alone,) = cases.compared([policy])
        torch.testing.assert_close(returns, alone, rtol=1e-3, atol=0.1)  # it is chaotic
        assert cases.taken == [expected]
    assert cases.steps == 2 * steps
    assert not torch.equal(*cases.compared([learner.policy] * 2, [True, False]))


class Noted(TensorDictModuleBase):
    """A policy that keeps the exploration noise that it reads."""

    def __init__(self, policy):
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        super().__init__()
        self.policy, self.noise = policy, []
        self.register_buffer("kept", torch.zeros(0), persistent=False)  # it is not traced

    def forward(self, tensordict):
        self.noise.append(tensordict.get("exploration_noise", None))
        return self.policy(tensordict)


@pytest.mark.slow
def test_sampled_actions_have_the_correlated_noise_of_the_training():
    cases, learner = built("env=pendulum")
    cases.noise_correlation = 0.8
    cases.renew(8)
    sampling, other = Noted(learner.policy), Noted(learner.policy)
    cases.compared([sampling, other], [True, False])
    assert set(other.noise) == {None}
    noise = torch.stack(sampling.noise).squeeze(-1)  # [T, C]
    assert noise.shape[1] == 8
    assert float(noise.std()) == pytest.approx(1.0, abs=0.15)
    assert float((noise[1:] * noise[:-1]).mean()) == pytest.approx(0.8, abs=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_traced_policy_has_the_noise_of_one_that_is_not(correlation):
    cases, learner = built(*SHORT)
    cases.noise_correlation = correlation
    cases.renew(3)
    beside, _ = cases.compared([learner.policy, learner.policy], [True, False])
    (alone,) = cases.compared([learner.policy], [True])
    torch.testing.assert_close(beside, alone, rtol=1e-3, atol=0.1)  # it is chaotic


def test_start_test_of_a_training_has_its_correlation(tmp_path):
    folder = f"run_dir={tmp_path}/run"
    config, _ = configured("env=pendulum", "training.noise_correlation=0.6", folder)
    run = assemble(config)
    assert run.training(0).cases.noise_correlation == run.noise_correlation == 0.6


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["env=simulated_robot"],
        [*SHORT, "disturb=[observation_noise]"],
        [*SHORT, "disturb=[action_delay]", "disturb.action_delay.max_lag=6"],
        [*SHORT, "degrade=[noisy]"],
        [*SHORT, "degrade=[shuffled]"],
        [*SHORT, "guide=random"],
    ],
    ids=["scans", "noise", "delay", "noisy advice", "shuffled advice", "random guide"],
)
def test_policies_side_by_side_have_the_same_noise_and_delays(words):
    cases, learner = built(*words)
    assert cases.can_copy()
    cases.renew(3)
    first, second = cases.compared([learner.policy, learner.policy])
    assert torch.equal(first, second)
    assert len(first.unique()) == 3
    (alone,) = cases.compared([learner.policy])
    torch.testing.assert_close(first, alone, rtol=1e-3, atol=0.1)
    drawing = [part for part in cases.env.modules() if isinstance(part, SeededGenerator)]
    assert [part.different for part in drawing] == [None] * len(drawing)  # a training draws all


@pytest.mark.slow
def test_a_block_of_cases_makes_one_env():
    cases, learner = built(*SHORT)
    made, build = [], cases.build
    cases.build = lambda rows: made.append(rows) or build(rows)
    cases.can_copy()
    for count in (2, 3, 3):
        cases.renew(count)
        cases.compared([learner.policy, learner.policy])
    assert made == [2, 4, 6]


def test_test_at_the_end_grows_with_what_its_episodes_take():
    assert further_cases(2, taken=100, frames=1000) == 2  # not at once: they may be longer
    assert further_cases(4, taken=900, frames=1000) == 0
    assert further_cases(4, taken=2000, frames=1000) < 0
    assert further_cases(16, taken=16, frames=1000) == 16
    assert further_cases(32, taken=32, frames=1000) == 0


@pytest.mark.slow
def test_learner_with_replay_learns_from_the_steps_of_the_start_test():
    cases, learner = built(
        *SHORT, "learner=sac", "learner.starts=50", "learner.n_step=2", frames=6000
    )
    (test,) = learner.callbacks(cases)
    cases.renew(3)
    test.after_update(0)
    stored = learner.buffer[:]
    # All steps of all compared policies, of which the last one of each episode is alone.
    assert cases.steps > 3 * 48
    assert len(stored) == cases.steps
    assert (stored["next", "steps"] == 1).sum() == cases.episodes
    assert learner.pending_updates > 0
    assert stored["next", "done"].sum() == 2 * cases.episodes
    shown = stored["action"].abs().amax()
    assert 0 < shown <= 1
