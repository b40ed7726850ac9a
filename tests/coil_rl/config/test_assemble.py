import shutil

import numpy as np
import pytest
import torch
from drives import drive
from omegaconf import OmegaConf
from programs import ONE_SECOND, ROOT, composed
from run_folders import make_untrained_run
from torchrl.data import Bounded, Categorical, Unbounded

from coil_rl.config.assemble import LONGEST_CHAIN, LearnedGuide, assemble
from coil_rl.config.compose import compose_train
from coil_rl.config.folder import holds
from coil_rl.config.parts import env_maker
from coil_rl.config.python import open_run
from coil_rl.envs import McapReplayEnv
from coil_rl.errors import UserError
from coil_rl.guides import SplineGuide
from coil_rl.run import checkpoint
from coil_rl.run.evaluation import evaluate_policy
from coil_rl.testing import check_guide
from coil_rl.transforms.action_space import ActionSpace

METHODS = ["ppo", "coil action=choices", "residual_coil", "jump_start"]


@pytest.fixture(scope="module", params=METHODS)
def run(request, tmp_path_factory):
    return make_untrained_run(
        tmp_path_factory.mktemp("runs") / "run", *ONE_SECOND, *f"method={request.param}".split()
    )


def rewards(env, policy):
    return [row["reward"] for row in evaluate_policy(env, policy).episodes]


@pytest.mark.slow
def test_guide_is_deterministic_and_advises_another_agent(run):
    env = env_maker(composed(*ONE_SECOND, "method=ppo", "run_dir=unused"))()
    data, guide = env.rollout(5, break_when_any_done=False)[:, -1], LearnedGuide(str(run))
    check_guide(guide, env.base_env, tolerance=1e-6)
    assert not any(p.requires_grad for p in guide.parameters())
    assert set(guide(data.select(*guide.in_keys)).keys()) == {*guide.in_keys, "action"}
    learned = ["method=coil", "guide=learned", f"guide.learned.run={run}", "run_dir=unused"]
    config = composed(*ONE_SECOND, *learned)
    step = env_maker(config)().rollout(5, break_when_any_done=False)[:, -1]
    # Not to the bit: some processors round other numbers of rows differently.
    expected = guide(step.clone())["action"]
    torch.testing.assert_close(step["guide_action"][:, 0], expected, atol=1e-6, rtol=0)


def test_run_without_an_agent_is_refused(tmp_path):
    run = make_untrained_run(tmp_path / "guide", *ONE_SECOND, "method=guide")
    with pytest.raises(ValueError, match="trained no agent: its method is guide"):
        LearnedGuide(str(run))


PASTS = ["method=coil guide=recorded guide.recorded.file=FILE", "network=gru"]
PASTS += ["method=coil guide=spline_memory"]
LAST = "method=ppo +transform=last_action method.transforms.last_action.steps=2"
LAST += " method.observes=[last_action]"
SIX_STEPS = ["env=gym", "env.max_steps=6"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "words", "tolerance"),
    [
        *((ONE_SECOND, f"method={method}", {"rel": 0, "abs": 0}) for method in METHODS),
        *((ONE_SECOND, words, {"abs": 1e-5}) for words in PASTS),
        ([*SIX_STEPS, "env.id=Pendulum-v1"], LAST, {"rel": 1e-5}),
        ([*SIX_STEPS, "env.id=MountainCarContinuous-v0"], LAST, {"rel": 1e-5}),
    ],
)
def test_guide_acts_as_the_policy_does_in_its_own_env(env, words, tolerance, tmp_path):
    (tmp_path / "actions.csv").write_text("0.1\n0.2\n-0.3\n")
    words = words.replace("FILE", str(tmp_path / "actions.csv")).split()
    run = make_untrained_run(tmp_path / "run", *env, *words, "learner.action_gain=3")
    opened = open_run(run)
    own = opened.make_env(3, "evaluation", count=3)
    guided = ["method=guide", "guide=learned", f"guide.learned.run={run}", "run_dir=unused"]
    as_guide = env_maker(composed(*env, *guided)).guided(3, "evaluation", count=3)
    assert rewards(*as_guide) == pytest.approx(rewards(own, opened.policy(own)), **tolerance)


def guided_by(run, guide):
    """Replace the guide of a run by the policy of another one."""
    config = OmegaConf.load(run / "config.yaml")
    guides = {"learned": {"_target_": "coil_rl.LearnedGuide", "run": str(guide)}}
    config.guide = config.method.transforms.advice.guides = guides
    OmegaConf.save(config, run / "config.yaml")


@pytest.mark.slow
@pytest.mark.parametrize("length", [1, 3, LONGEST_CHAIN + 1])
def test_run_that_is_its_own_guide_is_refused(length, tmp_path):
    make_untrained_run(tmp_path / "0", *ONE_SECOND, "method=coil")
    for number in range(1, length):
        shutil.copytree(tmp_path / "0", tmp_path / str(number))
    for number in range(length):
        guided_by(tmp_path / str(number), tmp_path / str((number + 1) % length))
    message = f"a chain of more than {LONGEST_CHAIN} learned guides, or is its own guide"
    for _ in range(2):  # the first refusal leaves nothing behind
        with pytest.raises(UserError, match=message):
            LearnedGuide(str(tmp_path / "0"))


