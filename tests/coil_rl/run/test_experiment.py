import math
import re

import pytest
import torch
from programs import read_csv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torchrl.envs import Transform
from torchrl.record.loggers import TensorboardLogger

from coil_rl.envs import ConeTrackEnv, shipped_tracks
from coil_rl.errors import UserError
from coil_rl.guides import RandomGuide, SplineGuide, SplineMemoryGuide
from coil_rl.learners import PPO
from coil_rl.learners.anchor import Anchor
from coil_rl.run import checkpoint
from coil_rl.run.metrics import Metrics
from coil_rl.run.parts import TESTS, TRAIN, EnvMaker
from coil_rl.run.run import Budget, Run
from coil_rl.run.stopping import STOP
from coil_rl.transforms import GuideActions

WATCH = {"episode": {"crashed": ["info", "crashed"]}, "step": {"cone": ["info", "reward", "cone"]}}


def experiment(
    folder, seed=0, frames=16 * 8 * 4, guide=SplineGuide, extra=(), anchor=None, identity=None
):
    def bare(rows, cases, count):
        if cases == TRAIN:
            return ConeTrackEnv(shipped_tracks("train"), 16, seed=seed)
        options = {"rate": 6, "time_limit": 1}
        if cases != TESTS:
            options |= {"assignment": "cyclic"}
        return ConeTrackEnv(shipped_tracks("train" if cases == TESTS else "test"), rows, **options)

    def transforms(advice):
        return [GuideActions({"guide": guide()})]

    def disturb(cases):
        return extra if cases == TRAIN else ()

    def make_learner(env):
        options = {"epochs": 2, "minibatches": 2, "anchor": anchor, "seed": seed}
        return PPO(env, ["observation", "guide_action"], **options)

    torch.manual_seed(seed)
    folder.mkdir(exist_ok=True)
    make_env = EnvMaker(
        bare,
        disturb=disturb,
        transforms=transforms,
        sizes=dict.fromkeys(("evaluation", "selection"), 3),
    )
    budget = Budget(frames, steps=8, points=4, batches=2, checkpoint_every=2)
    options = {"settings": {"label": "ppo"}, "identity": identity or {"label": "ppo"}}
    run = Run(
        folder, make_env, make_learner, None, budget, label="ppo", seed=seed, watch=WATCH, **options
    )
    return run.training(0)


def contents(folder):
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file()
    }


def as_written(rows):
    return str([{name: float(value) for name, value in row.items()} for row in rows])


@pytest.mark.slow
def test_run_writes_its_files_and_a_row_per_update(tmp_path):
    rows = experiment(tmp_path / "run").run()
    names = {"checkpoint.pt", "checkpoint_previous.pt", "metrics.csv", "policy_last.pt"}
    kept = {f"policies/{128 * update:012d}.pt" for update in range(5)}
    assert set(contents(tmp_path / "run")) == names | kept
    written = read_csv(tmp_path / "run" / "metrics.csv")
    assert [row["frames"] for row in rows] == [0, 128, 256, 384, 512]
    assert [float(row["frames"]) for row in written] == [row["frames"] for row in rows]
    assert {"train/return", "train/crashed", "train/cone", "learner/loss_critic"} <= set(written[0])


def test_tests_that_take_all_frames_leave_one_further_update(tmp_path):
    run = experiment(tmp_path / "run")
    run.reserve, run.updates, run.first = lambda: 10**6, 3, {"frames": 0}
    run._plan()
    assert run.all_updates == 4


@pytest.mark.parametrize(
    ("frames", "kept", "message"),
    [
        (512, 0, ""),
        (512, 30, "train: 98 of 512 frames stay unused, "),
        (512, 70, "train: 58 of 512 frames stay unused, "),
        (512, 90, ""),
        (500, 0, ""),
        (50, 0, "train: 78 frames are added to 50, because they are no whole batch of 128; "),
    ],
)
def test_frames_that_are_no_whole_batch_beside_the_tests_are_said(
    tmp_path, capsys, frames, kept, message
):
    run = experiment(tmp_path / "run", frames=frames)  # batches of 128
    run.reserve, run.first = lambda: kept, {"frames": 0}
    run._plan()
    said = capsys.readouterr().err
    assert message in said if message else not said


class Killed(BaseException):
    pass


