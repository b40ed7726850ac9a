"""The policy of a run acts in another env as it did in its own."""

import numpy as np
import pytest
import torch
from drives import drive
from programs import ROOT
from run_folders import make_untrained_run

from coil_rl.envs import McapReplayEnv
from coil_rl.errors import UserError
from coil_rl.guides import SplineGuide
from coil_rl.train import load

TRACK = ["track=generated", "track.train.count=1", "learner.action_gain=1.0"]


def perception(ranges, angles):
    """Cones to both sides that come nearer from scan to scan, so that a guide says something else each time."""
    cones = np.zeros((len(ranges), 2, 3, 2))
    cones[..., 0] = np.arange(3) + 2 + np.linspace(1, 0, len(ranges)).reshape(-1, 1, 1)
    cones[:, 0, :, 1], cones[:, 1, :, 1] = 2, -1
    return cones, np.full((len(ranges), 2), 3)


@pytest.fixture
def replay(tmp_path):
    return McapReplayEnv(drive(tmp_path / "drive.mcap", 6), perception)


def acts(run, replay):
    """All steps of a run's policy in a replay."""
    env, policy = load.load_policy_in_env(run, load.read_config(run, "run"), replay)
    with torch.no_grad():
        return env.eval().rollout(6, policy)[0]


def test_an_agent_sees_what_its_guide_says_about_this_env(replay, tmp_path):
    steps = acts(make_untrained_run(tmp_path / "coil", "method=coil", *TRACK), replay)
    with torch.no_grad():
        alone = replay.rollout(6, SplineGuide())[0]
    # The first time the guide has no action of another driver to go on from.
    assert torch.equal(steps["guide_action"][0, 0], alone["action"][0])
    assert steps["guide_action"].shape == (6, 1, 1)


def test_what_reaches_the_env_is_what_the_method_makes_of_the_action(replay, tmp_path):
    steps = acts(make_untrained_run(tmp_path / "residual", "method=residual", *TRACK), replay)
    reached = (steps["guide_action"][:, 0] + 0.5 * steps["action"]).clamp(-1, 1)
    torch.testing.assert_close(steps["next", "steering"], reached)
    assert (reached - steps["action"]).abs().min() > 1e-3


def test_tracks_of_the_training_may_be_gone(replay, tmp_path):
    track = tmp_path / "ring.csv"
    track.write_bytes((ROOT / "tests" / "ring.csv").read_bytes())
    run = make_untrained_run(tmp_path / "ppo", "method=ppo", "track=folder", f"track.dir={track}")
    track.unlink()
    assert acts(run, replay)["action"].shape == (6, 1)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["method=guide"], "has no agent: its guide drives alone; name that guide instead"),
        (["method=ppo", "env=driving_tasks", "also_observes=[task]"], "the env has no entry task to observe; it has"),
    ],
)
def test_a_run_that_cannot_act_there_is_refused_by_its_folder(replay, tmp_path, overrides, words):
    run = make_untrained_run(tmp_path / "run", *overrides, *TRACK[:2])
    with pytest.raises(UserError, match=words) as refusal:
        acts(run, replay)
    assert str(run) in str(refusal.value)
