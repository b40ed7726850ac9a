"""Runs that tune a guide: a pendulum whose guide swings it up with too small a gain."""

import json
import shutil

import pytest
import torch
from programs import LAP, called, read_csv

from coil_rl import LearnedGuide, open_run
from coil_rl.report.runs import read_runs
from coil_rl.run.parts import TEST
from coil_rl.tune.search import BEST, MEAN, OWN, Number, Tuner, chosen

pytest.importorskip("gymnasium.envs.classic_control")
SMALL = [
    "method=tune",
    "logger=none",
    "evaluation.gif=false",
    "evaluation.cases=4",
    "evaluation.curve.num_envs=2",
    "evaluation.curve.points=2",
]
SLOW_SWING = [
    "env=pendulum",
    "env.max_steps=60",
    "+guide.swing_up.options.gain=0.05",
    "tune={gain: [0.02, 10, log]}",
    "budget.frames=6000",
]


def tuned(folder, *overrides, code=0):
    words = [*SMALL, *overrides, f"hydra.run.dir={folder}"]
    return called("train", *words, cwd=folder.parent, code=code)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tuning") / "run"
    tuned(folder, *SLOW_SWING)
    return folder


def mean_rewards(run):
    """Return the mean rewards by driver, which are the last of its rows."""
    return {row["driver"]: float(row["reward"]) for row in read_csv(run / "evaluation.csv")}


@pytest.mark.slow
def test_tuned_guide_is_better_on_cases_that_the_search_did_not_see(run):
    rewards = mean_rewards(run)
    assert rewards["tune"] > rewards["guide"] + 10
    assert json.loads((run / "tuned.json").read_text())["gain"] > 0.1


@pytest.mark.slow
def test_every_step_is_a_frame_and_frames_are_bounded(run):
    rows = read_csv(run / "metrics.csv")
    frames = [int(row["frames"]) for row in rows]
    assert frames == sorted(frames)
    assert frames[0] == 0
    assert 4000 < frames[-1] <= 6000
    assert all(row["frames"] == row["frames/tests"] for row in rows)
    assert int(rows[-1]["guide/calls"]) >= frames[-1]


@pytest.mark.slow
def test_budget_that_is_too_small_for_a_generation_and_its_test_is_said(tmp_path):
    folder = tmp_path / "run"
    tuned(folder, *SLOW_SWING, "budget.frames=300")
    taken = int(read_csv(folder / "metrics.csv")[-1]["frames"])
    assert taken > 300
    sentence = f"The search took {taken:,} frames, more than budget.frames=300"
    assert sentence in (folder / "evaluation.md").read_text()


@pytest.mark.slow
def test_run_is_read_by_reports_with_its_curve(run):
    [found] = read_runs([run])
    assert found.finished
    assert (found.label, found.handed_over) in [("tune", "tuned"), ("tune", "best_candidate")]
    returns = [row["evaluation/return"] for row in found.curve]
    assert returns[0] == pytest.approx(found.guide_returns["guide"])
    assert returns[-1] > returns[0]


@pytest.mark.slow
def test_noise_of_a_case_is_the_same_for_all_numbers(tmp_path):
    words = [*SLOW_SWING, "disturb=[observation_noise]", "disturb.observation_noise.sigma=0.3"]
    tuned(tmp_path / "run", *words, "budget.frames=3000")
    [found] = read_runs([tmp_path / "run"])
    own = found.curve[0]["evaluation/return"]
    assert own == pytest.approx(found.guide_returns["guide"])  # which acts alone in its rows


@pytest.mark.slow
def test_tuned_guide_is_a_guide_that_acts_as_the_policy_of_its_run(run):
    opened = open_run(run)
    of_run = opened.evaluate().groupby("driver")["reward"].last()
    evaluation, guides = opened.trial.evaluation, {"learned": LearnedGuide(str(run))}
    result = evaluation.run(*opened.make_env.guided(len(evaluation.cases), TEST, guides))
    assert result.mean_reward == pytest.approx(of_run["tune"])


@pytest.mark.slow
def test_policy_may_be_anchored_at_a_tuned_guide(run, tmp_path):
    folder = tmp_path / "anchored"
    words = ["method=coil_anchored", "guide=learned", f"guide.learned.run={run}", *SMALL[1:]]
    words += ["budget={frames: 1000, num_envs: 2, steps: 50, minibatches: 2}"]
    called("train", "env=pendulum", "env.max_steps=60", *words, f"hydra.run.dir={folder}")
    [start, *_] = read_csv(folder / "metrics.csv")
    assert float(start["start/guide"]) > -600