@pytest.mark.fast("SplineMemoryGuide-learner.update-4-None")
@pytest.mark.parametrize(
    ("guide", "place", "last", "anchor"),
    [
        (RandomGuide, "learner.update", 1, None),
        (RandomGuide, "learner.update", 5, None),
        (SplineMemoryGuide, "learner.update", 4, None),
        (SplineGuide, "learner.update", 4, None),
        (SplineGuide, "learner.update", 1, Anchor()),
        (SplineGuide, "curve.evaluate", 2, None),
        (SplineGuide, "curve.keep", 5, None),  # the last policy of the run
    ],
)
def test_stopped_and_resumed_run_ends_with_the_same_files(
    tmp_path, guide, place, last, anchor, capsys
):
    def make(name, seed=0):
        options = {"guide": guide, "anchor": anchor, "frames": 16 * 8 * 5}
        return experiment(tmp_path / name, seed=seed, **options)

    rows = make("whole").run()
    stopped, calls = make("stopped"), []
    owner, method = place.split(".")
    called = getattr(getattr(stopped, owner), method)

    def dying(*given):
        calls.append(given)
        if len(calls) == last:
            # The first update is interrupted at once if its tests are kept.
            assert owner == "curve" or STOP.ask() == (anchor is None)
            raise Killed
        return called(*given)

    setattr(getattr(stopped, owner), method, dying)
    with pytest.raises(Killed):
        stopped.run()

    # Once there is a checkpoint, nothing may depend on the seed of the second process.
    kept = owner == "curve" or last > 2 or anchor is not None
    again = make("stopped", seed=9 if kept else 0)
    again.resume()
    assert as_written(again.run()) == as_written(rows)
    if owner == "learner":
        there = f"after update {(last - 1) // 2 * 2}" if kept else "from the beginning: there is no"
        assert f"{tmp_path / 'stopped'} continues {there}" in capsys.readouterr().err
    whole, resumed = contents(tmp_path / "whole"), contents(tmp_path / "stopped")
    assert whole.keys() == resumed.keys()
    state = {"checkpoint.pt"} if owner == "learner" else set()
    for name in whole.keys() - {"checkpoint_previous.pt"} - state:
        assert whole[name] == resumed[name], name
    finished = make("stopped", seed=9)
    finished.resume()
    assert as_written(finished.run()) == as_written(rows)
    assert contents(tmp_path / "stopped") == resumed


@pytest.mark.parametrize("continues", [True, False])
def test_learner_forgets_episodes_that_a_resumed_env_cannot_go_on_with(tmp_path, continues):
    stopped, forgotten = experiment(tmp_path), []
    stopped.update(0.0)
    stopped.save()
    again = experiment(tmp_path)
    again.metrics.truncate = lambda count: None
    again.rollout.base_env.continues = continues
    again.learner.begin_episodes = lambda: forgotten.append(True)
    again.resume()
    assert bool(forgotten) != continues


def test_checkpoint_of_another_run_is_refused(tmp_path):
    def resumed(**identity):
        experiment(tmp_path, frames=16 * 8, identity=identity).resume()

    checkpoint.save_newest({"policy": 1}, tmp_path)
    with pytest.raises(UserError, match=r"checkpoint\.pt is damaged \(it lacks identity\); put"):
        resumed()
    other = {"identity": {"threads": 1}, "learner": {}}
    checkpoint.save_newest(experiment(tmp_path).state_dict() | other, tmp_path)
    with pytest.raises(UserError, match=r"checkpoint\.pt belongs to a run with threads=1, not 2"):
        resumed(threads=2)
    with pytest.raises(UserError, match=r"checkpoint\.pt is damaged \(it lacks policy\)"):
        resumed(threads=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text.replace(b"128,", b",", 1),
        lambda text: text.replace(b"\n", b"\n\xff", 1),
        lambda text: text.partition(b"\n")[2] * 2,
    ],
    ids=["empty cell", "bytes", "no header"],
)
def test_damaged_log_is_refused(tmp_path, damage):
    experiment(tmp_path, frames=16 * 8 * 2).run()
    log = tmp_path / "metrics.csv"
    log.write_bytes(damage(log.read_bytes()))
    with pytest.raises(UserError, match=r"metrics\.csv is damaged .*; put the whole file back"):
        experiment(tmp_path).resume()


class WriteNaN(Transform):
    """Write NaN into an entry of one car at one step of the run."""

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


