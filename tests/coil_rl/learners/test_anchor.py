import copy
import itertools
import math

import pytest
import torch
from any_env import AnyEnv
from tensordict.nn import TensorDictModule
from torch.nn import functional as F
from torchrl.data import Bounded, Categorical, MultiCategorical, OneHot, Unbounded
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.learners import A2C, DQN, PPO, SAC, TRPO, Anchor, Gru, Reinforce
from coil_rl.learners.anchor import (
    AnchoredUpdate,
    Brake,
)
from coil_rl.learners.learner import CaseResults
from coil_rl.run.rollout import Rollout
from coil_rl.transforms import GuideActions

KEYS = ("observation", "guide_action")


def advised(action, *guides, **options):
    """Return an env with guides, each a function of observations [B, 3]."""
    named = {
        f"guide{index}": TensorDictModule(guide, in_keys=["observation"], out_keys=["action"])
        for index, guide in enumerate(guides)
    }
    return TransformedEnv(AnyEnv(action=action, **options), Compose(GuideActions(named)))


def two_numbers(observation):
    return observation[..., :2].clamp(-1, 1)


def option(count):
    return lambda observation: (observation.abs().sum(-1) * 10).long() % count


ACTIONS = {
    "bounded": (Bounded(-1, 1, (2,)), two_numbers),
    "other bounds": (Bounded(-3, 1, (2,)), lambda observation: observation[..., :2].clamp(-3, 1)),
    "unbounded": (Unbounded((2,)), lambda observation: observation[..., :2]),
    "index": (Categorical(4, ()), option(4)),
    "one-hot": (OneHot(4), lambda observation: F.one_hot(option(4)(observation), 4)),
    "several": (
        MultiCategorical([3, 2]),
        lambda observation: torch.stack([option(3)(observation), option(2)(observation)], -1),
    ),
}


def learner(env, kind=PPO, minibatches=2, options=None, **anchor):
    return kind(
        env,
        KEYS,
        action_gain=0.0,
        minibatches=minibatches,
        anchor=Anchor(**anchor),
        **(options or {}),
    )


def anchored(learner):
    """Return the extension of an anchored learner."""
    (found,) = [each for each in learner.extensions.each if isinstance(each, AnchoredUpdate)]
    return found


def acted(policy, data):
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        return policy(data.copy())["action"]


@pytest.mark.parametrize("name", ACTIONS)
def test_first_policy_is_the_guide(name):
    action, guide = ACTIONS[name]
    env = advised(action, guide, count=64)
    data = env.reset()
    expected = guide(data["observation"])
    if isinstance(action, Bounded):  # tanh reaches no bound
        middle, half = (
            (action.space.low + action.space.high) / 2,
            (action.space.high - action.space.low) / 2,
        )
        expected = middle + half * ((expected - middle) / half).clamp(-0.97, 0.97)
    torch.testing.assert_close(acted(learner(env).policy, data), expected)


def test_weight_moves_the_mean_from_the_network_to_the_guide():
    env = advised(Unbounded((2,)), lambda observation: torch.full_like(observation[..., :2], 3.0))
    ppo = learner(env)
    anchored(ppo).head.weight.fill_(0.25)
    data = env.reset()
    own = anchored(ppo).head.head(data["observation"], data["guide_action"])[0]
    torch.testing.assert_close(acted(ppo.policy, data), own + 0.75)


def test_first_policy_takes_the_advised_option_with_probability_nine_tenths():
    env = advised(Categorical(4, ()), option(4))
    data = env.reset()
    probabilities = learner(env).policy.get_dist(data).probs
    advice = data["guide_action"][:, 0]
    torch.testing.assert_close((probabilities * advice).sum(-1), torch.full((8,), 0.9))


def test_policy_with_a_memory_starts_at_the_guide():
    gru = Gru(state=8)
    env = advised(Bounded(-1, 1, (2,)), lambda observation: two_numbers(observation) / 2)
    env = TransformedEnv(env, Compose(*gru.env_transforms()))
    ppo = learner(env, options={"network": gru}, warmup=0.0)
    data = env.reset()
    torch.testing.assert_close(acted(ppo.policy, data), data["guide_action"][:, 0])
    before = acted(ppo.policy, data)
    ppo.update(Rollout(env, ppo.policy, 8, ppo.keys).collect())
    assert (acted(ppo.policy, data) - before).abs().max() > 0


REPLAY = {"starts": 16, "batch_size": 16, "ratio": 4.0}