@pytest.mark.slow
def test_interrupted_search_ends_with_the_same_files(run, tmp_path, monkeypatch):
    generation = Tuner.generation

    def interrupted(self):
        if len(self.told) == 2:
            raise KeyboardInterrupt
        return generation(self)

    monkeypatch.setattr(Tuner, "generation", interrupted)
    tuned(tmp_path / "run", *SLOW_SWING, code=130)
    monkeypatch.undo()
    called("train", f"resume={tmp_path / 'run'}")
    for file in ("metrics.csv", "tuned.json", "delivery.json", "evaluation.csv"):
        assert (tmp_path / "run" / file).read_text() == (run / file).read_text(), file


@pytest.mark.slow
def test_run_that_is_made_longer_searches_on(run, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    before = read_csv(tmp_path / "run" / "metrics.csv")
    called("train", f"resume={tmp_path / 'run'}", "budget.frames=10000")
    after = read_csv(tmp_path / "run" / "metrics.csv")
    frames = [int(row["frames"]) for row in after]
    assert len(after) > len(before)
    assert frames == sorted(frames)


@pytest.mark.slow
def test_other_numbers_in_the_file_are_refused(run, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    (tmp_path / "run" / "tuned.json").write_text('{"gain": 1000}')
    done = called("evaluate", f"run={tmp_path / 'run'}", cwd=tmp_path, code=2)
    assert "gain is not between 0.02 and 10" in done.stderr


@pytest.mark.slow
def test_number_beyond_its_bounds_is_kept_where_nothing_is_better(tmp_path):
    run = tmp_path / "run"
    words = ["env=mountain_car", "env.max_steps=150", "tune={power: [-1, -0.5]}"]
    tuned(run, *words, "budget.frames=8000")
    assert json.loads((run / "tuned.json").read_text()) == {"power": 1.0}
    assert json.loads((run / "delivery.json").read_text())["policy"] == "guide"


@pytest.mark.slow
def test_weights_of_a_rule_with_choices_are_tuned(tmp_path):
    run = tmp_path / "run"
    tuned(
        run,
        "env=cart_pole",
        "+guide.linear_feedback.options.weights=[0.0, 0.0, 1.0, 0.0]",
        "tune={weights.1: [-1, 1], weights.3: [-1, 1]}",
        "env.max_steps=100",
        "budget.frames=6000",
    )
    rewards = mean_rewards(run)
    assert rewards["tune"] > 90 > rewards["guide"]


@pytest.mark.slow
def test_spline_guide_is_tuned_side_by_side_in_one_env(tmp_path):
    run = tmp_path / "run"
    tuned(
        run,
        *LAP,
        "guide=undertuned",
        "env.time_limit=6",
        "training.tests.time_limit=3",
        "training.tests.starts=20",
        "tune={gain: [0.1, 2]}",
        "budget.frames=1500",
        "method.run.cases=8",
        "evaluation.curve.env.time_limit=1",
        "evaluation.pictures={}",
    )
    assert json.loads((run / "tuned.json").read_text())["gain"] > 0.3


@pytest.mark.slow
def test_candidates_of_a_generation_act_in_the_same_cases_side_by_side_or_in_turn(run):
    beside, in_turn = (open_run(run).training(0).tuner for _ in range(2))
    in_turn.cases.can_copy = lambda: False
    values = [{"gain": 0.05}, {"gain": 1.0}, {"gain": 0.05}]
    first, second = beside.returns(values, 3), in_turn.returns(values, 3)
    assert torch.equal(first[0], first[2])
    assert not torch.equal(first[0], first[1])
    assert torch.allclose(torch.stack(first), torch.stack(second))


def test_own_numbers_are_kept_unless_others_are_clearly_better():
    own = torch.tensor([1.0, 2.0, 3.0, 4.0])
    noise = torch.tensor([0.5, -0.5, 0.6, -0.4])
    assert chosen({OWN: own, MEAN: own, BEST: own - 1}) == OWN
    assert chosen({OWN: own, MEAN: own + noise, BEST: own}) == OWN
    assert chosen({OWN: own, MEAN: own + 1, BEST: own + 2}) == BEST


def test_places_of_numbers_go_there_and_back():
    whole = Number("horizon", 1, 9, own=5, whole=True)
    assert (whole.value(0.0), whole.value(0.49), whole.value(1.0)) == (1.0, 5.0, 9.0)
    log = Number("kp", 0.01, 100, own=1, log=True)
    assert log.value(0.6) == 2.51189  # as it is printed
    assert Number("kd", 0, 1.23456789, own=1).value(1.0) == 1.23456789
    assert (log.place(1.0), log.place(0.001), log.place(1000)) == (pytest.approx(0.5), 0.0, 1.0)
