"""Every combination of a method and a learner trains or is refused."""

import pytest
from hydra import compose, initialize_config_module
from programs import shipped

from coil_rl.config.check import check
from coil_rl.config.parts import build_learner, env_maker
from coil_rl.errors import UserError
from coil_rl.run.rollout import Rollout

METHODS = shipped("method")
DYNAMIC = [name for name in METHODS if name.startswith("dynamic")]
IMITATION = ["dagger", "oil"]
TINY = [
    "track=generated",
    "evaluation.curve.env.time_limit=1",
    "track.train.count=1",
    "track.test.count=1",
    "budget.num_envs=4",
    "budget.steps=8",
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

REFUSED = {
    method: "needs a learner that imitates a guide, such as learner=forest, but"
    for method in IMITATION
}
REFUSED |= {
    method: "needs a learner that improves its guides, such as learner=dynamic_coil, but"
    for method in DYNAMIC
}
OTHER_LEARNER = r"learner: (DQN|PPO|IBRL|Advisor) takes no \w+; it takes env, in_keys,"
REFUSED_BY = {
    "dqn": dict.fromkeys(
        ["advisor", "cheq", "ibrl", "imitate_then_ppo", "kickstart", "q_filter", "rlpd", "wsrl"],
        OTHER_LEARNER,
    ),
    "sac": {"advisor": OTHER_LEARNER},
    "ppo": dict.fromkeys(["cheq", "ibrl", "q_filter", "rlpd", "wsrl"], OTHER_LEARNER),
}
for without_replay in ("dqn", "sac"):
    REFUSED_BY[without_replay]["mixing"] = (
        "learner: weight of MixedAction changes over the run, so stored steps would"
    )
BY_GUIDE = ["jump_start", "policy_decorator"]  # its steps may be none that the agent could take


def composed(folder, *overrides):
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        return compose("train", [*TINY, *overrides, f"run_dir={folder}"])


def refusal(method, learner):
    return REFUSED.get(method) or REFUSED_BY[learner].get(method)


WITHOUT = ("guide", "tune")
PAIRS = [(method, learner) for method in METHODS if method not in WITHOUT for learner in GIVEN]


@pytest.mark.fast(3)
@pytest.mark.parametrize(("method", "learner"), [pair for pair in PAIRS if refusal(*pair)])
def test_incompatible_method_and_learner_are_refused(method, learner, tmp_path):
    config = composed(tmp_path, f"method={method}", f"learner={learner}", *GIVEN[learner])
    with pytest.raises(UserError, match=refusal(method, learner)):
        check(config)


@pytest.mark.fast("coil_anchored-sac")
@pytest.mark.parametrize(("method", "learner"), [pair for pair in PAIRS if not refusal(*pair)])
def test_compatible_method_and_learner_train(method, learner, tmp_path):
    config = composed(tmp_path, f"method={method}", f"learner={learner}", *GIVEN[learner])
    check(config)
    env = env_maker(config)()
    built = build_learner(config, env)
    rollout = Rollout(env, built.policy, config.budget.steps, built.keys)
    for _ in range(2):
        metrics = built.update(rollout.collect())
    assert (built.policy(env.reset())["action"].dtype.is_floating_point) == (learner == "sac")
    assert method in BY_GUIDE or metrics.get("minibatches", 4) == 4


@pytest.mark.fast(2)
@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        (
            "learner=dqn action=continuous",
            "DQN needs discrete actions, but this env has continuous ones",
        ),
        (
            "learner=sac action=choices",
            "learner: SAC needs continuous actions, but this env has discrete ones",
        ),
        (
            "method=ppo learner=dynamic_coil",
            "such as learner=ppo, but DynamicCoil is one that improves its guides",
        ),
        (
            "method=dynamic_coil_sequential action=choices",
            "learner: Dynamic COIL needs continuous actions, but this env has discrete ones",
        ),
        ("learner=dqn action.choices=1", "action: choices=1 must be at least 2"),
        (
            "learner=dqn action.choices=[0.0,2.0]",
            r"choices=\[0.0, 2.0\] must lie between the action's bounds -1.0",
        ),
        (
            "learner=dqn learner.capacity=10",
            "learner: capacity=10 must be at least 1 and at least starts=500",
        ),
        (
            "learner=dqn budget.frames=500",
            "budget.frames=500 ends before learning starts, after learner.starts=500 stored",
        ),
        (
            "method=rlpd learner=sac budget.frames=4_999",
            "budget.frames=4999 ends before learning starts",
        ),
        (
            "method=ppo network=gru learner.minibatches=5",
            "learner.minibatches=5 are more than the 4 envs, but with a memory each needs all",
        ),
    ],
)
def test_other_incompatible_choices_are_refused(overrides, sentence, tmp_path):
    with pytest.raises(UserError, match=sentence):
        check(composed(tmp_path, *overrides.split()))


def test_learner_with_replay_may_mix_with_a_weight_that_does_not_change(tmp_path):
    check(composed(tmp_path, "method=mixing", "learner=sac", "method.transforms.mixing.weight=0.5"))


def test_off_policy_learners_set_their_action_and_batch(tmp_path):
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        dqn, sac, ppo = (compose("train", [f"learner={name}"]) for name in ("dqn", "sac", "ppo"))
    assert (dqn.action.choices, dict(sac.action), dict(ppo.action)) == (5, {}, {})
    assert [config.budget.num_envs * config.budget.steps for config in (dqn, sac, ppo)] == [
        32,
        32,
        6_144,
    ]
    assert len({config.budget.frames for config in (dqn, sac, ppo)}) == 1
