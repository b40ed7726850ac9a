from dataclasses import replace
from itertools import pairwise

import pytest
from omegaconf import OmegaConf
from programs import composed, read_csv

from coil_rl.config.assemble import trial
from coil_rl.config.parts import (
    build_evaluation,
    build_learner,
    build_pictures,
    env_maker,
    recorded,
)
from coil_rl.errors import UserError
from coil_rl.report.pictures import Picture
from coil_rl.run.folder import is_evaluated
from coil_rl.run.judge import judge, report_outcome
from coil_rl.run.reasons import about_returns

PLAIN = ["evaluation.repeats=1", "evaluation.gif=false"]


def configured(*overrides):
    return composed("env.time_limit=1", "guide=[spline,random]", "run_dir=unused", *overrides)


def evaluated(config):
    return trial(config, env_maker(config)).guide_results(build_evaluation(config))


@pytest.mark.slow
@pytest.mark.parametrize("change", ["evaluation.repeats=2", "degrade=delayed", "env.time_limit=2"])
def test_guides_beside_an_agent_drive_as_they_do_alone(change, tmp_path):
    config = configured("guide=[spline,centre_fast]", *PLAIN, change)
    make_env = env_maker(config)
    policy = build_learner(config, make_env()).policy
    judge(trial(config, make_env), policy, tmp_path, seed=0)
    rows = read_csv(tmp_path / "episodes.csv")
    beside = [float(row["reward"]) for row in rows if row["driver"].startswith("guide")]
    results = evaluated(config).values()
    assert beside == [episode["reward"] for result in results for episode in result.episodes]
    assert len(set(beside)) == 6


def test_evaluation_has_the_cases_and_measures_of_the_env_and_the_entries_of_its_pictures():
    config = configured()
    evaluation = build_evaluation(config, recorded(build_pictures(config)))
    assert evaluation.cases == ["test_1", "test_2", "test_3"]
    assert list(evaluation.measures) == list(config.evaluation.measures)
    assert evaluation.record == {"pose": ("info", "pose")}
    config = configured("guide=spline")
    (result,) = trial(config, env_maker(config)).guide_results(evaluation).values()
    assert [episode["case"] for episode in result.episodes] == evaluation.cases
    assert len(result.histories["pose"]) == 3


def with_cases(config, cases):
    OmegaConf.update(config, "evaluation.cases", cases, merge=False)
    return config


@pytest.mark.parametrize(("cases", "names"), [(3, ["0", "1", "2"]), (["one", 2], ["one", "2"])])
def test_cases_are_a_number_or_names(cases, names):
    assert build_evaluation(with_cases(configured(), cases)).cases == names


@pytest.mark.parametrize("cases", [0, -1, [], "abc", 1.5, None])
def test_evaluation_without_cases_is_refused(cases):
    with pytest.raises(UserError, match=r"evaluation\.cases=.* must be at least 1, or the names"):
        build_evaluation(with_cases(configured(), cases))


def test_case_cannot_be_called_like_the_row_of_the_means():
    with pytest.raises(UserError, match=r"evaluation\.cases: a case cannot be called mean"):
        build_evaluation(with_cases(configured(), ["a", "mean"]))


def test_guides_without_a_guide_are_not_driven():
    assert evaluated(configured("guide=none", "method=ppo")) == {}


class Broken(Picture):
    """A picture whose env draws no pixels, or that cannot be drawn."""

    def __init__(self, place):
        self.place, self.seen = place, 0

    watches = True

    def watch(self, env, rows, before, after):
        self.seen += 1
        if self.place == "watch":
            raise TypeError("render() returns floats")

    def draw(self, results, folder):
        assert (folder / "evaluation.md").exists()
        assert not is_evaluated(folder), "a run that is killed here draws when it goes on"
        if self.place == "draw":
            raise ValueError("no frames")
        (folder / "drawn").touch()


@pytest.mark.fast(1)
@pytest.mark.parametrize("place", ["watch", "draw"])
def test_results_are_complete_without_a_picture_that_fails(tmp_path, place):
    config = configured("guide=spline", "evaluation.repeats=1")
    make_env = env_maker(config)
    broken, intact = Broken(place), Broken("nowhere")
    given = replace(trial(config, make_env), pictures=[broken, intact])
    with pytest.warns(UserWarning, match="the picture Broken.* is left out"):
        judge(given, build_learner(config, make_env()).policy, tmp_path, seed=0)
    assert {"evaluation.csv", "evaluation.md", "episodes.csv", "drawn"} <= {
        path.name for path in tmp_path.iterdir()
    }
    assert intact.seen > 1
    assert (broken.seen == 1) == (place == "watch")


def test_results_are_complete_where_an_env_fails_with_random_actions(tmp_path, monkeypatch):
    config = configured("guide=spline", *PLAIN)
    make_env = env_maker(config)

    def fails(*_, **__):
        raise RuntimeError("the plant has tripped")

    monkeypatch.setattr(type(make_env), "plain", fails)
    with pytest.warns(UserWarning, match="comparison with the guide is left out .*has tripped"):
        judge(trial(config, make_env), build_learner(config, make_env()).policy, tmp_path, seed=0)
    assert "Not worse" not in (tmp_path / "evaluation.md").read_text()
    assert (tmp_path / "evaluation.csv").exists()


def test_mean_over_fewer_episodes_is_told_on_the_page_and_in_the_table(tmp_path):
    config = configured("guide=spline", *PLAIN)
    make_env = env_maker(config)
    given = replace(trial(config, make_env), pictures=[])
    judgement = judge(given, None, tmp_path, seed=0)
    known = [count["lap_time"] for count in judgement.counts]
    assert known == [0, 0, 0, 0]  # no lap is finished in a second
    assert "of 3)" not in (tmp_path / "evaluation.md").read_text()
    assert "lap_time_episodes" in (tmp_path / "evaluation.csv").read_text()


def test_curve_of_an_own_env_rests_on_20_cases_that_the_table_has_not():
    config = composed("env=pendulum", "guide=none", "method=ppo", "run_dir=unused")
    sizes = env_maker(config).sizes
    assert min(sizes.values()) >= 20
    (_, sentence) = about_returns(sizes)
    assert "on 20 cases, and the best policy of a report is chosen in 20 others" in sentence
    curve = config.evaluation.curve
    firsts = [config.evaluation.env.first_seed, *(each.first_seed for each in curve.cases.values())]
    firsts.sort()
    assert all(later - first >= 20 for first, later in pairwise(firsts))


@pytest.mark.parametrize("label", ["mine", "mine or guide"])
def test_outcome_is_that_of_the_policy_without_its_fallback(label, tmp_path):
    rows = [("guide", 9.0), (label, 5.0), (f"{label} or guide", 7.0)]
    lines = [f"{driver},,deterministic,mean,{reward}" for driver, reward in rows]
    table = ["driver,advice,actions,case,reward", *lines]
    (tmp_path / "evaluation.csv").write_text("\n".join(table))
    (tmp_path / "evaluation.md").write_text("The page.")
    assert report_outcome(tmp_path) == 5.0
