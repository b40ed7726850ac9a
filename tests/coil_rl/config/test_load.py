import numpy as np
import pytest
import torch
from drives import drive
from programs import ROOT
from run_folders import make_untrained_run

from coil_rl.config.assemble import assemble
from coil_rl.config.compose import compose_train
from coil_rl.config.folder import holds
from coil_rl.config.python import open_run
from coil_rl.envs import McapReplayEnv
from coil_rl.errors import UserError
from coil_rl.guides import SplineGuide
from coil_rl.run import checkpoint

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


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["method=guide"], "has no agent: its guide drives alone; give that guide instead"),
        (
            ["method=ppo", "env=driving_tasks", "observes=[observation,task]"],
            "the env has no entry task to observe",
        ),
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
