import pytest
import torch
from any_env import AnyEnv, learning
from scipy import stats
from tensordict.nn import TensorDictModule
from torch.nn import functional as F
from torchrl.data import Bounded, Categorical, MultiCategorical, OneHot, Unbounded
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.learners import A2C, DQN, PPO, SAC, TRPO, Anchor, Gru, Reinforce
from coil_rl.learners.anchor import BARS, PROMISING, Hold, hold_of, rest_guides, start_tests
from coil_rl.learners.policy import UNCLIPPED
from coil_rl.run.rollout import Rollout
from coil_rl.transforms import GuideActions, Takeover
from coil_rl.transforms.action_space import ActionSpace

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


def acted(policy, data):
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        return policy(data.copy())["action"]


@pytest.mark.parametrize("name", ACTIONS)
def test_first_policy_is_the_guide(name):
    action, guide = ACTIONS[name]
    env = advised(action, guide, count=64)
    data = env.reset()
    torch.testing.assert_close(acted(learner(env).policy, data), guide(data["observation"]))


@pytest.mark.parametrize(("weight", "share"), [(-0.75, 0.5), (0.0, 1.0)], ids=["held", "not held"])
def test_action_is_the_weighted_guide_plus_a_share_of_the_own_part_within_the_bounds(weight, share):
    env = advised(Bounded(-1, 1, (2,)), two_numbers, count=64)
    policy = learner(env, reach=0.5).policy
    hold_of(policy).set([weight])
    data = env.reset()
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        data = policy(data)
    expected = weight * data["guide_action"][:, 0] + share * data[UNCLIPPED]
    assert weight == 0 or (expected.abs() > 1).any(), "the bounds matter"
    torch.testing.assert_close(data["action"], expected.clamp(-1, 1))
    of_own_part = policy.get_dist(data).log_prob(data[UNCLIPPED])
    torch.testing.assert_close(data["action_log_prob"], of_own_part)


@pytest.mark.parametrize(("count", "probability"), [(2, 0.75), (4, 3 / (3 + 3**0.5))])
def test_probability_of_the_advised_option_at_half_a_choice_weight(count, probability):
    """The bonus is half of log(9 (n - 1)), so the odds are 3 to the root of n - 1."""
    env = advised(Categorical(count, ()), option(count))
    data = env.reset()
    probabilities = learner(env).policy.get_dist(data).logits.softmax(-1)
    found = (probabilities * data["guide_action"][:, 0]).sum(-1)
    torch.testing.assert_close(found, torch.full((8,), probability))


@pytest.mark.parametrize("name", ["index", "one-hot", "several"])
def test_opposite_of_choices_is_their_reverse_order(name):
    action, guide = ACTIONS[name]
    env = advised(action, guide, count=64)
    policy = learner(env).policy
    hold_of(policy).set([-1.0])
    data = env.reset()
    space = ActionSpace(env.action_spec, 1)
    mirrored = space.actions(space.mirrored(data["guide_action"][:, 0]))
    torch.testing.assert_close(acted(policy, data).long(), mirrored.long())


@pytest.mark.parametrize("kind", [PPO, A2C, Reinforce, TRPO, SAC, DQN])
def test_advice_is_hidden_while_no_guide_is_held(kind):
    env = advised(*ACTIONS["one-hot" if kind is DQN else "bounded"])
    policy = learning(kind, env, KEYS, action_gain=1.0, anchor=Anchor())[0].policy
    data = env.reset()
    other = data.clone().set("guide_action", data["guide_action"].flip(0))
    if kind is not DQN:
        assert not torch.equal(acted(policy, data), acted(policy, other))
    hold_of(policy).set([0.0])
    torch.testing.assert_close(acted(policy, data), acted(policy, other), rtol=0, atol=0)


@pytest.mark.parametrize("name", ACTIONS)
@pytest.mark.parametrize("held", [0.0, 0.5])
def test_guides_that_are_not_held_rest_unless_something_else_reads_their_advice(name, held):
    batches, calls = [], []
    for others in (["guide_action"], []):
        env = advised(*ACTIONS[name])
        torch.manual_seed(0)
        policy = learner(env).policy
        hold_of(policy).set([held])
        rest_guides(policy, env, others)
        batches.append(Rollout(env, policy, 12).collect())
        calls.append(env.transform[0].calls)
    assert (calls[1] == 0) == (held == 0)
    assert calls[0] > 0
    for key in ("action", "observation", ("next", "reward")):
        assert torch.equal(batches[0][key], batches[1][key])


