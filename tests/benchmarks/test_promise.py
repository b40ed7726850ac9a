"""The table of the promise: its verdicts, and a run of one arm."""

import json
import math

import pandas as pd
import pytest
from programs import TINY_ARM, called, composed, shipped
from run_folders import driven, make_run

from benchmarks import prediction, promise
from coil_rl.config.check import check
from coil_rl.errors import UserError
from coil_rl.report.runs import read_runs

pytest.importorskip("gymnasium.envs.classic_control")


@pytest.mark.parametrize(
    ("mean", "low", "high", "expected"),
    [
        (-5, -8, -2, "loss"),
        (-0.9, -1.5, -0.1, "even"),
        (-5, -12, 2, "even"),
        (5, 2, 8, "gain"),
        (0.5, 0.1, 0.9, "even"),
        (-50, math.nan, math.nan, "unknown"),
        (math.nan, math.nan, math.nan, "unknown"),
    ],
)
def test_verdict_needs_an_interval_and_a_material_mean(mean, low, high, expected):
    assert promise.verdict(mean, low, high) == expected


def test_unknown_verdicts_are_counted_only_if_there_are_any():
    assert promise.counted_verdicts(["gain", "even", "even"]) == (
        "1 gains, 2 even (undecided), 0 losses"
    )
    assert promise.counted_verdicts(["unknown", "loss"]) == (
        "0 gains, 0 even (undecided), 1 unknown, 1 losses"
    )


def small(folder, arms, seeds=1):
    """Write runs of a task by the returns of their arms, with the guide at 100."""
    for arm, reward in arms.items():
        for seed in range(seeds):
            rows = driven("guide", {"a": 100.0, "b": 100.0})
            rows += driven(arm, {"a": reward, "b": 20.0})
            make_run(folder / f"{arm}_{seed}", arm, seed, rows)
    return folder


def rows_of(runs, parts=None):
    """Return the rows of a task, compared with the learner that is best alone."""
    arms = promise.arms_of(runs)
    return promise.rows_of_task("task", arms, promise.best_alone(arms), parts)


def test_one_seed_has_no_verdict(tmp_path):
    small(tmp_path / "task", {"ppo_alone": 10.0, "coil_intact": 5.0, "coil_random": 5.0})
    (row, _) = rows_of(read_runs([tmp_path / "task"]))
    assert row["verdict"] == "unknown"
    assert "0 even (undecided), 2 unknown, 0 losses." in called("promise", tmp_path).stdout


def test_task_whose_random_guide_is_as_good_as_the_better_has_no_verdict(tmp_path):
    arms = {"ppo_alone": 10.0, "coil_intact": 5.0, "coil_random": 5.0}
    rows = rows_of(read_runs([small(tmp_path, arms, seeds=2)]))
    assert [row["verdict"] for row in rows] == ["unknown", "unknown"]


def test_reward_that_is_nan_is_no_part_of_a_mean(tmp_path):
    small(tmp_path / "task", {"ppo_alone": math.nan, "coil_intact": 5.0}, seeds=2)
    said = called("promise", tmp_path, code=2).stderr
    assert "the reward of ppo_alone is nan in 1 of 2 cases" in said


@pytest.mark.parametrize(
    ("label", "cases", "settings", "seed", "message"),
    [
        ("coil_intact", "ab", {}, 0, "are both coil_intact with seed 0; remove one of them"),
        ("coil_intact", "cd", {}, 2, "has other cases than .*; train the runs of a task with the"),
        ("coil_intact", "ab", {"budget": {"frames": 9}}, 2, "differ in budget.frames; keep those"),
        ("sac_intact", "ab", {}, 2, "sac_intact has no seed of ppo_alone; train both"),
    ],
    ids=["seed twice", "cases", "configuration", "no common seed"],
)
def test_runs_that_cannot_be_compared_are_refused(label, cases, settings, seed, message, tmp_path):
    small(tmp_path, {"ppo_alone": 10.0, "coil_intact": 5.0}, seeds=2)
    rows = [row for who in ("guide", label) for row in driven(who, dict.fromkeys(cases, 9))]
    make_run(tmp_path / "further", label, seed, rows, settings=settings)
    with pytest.raises(UserError, match=message):
        rows_of(read_runs([tmp_path]))


def test_all_columns_are_of_the_seeds_that_ppo_has_too(tmp_path):
    small(tmp_path, {"ppo_alone": 10.0}, seeds=2)
    for seed in range(5):
        rows = driven("guide", {"a": 100.0 + seed, "b": 100.0})
        rows += driven("coil_intact", {"a": 5.0 + seed, "b": 5.0})
        make_run(tmp_path / str(seed), "coil_intact", seed, rows)
    (row,) = rows_of(read_runs([tmp_path]))
    assert (row["seeds"], row["guide"], row["alone"], row["end"]) == (2, 100.25, 15.0, 5.25)


