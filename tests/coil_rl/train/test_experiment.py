import csv
import re

import pytest
import torch
from torchrl.envs import Compose, RewardSum, Transform, TransformedEnv

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.errors import UserError
from coil_rl.guides import RandomGuide, SplineGuide
from coil_rl.learners import PPO
from coil_rl.train import checkpoint
from coil_rl.train.experiment import Experiment, watched_keys
from coil_rl.train.rollout import Rollout
from coil_rl.transforms import GuideActions

WATCH = {"episode": {"crashed": ["info", "crashed"]}, "step": {"cone": ["info", "reward", "cone"]}}


def experiment(folder, seed=0, frames=16 * 8 * 4, guide=None, extra=()):
    torch.manual_seed(seed)
    env = ConeTrackEnv(shipped_tracks("train"), 16, seed=seed)
    env = TransformedEnv(env, Compose(GuideActions({"guide": guide or SplineGuide()}), *extra, RewardSum()))
    learner = PPO(env, ["observation", "guide_action"], epochs=2, minibatches=2, seed=seed)
    rollout = Rollout(env, learner.policy, 8, [*learner.keys, *watched_keys(env, WATCH)])
    folder.mkdir(exist_ok=True)
    return Experiment(learner, rollout, frames, folder, watch=WATCH, checkpoint_every=2)


def test_a_run_leaves_its_files_and_a_row_an_update(tmp_path):
    rows = experiment(tmp_path / "run").run()
    names = sorted(file.name for file in (tmp_path / "run").iterdir())
    assert names == ["checkpoint.pt", "checkpoint_previous.pt", "metrics.csv", "policy_best.pt", "policy_last.pt"]
    with (tmp_path / "run" / "metrics.csv").open() as file:
        written = list(csv.DictReader(file))
    assert [float(row["frames"]) for row in written] == [row["frames"] for row in rows] == [128, 256, 384, 512]
    assert {"train/return", "train/crashed", "train/cone", "learner/loss_critic"} <= set(written[0])


def test_same_seed_same_metrics(tmp_path):
    for name, seed in [("first", 1), ("second", 1), ("other", 2)]:
        experiment(tmp_path / name, seed).run()
    logs = [(tmp_path / name / "metrics.csv").read_text() for name in ("first", "second", "other")]
    assert logs[0] == logs[1] != logs[2]


class Killed(BaseException):
    pass


@pytest.mark.parametrize(("guide", "last"), [(RandomGuide, 1), (RandomGuide, 4), (RandomGuide, 5), (SplineGuide, 4)])
def test_run_that_was_stopped_ends_with_the_files_of_one_that_never_was(tmp_path, guide, last, capsys):
    frames = 16 * 8 * 5
    whole = experiment(tmp_path / "whole", frames=frames, guide=guide())
    rows = whole.run()

    stopped = experiment(tmp_path / "stopped", frames=frames, guide=guide())
    update, seen = stopped.learner.update, []

    def dying(batch, progress):
        seen.append(progress)
        if len(seen) == last:
            raise Killed
        return update(batch, progress)

    stopped.learner.update = dying
    with pytest.raises(Killed):
        stopped.run()

    # Another seed: nothing may depend on how the second process begins, once there is a checkpoint.
    again = experiment(tmp_path / "stopped", seed=9 if last > 2 else 0, frames=frames, guide=guide())
    again.resume()
    assert str([{**row, "frames": int(row["frames"])} for row in again.run()]) == str(rows)
    place = f"after update {(last - 1) // 2 * 2}" if last > 2 else "from the beginning: there is no checkpoint yet"
    assert f"{tmp_path / 'stopped'} goes on {place}\n" in capsys.readouterr().err
    files = [{file.name: file.read_bytes() for file in (tmp_path / name).iterdir()} for name in ("whole", "stopped")]
    assert files[0].keys() == files[1].keys()
    for name in ("metrics.csv", "policy_last.pt", "policy_best.pt"):
        assert files[0][name] == files[1][name], name


def test_resume_of_a_finished_run_changes_nothing(tmp_path):
    rows = experiment(tmp_path / "run").run()
    before = {file.name: file.read_bytes() for file in (tmp_path / "run").iterdir()}
    again = experiment(tmp_path / "run", seed=9)
    again.resume()
    assert str([{**row, "frames": int(row["frames"])} for row in again.run()]) == str(rows)
    assert {file.name: file.read_bytes() for file in (tmp_path / "run").iterdir()} == before


class Spoiled(Transform):
    """Writes NaN into an entry of one car at one step of the run."""

    def __init__(self, key, step, car):
        super().__init__(in_keys=[key], out_keys=[key])
        self.step, self.car, self.steps = step, car, 0

    def _call(self, next_tensordict):
        self.steps += 1
        if self.steps == self.step:
            value = next_tensordict[self.in_keys[0]].clone()
            value[self.car] = torch.nan
            next_tensordict[self.in_keys[0]] = value
        return next_tensordict

    def _reset(self, tensordict, tensordict_reset):
        return tensordict_reset


@pytest.mark.parametrize("step", [20, 24])
@pytest.mark.parametrize("key", ["observation", "reward"])
def test_nan_from_an_env_stops_the_run_and_keeps_the_last_checkpoint(tmp_path, key, step):
    good = experiment(tmp_path / "good", frames=16 * 8 * 2)
    good.run()
    run = experiment(tmp_path / "run", extra=[Spoiled(key, step, 5)])
    # At step 20 the env itself breaks over what follows from the NaN; step 24 is the last of a batch.
    words = (
        f"next/{key} is nan at step {step} of car 5; the last good checkpoint is kept: mend the cause and go on with"
    )
    with pytest.raises(UserError, match=re.escape(f"{words} coil-train resume={tmp_path / 'run'}, or train again")):
        run.run()
    ours, theirs = (checkpoint.load(tmp_path / name / "checkpoint.pt") for name in ("run", "good"))
    assert ours["updates"] == theirs["updates"] == 2
    assert torch.equal(ours["rollout"]["env"]["pose"], theirs["rollout"]["env"]["pose"])
    mended = experiment(tmp_path / "run", seed=9)
    mended.resume()
    mended.run()


def test_nan_of_a_loss_or_a_weight_stops_the_run_and_keeps_the_last_checkpoint(tmp_path):
    for name in ("loss", "weight"):
        run = experiment(tmp_path / name)
        update = run.learner.update

        def spoiling(batch, progress, run=run, update=update, name=name):
            learned = update(batch, progress)
            if run.updates == 3:
                if name == "loss":
                    return learned | {"loss_critic": float("nan")}
                with torch.no_grad():
                    next(iter(run.learner.critic.parameters())).fill_(torch.nan)
            return learned

        run.learner.update = spoiling
        words = (
            "learner/loss_critic is nan in update 4" if name == "loss" else "learner/critic/.* is nan after update 4"
        )
        with pytest.raises(UserError, match=f"{words}; the last good checkpoint is kept"):
            run.run()
        assert checkpoint.load(tmp_path / name / "checkpoint.pt")["updates"] == 2
        assert not (tmp_path / name / "policy_last.pt").exists()


def test_log_terms_add_up_to_the_reward(tmp_path):
    run = experiment(tmp_path / "run")
    batch = Rollout(run.rollout.env, run.learner.policy, 40).collect()
    terms = sum(batch["next", "info", "reward", term] for term in ("finish", "crash", "cone", "smooth", "alive"))
    torch.testing.assert_close(terms, batch["next", "reward"])