def test_sac_starts_at_the_guide_and_its_policy_waits_for_the_critics():
    torch.manual_seed(0)
    env = advised(Bounded(-1, 1, (2,)), two_numbers)
    sac = SAC(env, KEYS, action_gain=0.0, anchor=Anchor(warmup=0.5), **REPLAY)
    data = env.reset()
    first = acted(sac.policy, data)
    torch.testing.assert_close(first, two_numbers(data["observation"]).clamp(-0.97, 0.97))
    rollout = Rollout(env, sac.policy, 8, sac.keys)
    assert sac.update(rollout.collect(), 0.25)["minibatches"] > 0
    torch.testing.assert_close(acted(sac.policy, data), first)
    assert sac.update(rollout.collect(), 0.75)["anchor"] == 1
    assert (acted(sac.policy, data) - first).abs().max() > 0
    anchored(sac).head.weight.zero_()
    sampled = sac.loss.actor_network_params["module", "0", "module", "weight"]
    assert torch.equal(sampled, torch.zeros(1)), "the loss has the same weight"


@pytest.mark.parametrize(
    ("weight", "advised_acts"), [(1.0, True), (0.6, True), (0.4, False), (0.0, False)]
)
def test_dqn_takes_the_advised_option_unless_it_is_worse_by_more_than_the_weighted_range(
    weight, advised_acts
):
    env = advised(
        OneHot(3), lambda observation: F.one_hot(torch.ones_like(observation[..., 0]).long(), 3)
    )
    dqn = DQN(env, KEYS, action_gain=0.0, anchor=Anchor(), **REPLAY)
    assert acted(dqn.policy, env.reset()).argmax(-1).eq(1).all(), (
        "without any knowledge of the values"
    )
    values = dqn.policy.module[1]
    anchored(dqn).head.weight.fill_(weight)
    numbers = torch.tensor([[4.0, 2.0, 0.0]])
    data = env.reset()[:1].set("action_value", numbers)
    assert values(data)["action_value"].argmax().item() == (1 if advised_acts else 0)
    metrics = dqn.update(Rollout(env, dqn.policy, 8, dqn.keys).collect(), 0.0)
    assert metrics["epsilon"] == pytest.approx(0.3), "little noise"


def results(*returns, failures=(0, 0, 0, 0, 0)):
    return CaseResults(torch.tensor(returns), failures[: len(returns)])


def first_results(*returns):
    """Return results of two guides, the policy of its own, and worse opposites of the guides."""
    return results(*returns, *[[value - 1 for value in returns[2]]] * 2)


@pytest.fixture
def anchor():
    env = advised(Bounded(-1, 1, (2,)), two_numbers, lambda observation: -two_numbers(observation))
    return anchored(learner(env))


def brake(anchor):
    return Brake(anchor, anchor.head, cases=None)


def test_best_guide_holds_if_it_is_better_than_a_new_policy_and_random_actions(anchor):
    anchor.begin(
        first_results([5.0, 6, 7], [9.0, 10, 12], [1.0, 2, 3]),
        torch.tensor([0.0, 1, 2]),
        anchor.head,
    )
    assert anchor.active
    assert anchor.head.weight.tolist() == [0, 1]
    assert anchor.best_returns.tolist() == [9, 10, 12]


def test_opposite_of_the_worst_guide_holds_if_it_is_the_best_and_lets_go_like_a_guide(anchor):
    bad = [-20.0, -20, -20]
    compared = results(
        bad, bad, [0.0, 0, 0], [5.0, 6, 7], [100.0, 100, 100], failures=(9, 9, 9, 9, 1)
    )
    anchor.begin(compared, torch.zeros(3), anchor.head)
    assert anchor.head.weight.tolist() == [0, -1]
    assert (anchor.weight, anchor.best_returns.tolist(), anchor.guide_failures) == (1, [100] * 3, 1)
    anchor.decide(results([100.0, 100, 100], [100.0, 100, 100]), anchor.head)
    assert anchor.head.weight.tolist() == pytest.approx([0, -0.95])
    anchor.decide(results([90.0, 90, 90], [90.0, 90, 90]), anchor.head)
    assert anchor.head.weight.tolist() == [0, -1]
    assert anchor.set_noise(0.0)["anchor"] == -1
    for _ in range(30):
        anchor.decide(results([100.0, 100, 100], [100.0, 100, 100]), anchor.head)
    assert anchor.weight == 0
    anchor.head.weight.copy_(anchor.weights_of_guides(0.1))
    assert anchor.head.weight.tolist() == pytest.approx([0, -0.1]), "zero keeps the sign"


