"""Driving the runs of the delay experiment: by seed, side by side, with the lags of the table."""

import pytest
from programs import called

from benchmarks import delay

pytestmark = pytest.mark.slow
SMALL = ["env.time_limit=2", "budget.frames=256", "budget.num_envs=8", "budget.steps=16"]
SMALL += ["budget.minibatches=2", "evaluation.curve.points=1", "evaluation.curve.num_envs=2"]
SMALL += ["track.test.count=2", "logger=none"]
COUNT = 2


def rewards(result):
    return [row["reward"] for row in result.episodes]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two seeds of PPO with exact views."""
    path = tmp_path_factory.mktemp("delay")
    words = ["+experiment=robot_delay", "method=ppo", "disturb=[]", "seed=0,1"]
    called("train", "-m", *words, *SMALL, f"hydra.sweep.dir={path}", cwd=path)
    return path


@pytest.fixture(scope="module")
def labels(folder):
    return delay.runs_by_label(folder)


def test_runs_are_grouped_by_label_in_the_order_of_their_seeds(labels, folder):
    names = ["ppo_intact_exact_seed0", "ppo_intact_exact_seed1"]
    assert labels == {"ppo_intact_exact": [folder / name for name in names]}


def test_policies_side_by_side_drive_as_each_alone(labels):
    (folders,) = labels.values()
    together = delay.driven(folders, (1, 1), 0.1, COUNT)
    for result, folder in zip(together, folders, strict=True):
        (alone,) = delay.driven([folder], (1, 1), 0.1, COUNT)
        assert rewards(result) == pytest.approx(rewards(alone), abs=1e-5)


def test_late_view_changes_the_drive_and_no_delay_is_the_exact_view(labels):
    (folders,) = labels.values()
    run = delay.late_run(folders[0], (0, 0), 0.0, COUNT)
    (exact,) = delay.driven(folders[:1], (0, 0), 0.0, COUNT)
    (late,) = delay.driven(folders[:1], (2, 2), 0.0, COUNT)
    run.make_env.disturb = lambda cases: []
    env = run.trial.env(COUNT)
    undisturbed = run.trial.evaluation.run(env, run.policy(env))
    assert rewards(exact) == pytest.approx(rewards(undisturbed), abs=1e-5)
    assert rewards(late) != pytest.approx(rewards(exact), abs=1e-5)


def test_table_has_the_guide_and_each_label_at_each_delay(labels):
    rows = list(delay.rows_of(labels, COUNT))
    assert len(rows) == 2 * len(delay.MISSING) * len(delay.LAGS)
    assert {row["label"]: row["seeds"] for row in rows} == {"guide": 1, "ppo_intact_exact": 2}
    for row in rows:
        counts = [int(count) for count in row["by_seed"].split()]
        assert row["crashed"] == pytest.approx(sum(counts) / (COUNT * row["seeds"]))
