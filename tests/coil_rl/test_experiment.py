import csv

import torch
from torchrl.envs import Compose, RewardSum, TransformedEnv

from coil_rl import checkpoint
from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.experiment import Experiment, watched_keys
from coil_rl.guides import SplineGuide
from coil_rl.learners import PPO
from coil_rl.rollout import Rollout
from coil_rl.transforms import GuideActions

WATCH = {"episode": {"crashed": ["info", "crashed"]}, "step": {"cone": ["info", "reward", "cone"]}}


def experiment(folder, seed=0, frames=16 * 8 * 4):
    torch.manual_seed(seed)
    env = ConeTrackEnv(shipped_tracks("train"), 16, seed=seed)
    env = TransformedEnv(env, Compose(GuideActions({"guide": SplineGuide()}), RewardSum()))
    learner = PPO(env, ["observation", "guide_action"], epochs=2, minibatches=2, seed=seed)
    rollout = Rollout(env, learner.policy, 8, [*learner.keys, "episode_reward", *watched_keys(WATCH)])
    folder.mkdir()
    return Experiment(learner, rollout, frames, folder, watch=WATCH, checkpoint_every=2)


def test_a_run_leaves_its_files_and_a_row_an_update(tmp_path):
    rows = experiment(tmp_path / "run").run()
    names = sorted(file.name for file in (tmp_path / "run").iterdir())
    assert names == ["checkpoint.pt", "metrics.csv", "policy_best.pt", "policy_last.pt"]
    with (tmp_path / "run" / "metrics.csv").open() as file:
        written = list(csv.DictReader(file))
    assert [float(row["frames"]) for row in written] == [row["frames"] for row in rows] == [128, 256, 384, 512]
    assert {"train/return", "train/crashed", "train/cone", "learner/loss_critic"} <= set(written[0])


def test_same_seed_same_metrics(tmp_path):
    for name, seed in [("first", 1), ("second", 1), ("other", 2)]:
        experiment(tmp_path / name, seed).run()
    logs = [(tmp_path / name / "metrics.csv").read_text() for name in ("first", "second", "other")]
    assert logs[0] == logs[1] != logs[2]


def test_checkpoint_holds_what_the_rest_of_a_run_depends_on(tmp_path):
    whole = experiment(tmp_path / "whole")
    rows = whole.run()
    half = experiment(tmp_path / "half", frames=16 * 8 * 2)
    half.run()
    rest = experiment(tmp_path / "rest", seed=9)
    rest.load_state_dict(checkpoint.load(tmp_path / "half" / "checkpoint.pt"))
    # The learning rate is constant, so it does not matter that the first half thought it was the whole.
    for row in rows[2:]:
        again = rest.update(rest.updates / 4)
        assert {key: str(value) for key, value in again.items()} == {key: str(value) for key, value in row.items()}
    ours, theirs = (run.learner.policy.state_dict() for run in (whole, rest))
    assert all(torch.equal(ours[key], theirs[key]) for key in ours)


def test_log_terms_add_up_to_the_reward(tmp_path):
    run = experiment(tmp_path / "run")
    batch = Rollout(run.rollout.env, run.learner.policy, 40).collect()
    terms = sum(batch["next", "info", "reward", term] for term in ("finish", "crash", "cone", "smooth", "alive"))
    torch.testing.assert_close(terms, batch["next", "reward"])