@pytest.mark.parametrize(
    ("own", "random"),
    [([9.0, 10, 12], [0.0, 1, 2]), ([1.0, 2, 3], [9.0, 10, 12]), ([9.0, 12, 9.9], [0.0, 0, 0])],
    ids=["as its own", "as random actions", "better by less than a standard error"],
)
def test_guide_that_is_no_better_does_not_hold(anchor, own, random):
    anchor.begin(first_results([9.0, 10, 12], [0.0, 0, 0], own), torch.tensor(random), anchor.head)
    assert not anchor.active
    assert anchor.weight == 0
    assert not any(brake(anchor).due(update, 24, {}) for update in range(1, 24))
    weights = {"loss_objective": 1.0, "loss_critic": 1.0}
    assert anchor.weights(weights, 0.0) == weights, "the policy learns at once"
    assert not anchor.best_state


def begun(anchor, weight=1.0):
    opposites = [[-100.0, -100, -100]] * len(anchor.head.weight)
    guides = [[100.0, 100, 100], [0.0, 0, 0]][: len(opposites)]
    anchor.begin(results(*guides, [0.0, 0, 0], *opposites), torch.zeros(3), anchor.head)
    anchor.head.weight.copy_(anchor.weights_of_guides(weight))
    anchor.decide(results([100.0, 100, 100], [0.0, 0, 0]), anchor.head)
    return anchor


def test_weight_falls_by_a_step_while_one_lower_by_the_margin_loses_at_most_its_tolerances(
    anchor,
):
    assert torch.stack(begun(anchor).candidates()).tolist() == [[1, 0], pytest.approx([0.7, 0])]
    assert not anchor.decide(results([100.0, 100, 100], [94.5, 94, 94]), anchor.head)
    assert anchor.weight == pytest.approx(0.95)
    assert not anchor.decide(results([100.0, 100, 100], [93.5, 93.5, 93.5]), anchor.head)
    assert anchor.weight == pytest.approx(0.95), "the lower one loses too much"
    assert not anchor.decide(
        results([100.0, 100, 100], [100.0, 100, 100], failures=(0, 1)), anchor.head
    )
    assert anchor.weight == pytest.approx(0.95), "the lower one fails"


def test_weight_falls_by_the_margin_if_the_lower_one_is_much_better_than_all_before(anchor):
    begun(anchor).decide(results([100.0, 100, 100], [104.0, 104, 104]), anchor.head)
    assert anchor.weight == pytest.approx(0.7)
    anchor.decide(results([102.0, 102, 102], [104.0, 104, 104]), anchor.head)
    assert anchor.weight == pytest.approx(0.65)


@pytest.mark.parametrize("kind", [PPO, SAC, DQN])
def test_policy_goes_back_to_the_best_check_up_after_a_failure_or_a_loss(kind):
    torch.manual_seed(0)
    action = OneHot(3) if kind is DQN else Bounded(-1, 1, (2,))
    guide = (
        (lambda observation: F.one_hot(option(3)(observation), 3)) if kind is DQN else two_numbers
    )
    trained = kind(advised(action, guide), KEYS, action_gain=0.0, anchor=Anchor())
    anchor, policy, good = begun(anchored(trained), 0.5), trained.policy, [100.0, 100, 100]
    for bad in (results(good, good, failures=(1, 0)), results([96.5, 96.5, 96.5], good)):
        assert not anchor.decide(results(good, [0.0, 0, 0]), policy)
        before = {name: value.clone() for name, value in policy.state_dict().items()}
        for value in policy.parameters():
            value.data += 1
        anchor.head.weight.copy_(anchor.weights_of_guides(0.2))
        assert anchor.decide(bad, policy)
        assert anchor.weight == pytest.approx(0.5)
        assert all(torch.equal(value, before[name]) for name, value in policy.state_dict().items())


@pytest.mark.parametrize(("loss", "goes_back"), [(2.99, False), (3.01, True)])
def test_policy_goes_back_after_a_loss_of_more_than_three_tolerances(anchor, loss, goes_back):
    begun(anchor)
    assert anchor.tolerance == pytest.approx(1.0)
    assert anchor.decide(results([100 - loss] * 3, [0.0, 0, 0]), anchor.head) is goes_back