# At step 20 the env itself raises an error, because of the NaN; step 24 is the last of a batch.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "step"), [("observation", 20), ("observation", 24), ("reward", 24)]
)
def test_nan_from_the_env_stops_the_run_and_keeps_the_checkpoint(tmp_path, key, step):
    good = experiment(tmp_path / "good", frames=16 * 8 * 2)
    good.run()
    run = experiment(tmp_path / "run", extra=[WriteNaN(key, step, 5)])
    message = f"next/{key} is nan at step {step} of row 5; the last good checkpoint is kept"
    command = re.escape(f"coil-train resume={tmp_path}/run")
    with pytest.raises(UserError, match=f"{message}.*{command}"):
        run.run()
    ours, theirs = (checkpoint.load(tmp_path / name / "checkpoint.pt") for name in ("run", "good"))
    assert ours["updates"] == theirs["updates"] == 2
    assert torch.equal(ours["rollout"]["env"]["pose"], theirs["rollout"]["env"]["pose"])
    corrected = experiment(tmp_path / "run", seed=9, extra=[WriteNaN(key, 0, 5)])
    corrected.resume()
    corrected.run()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("loss", "learner/loss_critic is nan in update 4"),
        ("weight", "learner/critic/.* is nan after update 4"),
    ],
)
def test_nan_in_a_loss_or_a_weight_stops_the_run_and_keeps_the_checkpoint(tmp_path, place, message):
    run = experiment(tmp_path / "run")
    update = run.learner.update

    def write_nan(batch, progress):
        metrics = update(batch, progress)
        if run.updates == 3 and place == "loss":
            return metrics | {"loss_critic": float("nan")}
        if run.updates == 3:
            with torch.no_grad():
                next(iter(run.learner.critic.parameters())).fill_(torch.nan)
        return metrics

    run.learner.update = write_nan
    with pytest.raises(UserError, match=f"{message}; the last good checkpoint is kept"):
        run.run()
    assert checkpoint.load(tmp_path / "run" / "checkpoint.pt")["updates"] == 2
    assert not (tmp_path / "run" / "policy_last.pt").exists()


@pytest.mark.slow
def test_update_without_a_minibatch_may_have_no_loss(tmp_path):
    run = experiment(tmp_path / "run")
    update = run.learner.update

    def without_first(batch, progress):
        loss = {"loss_critic": float("nan")} if run.updates == 0 else {}
        return update(batch, progress) | loss | {"minibatches": float(run.updates)}

    run.learner.update = without_first
    rows = run.run()
    known = [math.isfinite(row["learner/loss_critic"]) for row in rows[1:]]
    assert known == [False] + [True] * (len(rows) - 2)


ROWS = [{"frames": 10 * n, "loss": 1 / n, "return": math.nan} for n in range(1, 6)]


def write_metrics(path, rows, logger=None):
    metrics = Metrics(path, logger)
    for row in rows:
        metrics.append(row)
    return metrics


@pytest.mark.parametrize(
    ("count", "torn"), [(0, b""), (1, b"60,0.1"), (3, b"60,0.1,nan\r\n70"), (5, b"60,0.1")]
)
def test_truncated_metrics_end_like_uninterrupted_ones(tmp_path, count, torn):
    whole, stopped = tmp_path / "whole.csv", tmp_path / "stopped.csv"
    write_metrics(whole, ROWS)
    write_metrics(stopped, ROWS)
    with stopped.open("ab") as file:
        file.write(torn)
    again = Metrics(stopped)
    again.truncate(count)
    assert str(again.rows) == str([{k: float(v) for k, v in row.items()} for row in ROWS[:count]])
    for row in ROWS[count:]:
        again.append(row)
    assert stopped.read_bytes() == whole.read_bytes()


def test_columns_of_the_first_row_decide(tmp_path):
    path = tmp_path / "metrics.csv"
    metrics = write_metrics(path, [{"frames": 0, "loss": 1.0, "kl": 2.0}])
    metrics.append({"kl": 3.0, "loss": 4.0, "frames": 1})
    metrics.append({"frames": 2, "kl": 5.0})
    expected = ["frames,loss,kl", "0,1.0,2.0", "1,4.0,3.0", "2,nan,5.0"]
    assert path.read_text().splitlines() == expected
    with pytest.raises(UserError, match="has no column entropy: the first update did not return"):
        metrics.append({"frames": 3, "entropy": 1.0})
    assert len(path.read_text().splitlines()) == 4


def test_missing_rows_are_refused(tmp_path):
    write_metrics(tmp_path / "metrics.csv", ROWS[:2])
    with pytest.raises(UserError, match="has 2 of the 3 rows that belong to the checkpoint"):
        Metrics(tmp_path / "metrics.csv").truncate(3)


@pytest.mark.parametrize("count", [0, 3])
def test_tensorboard_shows_no_point_twice(tmp_path, count):
    path = tmp_path / "metrics.csv"
    write_metrics(path, ROWS, TensorboardLogger("board", str(tmp_path))).flush()
    again = Metrics(path, TensorboardLogger("board", str(tmp_path)))
    again.truncate(count)
    for row in ROWS[count:]:
        again.append(row)
    again.flush()
    points = EventAccumulator(str(tmp_path / "board")).Reload().Scalars("loss")
    assert [point.step for point in points] == [10, 20, 30, 40, 50]