def test_env_with_another_action_is_refused(tmp_path):
    run = make_untrained_run(tmp_path / "run", "env=gym", "env.id=Pendulum-v1", "method=ppo")
    guide = LearnedGuide(str(run))
    guide.meet(ActionSpace(Bounded(-2, 2, (1, 1)), 1), {})
    for spec in (Unbounded((1, 1)), Bounded(-1, 1, (1, 1)), Categorical(3, (1,))):
        with pytest.raises(UserError, match=r"acts from \[-2.0\] to \[2.0\], but the action of"):
            guide.meet(ActionSpace(spec, 1), {})


TRACK = ["track=generated", "track.train.count=1", "learner.action_gain=1.0"]


def perception(ranges, angles):
    """Cones on both sides that come nearer from scan to scan, so that the advice changes."""
    cones = np.zeros((len(ranges), 2, 3, 2))
    cones[..., 0] = np.arange(3) + 2 + np.linspace(1, 0, len(ranges)).reshape(-1, 1, 1)
    cones[:, 0, :, 1], cones[:, 1, :, 1] = 2, -1
    return cones, np.full((len(ranges), 2), 3)


@pytest.fixture
def replay(tmp_path):
    return McapReplayEnv(drive(tmp_path / "drive.mcap", 6), perception)


def acts(run, replay):
    """Return all steps of the policy of a run in a replay."""
    env, policy = open_run(run).in_env(replay)
    with torch.no_grad():
        return env.eval().rollout(6, policy)[0]


def test_agent_observes_the_advice_of_its_guide_in_the_other_env(replay, tmp_path):
    steps = acts(make_untrained_run(tmp_path / "coil", "method=coil", *TRACK), replay)
    with torch.no_grad():
        alone = replay.rollout(6, SplineGuide())[0]
    # Later steps of the guide depend on the actions of the driver.
    assert torch.equal(steps["guide_action"][0, 0], alone["action"][0])
    assert steps["guide_action"].shape == (6, 1, 1)


def test_transforms_of_the_method_change_the_action(replay, tmp_path):
    steps = acts(make_untrained_run(tmp_path / "residual", "method=residual", *TRACK), replay)
    applied = (steps["guide_action"][:, 0] + 0.5 * steps["action"]).clamp(-1, 1)
    torch.testing.assert_close(steps["next", "steering"], applied)
    assert (applied - steps["action"]).abs().min() > 1e-3


def test_tracks_of_the_training_are_not_needed(replay, tmp_path):
    track = tmp_path / "ring.csv"
    track.write_bytes((ROOT / "tests" / "ring.csv").read_bytes())
    run = make_untrained_run(tmp_path / "ppo", "method=ppo", "track=folder", f"track.dir={track}")
    track.unlink()
    assert acts(run, replay)["action"].shape == (6, 1)


TASKS = ["method=ppo", "env=driving_tasks", "observes=[observation,task]"]


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["method=guide"], "has no agent: its guide drives alone; give that guide instead"),
        (TASKS, "the env has no entry task to observe"),
    ],
)
def test_run_that_cannot_act_in_the_env_is_refused_with_its_folder(
    replay, tmp_path, overrides, words
):
    run = make_untrained_run(tmp_path / "run", *overrides, *TRACK[:2])
    with pytest.raises(UserError, match=words) as refusal:
        acts(run, replay)
    assert str(run) in str(refusal.value)


@pytest.mark.slow
def test_weights_that_are_not_finite_are_refused(replay, tmp_path):
    run = make_untrained_run(tmp_path / "ppo", "method=ppo", *TRACK)
    state = checkpoint.load(run / "policy_last.pt")
    next(iter(state.values())).fill_(torch.nan)
    checkpoint.save(state, run / "policy_last.pt")
    with pytest.raises(UserError, match=r"policy_last\.pt holds weights that are NaN or infinite"):
        acts(run, replay)


@pytest.mark.fast(1)
@pytest.mark.parametrize("env", ["cone_track", "simulated_robot", "pendulum"])
def test_repeated_words_are_about_the_same_run(env, tmp_path):
    words = [f"env={env}", f"run_dir={tmp_path / 'run'}"]
    assemble(compose_train(words)).begin()
    assert holds(tmp_path / "run", compose_train(words))
    with pytest.raises(UserError, match=r"holds a run with learner.gamma="):
        holds(tmp_path / "run", compose_train([*words, "learner.gamma=0.5"]))
    with pytest.raises(UserError, match=r"a run with learner\._target_=coil_rl\.learners\.PPO,"):
        holds(tmp_path / "run", compose_train([*words, "learner=a2c"]))
