"""Every combination of a method and a learner trains or is refused."""

import pytest
from programs import composed, shipped

from coil_rl.config.check import check
from coil_rl.config.parts import build_learner, env_maker
from coil_rl.errors import UserError
from coil_rl.run.rollout import Rollout

METHODS = shipped("method")
DYNAMIC = [name for name in METHODS if name.startswith("dynamic")]
TINY = [
    "track=generated",
    "evaluation.curve.env.time_limit=1",
    "track.train.count=1",
    "track.test.count=1",
    "budget.num_envs=4",
    "budget.steps=8",
    "run_dir=unused",
]
OFF_POLICY = [
    "learner.starts=16",
    "learner.batch_size=8",
    "learner.updates_per_step=0.125",
    "learner.hidden=[8]",
]
GIVEN = {
    "dqn": OFF_POLICY,
    "sac": OFF_POLICY,
    "ppo": ["learner.epochs=1", "learner.minibatches=2", "action=choices"],
}

IMITATES = "needs a learner that imitates a guide, such as learner=forest, but"
IMPROVES = "needs a learner that improves its guides, such as learner=dynamic_coil, but"
REFUSED = dict.fromkeys(["dagger", "oil"], IMITATES) | dict.fromkeys(DYNAMIC, IMPROVES)
OTHER_LEARNER = r"learner: (DQN|PPO|IBRL|Advisor) takes no \w+; it takes env, in_keys,"
REFUSED_BY = {
    "dqn": dict.fromkeys(
        ["advisor", "cheq", "ibrl", "imitate_then_ppo", "kickstart", "q_filter", "rlpd", "wsrl"],
        OTHER_LEARNER,
    ),
    "sac": {"advisor": OTHER_LEARNER},
    "ppo": dict.fromkeys(["cheq", "ibrl", "q_filter", "rlpd", "wsrl"], OTHER_LEARNER),
}
CHANGES = "learner: weight of MixedAction changes over the run, so stored steps would"
REFUSED_BY["dqn"]["mixing"] = REFUSED_BY["sac"]["mixing"] = CHANGES
BY_GUIDE = ["jump_start", "policy_decorator"]  # its steps may be none that the agent could take


def refusal(method, learner):
    return REFUSED.get(method) or REFUSED_BY[learner].get(method)


WITHOUT = ("guide", "tune")
PAIRS = [(method, learner) for method in METHODS if method not in WITHOUT for learner in GIVEN]


@pytest.mark.fast(3)
@pytest.mark.parametrize(("method", "learner"), [pair for pair in PAIRS if refusal(*pair)])
def test_incompatible_method_and_learner_are_refused(method, learner):
    config = composed(*TINY, f"method={method}", f"learner={learner}", *GIVEN[learner])
    with pytest.raises(UserError, match=refusal(method, learner)):
        check(config)


@pytest.mark.fast("coil_anchored-sac")
@pytest.mark.parametrize(("method", "learner"), [pair for pair in PAIRS if not refusal(*pair)])
def test_compatible_method_and_learner_train(method, learner):
    config = composed(*TINY, f"method={method}", f"learner={learner}", *GIVEN[learner])
    check(config)
    env = env_maker(config)()
    built = build_learner(config, env)
    rollout = Rollout(env, built.policy, config.budget.steps, built.keys)
    for _ in range(2):
        metrics = built.update(rollout.collect())
    assert (built.policy(env.reset())["action"].dtype.is_floating_point) == (learner == "sac")
    assert method in BY_GUIDE or metrics.get("minibatches", 4) == 4


def test_learner_with_replay_may_mix_with_a_weight_that_does_not_change():
    words = ["method=mixing", "learner=sac", "method.transforms.mixing.weight=0.5"]
    check(composed(*TINY, *words))