def test_policy_with_a_memory_starts_at_the_guide_and_learns():
    gru = Gru(state=8)
    env = advised(Bounded(-1, 1, (2,)), lambda observation: two_numbers(observation) / 2)
    env = TransformedEnv(env, Compose(*gru.env_transforms()))
    ppo = learner(env, options={"network": gru})
    data = env.reset()
    torch.testing.assert_close(acted(ppo.policy, data), data["guide_action"][:, 0])
    before = acted(ppo.policy, data)
    ppo.update(Rollout(env, ppo.policy, 8, ppo.keys).collect())
    assert (acted(ppo.policy, data) - before).abs().max() > 0


def test_sac_starts_at_the_guide_and_learns_its_own_part():
    torch.manual_seed(0)
    env = advised(Bounded(-1, 1, (2,)), two_numbers)
    sac, rollout = learning(SAC, env, KEYS, action_gain=0.0, anchor=Anchor())
    data = env.reset()
    first = acted(sac.policy, data)
    torch.testing.assert_close(first, two_numbers(data["observation"]))
    batch = rollout.collect()
    assert sac.update(batch, 0.25)["minibatches"] > 0
    assert torch.equal(sac.buffer[:]["action"], batch["action"].reshape(-1, 2))
    assert UNCLIPPED not in sac.buffer[:], "critics rate what is executed"
    assert (acted(sac.policy, data) - first).abs().max() > 0


@pytest.mark.parametrize(("weight", "advised_acts"), [(0.6, True), (0.4, False)])
def test_dqn_takes_the_advised_option_unless_it_is_worse_by_more_than_the_weighted_range(
    weight, advised_acts
):
    second = torch.tensor([0, 1, 0])
    env = advised(OneHot(3), lambda observation: second.expand(*observation.shape[:-1], 3))
    anchor = Anchor(choice_weight=weight)
    dqn, rollout = learning(DQN, env, KEYS, action_gain=0.0, anchor=anchor)
    of_unknown_values = acted(dqn.policy, env.reset())
    assert of_unknown_values.argmax(-1).eq(1).all()
    values = dqn.policy.module[2]
    data = env.reset()[:1].set("action_value", torch.tensor([[4.0, 2.0, 0.0]]))
    assert values(data)["action_value"].argmax().item() == (1 if advised_acts else 0)
    metrics = dqn.update(rollout.collect(), 0.0)
    assert metrics["epsilon"] == pytest.approx(0.3), "little noise"


def test_state_holds_the_weights():
    env = advised(Bounded(-1, 1, (2,)), two_numbers, two_numbers)
    first, second = learner(env).policy, learner(env).policy
    hold_of(first).set([0.0, -0.5])
    second.load_state_dict(first.state_dict())
    assert hold_of(second).weight.tolist() == [0, -0.5]
    data = env.reset()
    torch.testing.assert_close(acted(first, data), acted(second, data))


def test_steps_in_which_the_guide_acts_are_learned_from():
    guide = TensorDictModule(two_numbers, in_keys=["observation"], out_keys=["action"])
    parts = Compose(GuideActions({"guide": guide}), Takeover(0.5))
    env = TransformedEnv(AnyEnv(action=Bounded(-1, 1, (2,))), parts)
    sac, rollout = learning(SAC, env, KEYS, anchor=Anchor())
    batch = rollout.collect()
    assert sac.update(batch, 0.25)["minibatches"] > 0
    executed = batch["next", "executed_action"].reshape(-1, 2)
    torch.testing.assert_close(sac.buffer[:]["action"], executed)


