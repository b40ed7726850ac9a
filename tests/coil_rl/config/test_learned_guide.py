import shutil

import pytest
import torch
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf
from run_folders import make_untrained_run
from torchrl.data import Bounded, Categorical, Unbounded

from coil_rl.config.learned_guide import LONGEST_CHAIN, LearnedGuide
from coil_rl.config.parts import build_guides, env_maker
from coil_rl.config.python import open_run
from coil_rl.errors import UserError
from coil_rl.run.evaluation import evaluate_policy
from coil_rl.testing import check_guide
from coil_rl.transforms.action_space import ActionSpace

TINY = [
    "track=generated",
    "track.train.count=1",
    "track.test.count=1",
    "env.laps=1",
    "env.time_limit=1",
    "evaluation.curve.env.time_limit=1",
    "evaluation.repeats=1",
    "evaluation.gif=false",
    "logger=none",
    "budget.num_envs=4",
    "budget.steps=16",
    "budget.frames=128",
]


def composed(*overrides, name="train"):
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        return compose(name, [*overrides])


@pytest.fixture(
    scope="module", params=["ppo", "coil action=choices", "residual_coil", "jump_start"]
)
def run(request, tmp_path_factory):
    return make_untrained_run(
        tmp_path_factory.mktemp("runs") / "run", *TINY, *f"method={request.param}".split()
    )


@pytest.mark.slow
def test_guide_drives_as_the_policy_in_its_own_env(run):
    opened = open_run(run)
    env = opened.make_env(3, "evaluation", count=3)
    policy = evaluate_policy(env, opened.policy(env))
    guided = composed(
        *TINY, "method=guide", "guide=learned", f"guide.learned.run={run}", "run_dir=unused"
    )
    guided_env = env_maker(guided)(3, "evaluation", count=3)
    learned = evaluate_policy(guided_env, build_guides(guided)["learned"])
    assert [row["reward"] for row in learned.episodes] == [row["reward"] for row in policy.episodes]


@pytest.mark.slow
def test_guide_is_deterministic_and_advises_another_agent(run):
    env = env_maker(composed(*TINY, "method=ppo", "run_dir=unused"))()
    data, guide = env.rollout(5, break_when_any_done=False)[:, -1], LearnedGuide(str(run))
    check_guide(guide, data, tolerance=1e-6)
    assert not any(p.requires_grad for p in guide.parameters())
    assert set(guide(data.select(*guide.in_keys)).keys()) == {*guide.in_keys, "action"}
    config = composed(
        *TINY, "method=coil", "guide=learned", f"guide.learned.run={run}", "run_dir=unused"
    )
    step = env_maker(config)().rollout(5, break_when_any_done=False)[:, -1]
    # Not to the bit: some processors round other numbers of rows differently.
    expected = guide(step.clone())["action"]
    torch.testing.assert_close(step["guide_action"][:, 0], expected, atol=1e-6, rtol=0)


def test_run_without_an_agent_is_refused(tmp_path):
    run = make_untrained_run(tmp_path / "guide", *TINY, "method=guide")
    with pytest.raises(
        ValueError, match="trained no agent: its method is guide; name its guide instead"
    ):
        LearnedGuide(str(run))


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        ["guide=recorded", "method=coil"],
        ["guide=spline_memory", "method=coil"],
        ["network=gru"],
    ],
)
def test_policy_with_a_past_acts_as_in_its_own_env(options, tmp_path):
    (tmp_path / "actions.csv").write_text("0.1\n0.2\n-0.3\n")
    if "guide=recorded" in options:
        options = [*options, f"guide.recorded.file={tmp_path / 'actions.csv'}"]
    run = make_untrained_run(tmp_path / "run", *TINY, "learner.action_gain=3", *options)
    opened = open_run(run)
    env = opened.make_env(3, "evaluation", count=3)
    policy = evaluate_policy(env, opened.policy(env))
    guided = composed(
        *TINY, "method=guide", "guide=learned", f"guide.learned.run={run}", "run_dir=unused"
    )
    learned = evaluate_policy(*env_maker(guided).guided(3, "evaluation", count=3))
    assert [row["reward"] for row in learned.episodes] == pytest.approx(
        [row["reward"] for row in policy.episodes], abs=1e-5
    )


def guided_by(run, guide):
    """Replace the guide of a run by the policy of another one."""
    config = OmegaConf.load(run / "config.yaml")
    guides = {"learned": {"_target_": "coil_rl.LearnedGuide", "run": str(guide)}}
    config.guide = config.method.transforms.advice.guides = guides
    OmegaConf.save(config, run / "config.yaml")


@pytest.mark.slow
@pytest.mark.parametrize("length", [1, 3, LONGEST_CHAIN + 1])
def test_run_that_is_its_own_guide_is_refused(length, tmp_path):
    make_untrained_run(tmp_path / "0", *TINY, "method=coil")
    for number in range(1, length):
        shutil.copytree(tmp_path / "0", tmp_path / str(number))
    for number in range(length):
        guided_by(tmp_path / str(number), tmp_path / str((number + 1) % length))
    message = f"a chain of more than {LONGEST_CHAIN} learned guides, or is its own guide"
    for _ in range(2):  # the first refusal leaves nothing behind
        with pytest.raises(UserError, match=message):
            LearnedGuide(str(tmp_path / "0"))


@pytest.mark.slow
@pytest.mark.parametrize("env_id", ["Pendulum-v1", "MountainCarContinuous-v0"])
def test_policy_that_observes_its_last_actions_acts_as_in_its_own_env(env_id, tmp_path):
    words = ["env=gym", f"env.id={env_id}", "env.max_steps=6"]
    own = ["method=ppo", "+transform=last_action", "method.observes=[last_action]"]
    own.append("method.transforms.last_action.steps=2")
    run = make_untrained_run(tmp_path / "run", *words, *own, "learner.action_gain=3")
    opened = open_run(run)
    env = opened.make_env(2, "evaluation", count=2)
    policy = evaluate_policy(env, opened.policy(env))
    learned = ["method=guide", "guide=learned", f"guide.learned.run={run}", "run_dir=unused"]
    guided = env_maker(composed(*words, *learned)).guided(2, "evaluation", count=2)
    assert [row["reward"] for row in evaluate_policy(*guided).episodes] == pytest.approx(
        [row["reward"] for row in policy.episodes], rel=1e-5
    )


def test_env_with_another_action_is_refused(tmp_path):
    run = make_untrained_run(tmp_path / "run", "env=gym", "env.id=Pendulum-v1", "method=ppo")
    guide = LearnedGuide(str(run))
    guide.meet(ActionSpace(Bounded(-2, 2, (1, 1)), 1), {})
    for spec in (Unbounded((1, 1)), Bounded(-1, 1, (1, 1)), Categorical(3, (1,))):
        with pytest.raises(UserError, match=r"acts from \[-2.0\] to \[2.0\], but the action of"):
            guide.meet(ActionSpace(spec, 1), {})