@pytest.mark.parametrize(("errors", "goes_back"), [(1.99, False), (2.01, True)])
def test_policy_goes_back_after_a_loss_of_more_than_two_standard_errors(anchor, errors, goes_back):
    """Losses m - d, m, m + d in three cases: the standard error of their mean is d / root 3."""
    begun(anchor)
    spread = 30.0
    mean = errors * spread / 3**0.5
    assert mean > 3 * anchor.tolerance
    returns = [100 - mean + spread, 100 - mean, 100 - mean - spread]
    assert anchor.decide(results(returns, [0.0, 0, 0]), anchor.head) is goes_back


def test_loss_in_a_single_case_may_be_chance(anchor):
    begun(anchor)
    assert not anchor.decide(results([100.0, 100, 40], [0.0, 0, 0]), anchor.head)
    assert anchor.decide(results([80.0, 80, 80], [0.0, 0, 0]), anchor.head)


def test_weight_stops_at_zero(anchor):
    begun(anchor, 0.07)
    for _ in range(3):
        assert not anchor.candidates()[1].any()
        anchor.decide(results([100.0, 100, 100], [100.0, 100, 100]), anchor.head)
    assert anchor.weight == 0


@pytest.mark.parametrize("updates", [3, 32, 49, 1000])
def test_check_ups_are_spread_over_the_run(updates, anchor):
    first, *due = [
        update for update in range(updates + 1) if brake(anchor).due(update, updates, {})
    ]
    assert first == 0
    assert len(due) == min(anchor.anchor.looks, updates)
    assert due[-1] == updates
    gaps = [after - before for before, after in itertools.pairwise(due)]
    assert not gaps or max(gaps) - min(gaps) <= 1


@pytest.mark.parametrize("kind", [PPO, A2C, Reinforce, TRPO])
def test_only_the_critic_learns_at_first_and_the_noise_follows_its_schedule(kind):
    torch.manual_seed(0)
    env = advised(Bounded(-1, 1, (2,)), two_numbers)
    trained = learner(env, kind, warmup=0.5, noise=lambda progress: 0.3 - 0.2 * progress)
    anchored(trained).begin(results([1.0, 1], [0.0, 0], [0.0, 0]), torch.zeros(2), trained.policy)
    rollout = Rollout(env, trained.policy, 8, trained.keys)
    data = env.reset()
    first, value = acted(trained.policy, data), trained.critic(data.copy())["state_value"].detach()
    metrics = trained.update(rollout.collect(), 0.25)
    torch.testing.assert_close(acted(trained.policy, data), first)
    assert (trained.critic(data.copy())["state_value"] - value).abs().max() > 0
    assert metrics["anchor"] == 1
    assert metrics["noise"] == pytest.approx(0.25)
    trained.update(rollout.collect(), 0.75)
    assert (acted(trained.policy, data) - first).abs().max() > 0
    assert float(anchored(trained).head.head.log_scale.detach().exp()[0]) == pytest.approx(0.15)


@pytest.mark.parametrize("kind", [PPO, A2C, Reinforce, TRPO])
def test_rewards_are_those_of_the_env_as_for_every_other_method(kind):
    env = advised(Bounded(-1, 1, (2,)), two_numbers)
    trained = learner(env, kind)
    anchored(trained).begin(
        results([64.0, 64.0], [0.0, 0], [-32.0, -32.0]), torch.zeros(2), trained.policy
    )
    batch = Rollout(env, trained.policy, 8, trained.keys).collect()
    rewards = batch["next", "reward"].clone()
    trained.update(batch)
    torch.testing.assert_close(batch["next", "reward"], rewards, rtol=0, atol=0)


def test_state_brings_back_the_weight_and_the_brake():
    env = advised(Bounded(-1, 1, (2,)), two_numbers)
    first, second = learner(env), learner(env)
    anchor = begun(anchored(first), 0.8)
    anchor.decide(results([110.0, 110, 110], [110.0, 110, 110]), first.policy)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    assert anchored(second).weight == anchor.weight == pytest.approx(0.75)
    torch.testing.assert_close(anchored(second).state_dict(), anchor.state_dict())
    anchored(second).decide(results([0.0, 0, 0], [0.0, 0, 0]), second.policy)
    assert anchored(second).weight == pytest.approx(0.8), "the best policy is in the state"


def test_anchor_without_advice_or_out_of_range_is_refused():
    with pytest.raises(KeyError, match="the env has no entry guide_action to observe"):
        PPO(AnyEnv(), anchor=Anchor())
    with pytest.raises(ValueError, match=r"margin=0\.01 must be at least 0\.05"):
        Anchor(margin=0.01)


def test_tolerance_is_unknown_before_training(anchor):
    assert math.isnan(anchor.tolerance)