class Returns:
    """Cases in which the return of a policy depends on its weights alone, plus a number a case.

    Args:
        of: returns the return in each case for the weights, as a list.
        frames: of the run.
        noise: deviation of the returns from case to case, the same for all policies.
        spread: further deviation, of each policy its own.
    """

    def __init__(self, of, frames=10**6, noise=1.0, spread=0.2):
        self.of, self.frames, self.steps, self.noise, self.spread = of, frames, 0, noise, spread
        self.sampled, self.generator = {}, torch.Generator().manual_seed(0)

    def begin(self):
        self.cases = torch.empty(0)

    def renew(self, count):
        self.cases = self.noise * torch.randn(count, generator=self.generator)

    def compared(self, policies, sampled):
        self.taken = [100 * len(self.cases)] * len(policies)
        self.steps += sum(self.taken)
        returns = []
        for policy, samples in zip(policies, sampled, strict=True):
            weights = tuple(policy.weight.tolist())
            self.sampled[weights] = samples
            spread = torch.randn(len(self.cases), generator=self.generator)
            returns.append(self.of(weights) + self.cases + self.spread * spread)
        return returns


def decided(of, guides=1, action=None, cases=None, **options):
    """Return the weights after a start test, its numbers, and the cases."""
    space = ActionSpace((action or Bounded(-1, 1, (8, 2))), 1)
    hold = Hold(guides, space)
    cases = cases or Returns(of)
    (test,) = start_tests(Anchor(**options), hold, cases)
    numbers = test.after_update(0)
    return hold.weight.tolist(), numbers, cases


def test_guide_that_is_materially_better_is_held_after_two_or_four_cases():
    weights, numbers, cases = decided(lambda weights: 100 * weights[0])
    assert weights == [1]
    assert numbers["start/weight"] == 1
    assert numbers["start/cases"] in (2, 4)
    assert cases.sampled[0.0,] is True, "the new policy acts as in training"
    assert cases.sampled[1.0,] is False
    assert (-1.0,) not in cases.sampled, "the opposite is not tried if the guide passes"


def test_numbers_are_those_of_guide_and_new_policy_in_the_same_cases():
    """Gains are compared in other cases, whose returns differ by 50."""
    cases = Returns(lambda weights: 1000 * weights[0], noise=50.0)
    _, numbers, cases = decided(None, cases=cases)
    assert (0.5,) in cases.sampled, "gains were compared"
    assert numbers["start/guide"] - numbers["start/new"] == pytest.approx(1000, abs=1)


@pytest.mark.parametrize(
    ("of", "held"),
    [
        (lambda weights: -100 * weights[0], [-1]),
        (lambda weights: 100 * weights[0] + 200 * weights[1] + 50 * weights[2], [0, 1, 0]),
        (lambda weights: 100 - 60 * abs(weights[0] - 0.5) if weights[0] else 0, [0.5]),
        (lambda weights: 100 * (weights[0] in (-0.75, -1.0)) - weights[0], [-1]),
    ],
    ids=["reversed", "several", "a lower gain is better", "a lower gain of the opposite is not"],
)
def test_best_guide_opposite_or_gain_is_held(of, held):
    assert decided(of, guides=len(held))[0] == held


@pytest.mark.parametrize("gain", [0.3, 0.0, -1.0], ids=["a little better", "equal", "worse"])
def test_guide_that_is_not_materially_better_is_not_held(gain):
    """The returns of the new policy have a deviation of 1 from case to case."""
    weights, numbers, cases = decided(lambda weights: gain * abs(weights[0]), cases=None)
    assert weights == [0]
    assert numbers["start/cases"] == max(BARS)
    assert cases.steps <= 3 * 100 * max(BARS), "the guide, its opposite and the new policy"


def test_only_what_is_ahead_in_every_case_goes_on():
    """A lead of 0.9 is seen in every case, and is less than a deviation of the new policy."""
    cases = Returns(lambda weights: 0.9 * weights[0], noise=20.0)
    assert decided(None, cases=cases)[0] == [0]
    assert (-1.0,) not in cases.sampled
    assert cases.steps == 2 * 100 * max(BARS), "the guide and the new policy"
    cases = Returns(lambda weights: -0.9 * weights[0], noise=20.0)
    assert decided(None, cases=cases)[0] == [0]
    assert cases.steps == 2 * 100 * max(BARS) + 2 * 100, "the guide in the first two cases only"