def test_of_several_guides_and_learners_alone_the_best_ones_are_compared(tmp_path):
    arms = {"ppo_alone": 10.0, "sac_alone": 400.0, "coil_intact": 90.0, "coil_random": 5.0}
    rows = rows_of(read_runs([small(tmp_path / "learners", arms, seeds=2)]))
    assert [(row["learner"], row["alone"], row["guide"]) for row in rows] == [("sac", 210, 100)] * 2
    assert rows[0]["difference"] == pytest.approx(100 * (55 - 210) / (210 - 100))
    small(tmp_path / "guides", {"ppo_alone": 10.0})
    rows = driven("guide x", {"a": 500.0, "b": 500.0}) + driven("guide y", {"a": 5.0, "b": 5.0})
    rows += driven("coil_intact", {"a": 90.0, "b": 90.0})
    make_run(tmp_path / "guides" / "two", "coil_intact", 0, rows)
    (row,) = rows_of(read_runs([tmp_path / "guides"]))
    assert row["guide"] == 500


@pytest.mark.parametrize(
    ("arms", "message"),
    [
        (None, "does not exist; give the folder of the experiments"),
        ({}, "has no task with plain PPO; train it: +arm=alone method=ppo"),
        ({"coil_intact": 5.0}, "has no task with plain PPO; train it: +arm=alone method=ppo"),
        ({"ppo_alone": 5.0}, "has no run with a guide; train it"),
    ],
    ids=["no folder", "empty folder", "no PPO", "only PPO"],
)
def test_folder_without_results_is_one_sentence(arms, message, tmp_path):
    folder = tmp_path / "promise"
    if arms is not None:
        folder.mkdir()
        small(folder / "task", arms) if arms else None
    assert message in called("promise", folder, code=2).stderr
    assert not list(tmp_path.rglob("promise.*"))


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped("settings/zoo"))
def test_published_settings_are_those_of_a_run_of_their_task(name, tmp_path):
    task, _, learner = name.rpartition("_")
    if task == "swimmer":
        pytest.importorskip("mujoco")
    words = ["+experiment=promise", f"+task={task}", "+arm=alone", f"+settings=zoo/{name}"]
    config = composed(*words, f"run_dir={tmp_path}")
    check(config)
    assert config.label == f"{learner}_zoo_alone"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two seeds of three arms of one task."""
    path = tmp_path_factory.mktemp("promise")
    words = ["+experiment=promise", "+task=pendulum", "+arm=alone,intact,random", "seed=0,1"]
    small = ["env.max_steps=15", *TINY_ARM, f"hydra.sweep.dir={path}"]
    called("train", "-m", *words, *small, cwd=path)
    return path


@pytest.mark.slow
def test_table_compares_each_arm_with_the_better_of_guide_and_learning_alone(folder):
    runs = read_runs([folder / "pendulum"])
    intact, random = rows_of(runs)
    assert [intact["arm"], random["arm"]] == ["intact", "random"]
    assert intact["alone"] == random["alone"]
    assert intact["guide"] > intact["alone"], "so the guide is what it is compared with"
    scale = intact["guide"] - random["guide"]
    expected = 100 * (intact["end"] - intact["guide"]) / scale
    assert intact["difference"] == pytest.approx(expected)
    own = [run for run in runs if run.label == "coil_anchored_intact"]
    shares = [run.curve[-1]["frames/tests"] / run.curve[-1]["frames"] for run in own]
    assert intact["tests"] == pytest.approx(100 * max(shares))
    for run in own:
        delivered = json.loads((run.folder / "delivery.json").read_text())
        assert delivered["policy"] in intact["handed_over"]


@pytest.mark.slow
def test_program_writes_the_table(folder):
    out = called("promise", folder).stdout
    page = (folder / "promise.md").read_text()
    assert page in out
    assert "gains," in page
    assert (folder / "promise.csv").exists()
    runs = pd.read_csv(folder / "promise_runs.csv")
    assert len(runs) == 6
    assert runs.groupby("method").fingerprint.nunique().to_dict() == {"ppo": 1, "coil_anchored": 2}
    assert "others" not in page


@pytest.mark.slow
def test_seeds_that_confirm_have_a_column_of_their_own(folder):
    runs = read_runs([folder / "pendulum"])
    rows = rows_of(runs, {"claimed": range(1), "others": range(1, 9)})
    scale = rows[0]["guide"] - rows[1]["guide"]
    for column, seed in (("claimed", 0), ("others", 1)):
        intact = promise.arms_of(runs)["coil_anchored", "intact"]
        expected = 100 * (intact.reward(seed) - intact.guide) / scale
        assert rows[0][column].startswith(f"{expected:+.1f} (")
    rows = rows_of(runs, {"claimed": range(2), "others": range(2, 9)})
    assert rows[0]["others"] == ""
    assert f"{rows[0]['difference']:+.1f}" in rows[0]["claimed"]


@pytest.mark.slow
def test_what_could_predict_a_gain_stands_beside_it(folder, capsys):
    prediction.main([str(folder), "--method", "coil_anchored", "--learner", "ppo"])
    assert "residual: rank correlation" in capsys.readouterr().out
    runs = read_runs([folder / "pendulum"])
    arms = promise.arms_of(runs)
    rows = prediction.rows_of_task("pendulum", runs, "coil_anchored", "ppo")
    for row in rows:
        arm, alone = arms["coil_anchored", row["guide"]], arms["ppo", "alone"]
        gain = sum(arm.reward(seed) - alone.reward(seed) for seed in (0, 1)) / 2
        assert row["gain"] == pytest.approx(100 * gain / promise.scale_of(arms, alone))
        assert row["residual"] <= 1
    assert rows[0]["ahead"] > rows[1]["ahead"]  # the intact guide, the random one