@pytest.mark.slow
def test_useless_guides_are_rarely_held():
    """The rates of error of the bars are 0.5 % to 1 % for each of two candidates and four looks."""
    held = 0
    for seed in range(300):
        cases = Returns(lambda weights: 0.0)
        cases.generator.manual_seed(seed)
        held += decided(None, cases=cases)[0] != [0]
    assert held <= 3


@pytest.mark.parametrize(
    ("of", "given", "options", "held", "count"),
    [
        # The next two cases would take 600 steps more than the share.
        (lambda weights: -5.0 * abs(weights[0]), {"frames": 20_000}, {"share": 0.05}, 0, 2),
        # Its least cases are taken whatever they take.
        (lambda weights: -5.0 * abs(weights[0]), {"frames": 1_500}, {"least_cases": 4}, 0, 4),
        # Two equal differences are not enough where the returns of two cases lie about 10 apart.
        (lambda weights: 20.0 * weights[0], {"noise": 10.0, "spread": 0.0}, {"gains": ()}, 1, 4),
    ],
    ids=["share", "least cases", "equal differences"],
)
def test_start_test_takes_some_cases(of, given, options, held, count):
    cases = Returns(of, **given)
    weights, numbers, _ = decided(None, cases=cases, **options)
    assert (weights, numbers["start/cases"]) == ([held], count)
    assert cases.steps == (2 if held else 3) * 100 * count


@pytest.mark.parametrize("frames", [1_000, 12_000, 18_000, 30_000, 50_000, 200_000])
@pytest.mark.parametrize("gain", [100.0, 0.3, -100.0], ids=["good", "even", "reversed"])
def test_start_test_takes_no_more_than_its_share_after_its_first_cases(gain, frames):
    cases = Returns(lambda weights: gain * weights[0], frames=frames)
    decided(None, cases=cases)
    assert cases.steps <= max(600, PROMISING * 0.05 * frames)


def test_guide_that_is_ahead_in_every_case_gets_more_cases():
    """Four cases are too few for this lead, and eight take 0.067 of the frames."""
    held, most = 0, 0
    for seed in range(20):
        cases = Returns(lambda weights: 3 * max(weights[0], 0), frames=24_000, spread=0.8)
        cases.generator.manual_seed(seed)
        held += decided(None, cases=cases, gains=())[0] == [1]
        most = max(most, cases.steps)
    assert held >= 15
    assert 0.05 * 24_000 < most <= 0.08 * 24_000


def test_lower_gains_are_not_tried_where_the_share_does_not_allow_for_them():
    cases = Returns(lambda weights: 100 - 60 * abs(weights[0] - 0.5) if weights[0] else 0)
    cases.frames = 18_000
    weights, numbers, _ = decided(None, cases=cases)
    assert weights == [1], "four cases of three gains would take 1,200 steps more"
    assert numbers["start/guide"] == pytest.approx(70, abs=2), "of the cases that there are"


def test_lower_gains_beyond_the_share_must_pass_the_bars():
    """Both lower gains are better by about three standard errors of four cases."""
    taken = {}
    for frames in (24_000, 200_000):
        found = []
        for seed in range(20):
            cases = Returns(lambda weights: 100 + 0.4 * (weights[0] < 1) if weights[0] else 0)
            cases.frames = frames
            cases.generator.manual_seed(seed)
            found.append(decided(None, cases=cases)[0] != [1])
            assert cases.steps <= PROMISING * 0.05 * frames
        taken[frames] = sum(found)
    assert taken[24_000] <= 5
    assert taken[200_000] >= 15
    much_better = Returns(lambda weights: 130 - 60 * weights[0] if weights[0] else 0, frames=24_000)
    assert decided(None, cases=much_better)[0] == [0.5]


def test_gains_are_not_tried_for_choices():
    _, _, cases = decided(lambda weights: 100 * weights[0], action=Categorical(4, (8,)))
    assert set(cases.sampled) == {(1.0,), (0.0,)}


def test_bars_are_quantiles_of_the_t_distribution():
    for count, tail in {4: 0.005, 8: 0.005, 12: 0.01}.items():
        assert stats.t.ppf(1 - tail, count - 1) == pytest.approx(BARS[count], abs=0.06)
