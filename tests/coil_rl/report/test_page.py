import math
from pathlib import Path

from run_folders import driven, make_run, make_sweep

from coil_rl.record import UNTESTED
from coil_rl.report import page
from coil_rl.report.comparison import compare
from coil_rl.report.runs import Run, read_runs


def section(folder, against=None):
    comparison = compare(read_runs([folder]))
    return list(map(str, page.section(comparison, against)))


def cells(table):
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in str(table).splitlines()]
    return [lines[0], *lines[2:]]


def test_section_has_a_table_of_drivers_and_one_of_cases(tmp_path):
    drivers, rewards = section(make_sweep(tmp_path / "sweep"), "ppo")
    titles, guide, ppo, coil, zeroed = cells(drivers)
    assert titles[:5] == ["driver", "advice", "seeds", "cases", "completed"]
    assert titles[5:8] == ["seeds with a crash (95 %)", "return (95 %)", "95 % over cases"]
    assert guide[:7] == ["guide", "", "-", "2", "100%", "0 of 2 cases (0% to 84%)", "550.0"]
    assert coil[:7] == [
        "coil",
        "",
        "3",
        "2",
        "100%",
        "0 of 3 (0% to 71%)",
        "571.0 (568.5 to 573.5)",
    ]
    assert " to " in coil[7]
    assert coil[8:11] == ["-20.0 (-20.0 to -20.0)", "< 0.001", "0%"]
    assert coil[11:] == ["50.00", "0.200", "0.30", "yes"]
    assert ppo[8:11] == ["-", "-", "-"]
    assert (ppo[-1], zeroed[:2], zeroed[-1]) == ("no", ["coil", "zeroed"], "-")
    assert zeroed[5] == "3 of 3 (29% to 100%)"
    assert cells(rewards)[0] == ["mean reward", "a", "b"]
    assert cells(rewards)[-1] == ["coil, zeroed", "-100.0 (0% completed)", "-201.0 (0% completed)"]


def test_policies_without_a_common_seed_are_said(tmp_path):
    seeds = {"ppo": (0, 1), "coil": (2, 3), "residual": (1, 2)}
    for label, of_label in seeds.items():
        for seed in of_label:
            rows = driven("guide", {"a": 5.0}) + driven(label, {"a": 2.0 + seed})
            make_run(tmp_path / f"{label}{seed}", label, seed, rows)
    comparison = compare(read_runs([tmp_path]))
    (sentence,) = page.unpaired("ppo", {"deterministic": comparison, "sampled": comparison})
    assert sentence.startswith("No seed in common with ppo: coil.")
    for against in ("residual", "guide", None):
        assert page.unpaired(against, {"deterministic": comparison}) == []


def test_terms_of_the_reward_have_their_own_table(tmp_path):
    """A measure of a user that is called like a term is a column like any other."""
    terms, own = ["reward_left", "reward_right"], ["reward_least", "per_step_cost"]
    measures = {name: {"entry": "reward", "reduction": "sum", "title": ""} for name in terms}
    measures |= {name: {"entry": "reward", "reduction": "min", "format": ".1f"} for name in own}
    for seed, agent in enumerate([(0.5, -0.125, 3.0, 7.0), (0.75, -0.125, 4.0, 8.0)]):
        names = [*terms, *own]
        rows = driven("guide", {"a": 1.0}, **dict(zip(names, (2.0, -1.0, 5.0, 6.0), strict=True)))
        rows += driven("coil", {"a": 2.0}, **dict(zip(names, agent, strict=True)))
        settings = {"evaluation": {"measures": measures}}
        make_run(tmp_path / f"run_{seed}", "coil", seed, rows, settings=settings)
    drivers, table, *_ = section(tmp_path)
    found = [" ".join(row) for row in cells(table)]
    assert found == ["term of the reward left right", "guide 2.00 -1.00", "coil 0.62 -0.12"]
    assert [row[-3:-1] for row in cells(drivers)] == [own, ["5.0", "6.0"], ["3.0", "7.0"]]


def test_returns_of_trained_guides_are_shown_before_and_after():
    def run(label, seed, *returns):
        curve = [{"frames": n, "guide/a": x, "guide/calls": n} for n, x in enumerate(returns)]
        return Run(Path(), label, seed, True, curve=curve)

    found = [run("both", seed, 10.0 + seed, math.nan, 20.0, 40.0 + seed) for seed in range(2)]
    found += [run("one", 0, 1.0, 2.0), run("one", 1, math.nan, math.nan)]
    without = Run(Path(), "one", 2, True, curve=[{"frames": 0.0}, {"frames": 9.0}])
    (table,) = page.guide_training([*found, without])
    both, one = cells(table)[1:]
    assert both == ["both", "2", "10.5 to 40.5"]
    assert one == ["one", "3", "1.00 to 2.00 (1 of 3 seeds)"]
    assert page.guide_training([without]) == []


def test_training_is_summarised_by_the_evaluation_curve(tmp_path):
    rows = driven("any", {"a": 500.0})
    curves = {"late": [0.0, "nan", 100.0, 300.0], "early": [200.0, 250.0, 400.0, 300.0]}
    for label, returns in curves.items():
        folder = make_run(tmp_path / label, label, 0, rows, guide=200.0)
        lines = ["frames,evaluation/return,selection/return"]
        lines += [f"{1000 * n},{x},{x if x == 'nan' else -n}" for n, x in enumerate(returns)]
        (folder / "metrics.csv").write_text("\n".join(lines))
    (tmp_path / "late" / "training_time.json").write_text('{"seconds": 12.4}')
    make_run(tmp_path / "never", "late", 1, rows, guide=1000.0)
    (table,) = page.training(read_runs([tmp_path / "late", tmp_path / "early"]))
    assert cells(table)[1:] == [
        ["early", "1", "3,000", "200.0", "200.0", "0", "300.0", "200.0", "300.0", "-"],
        ["late", "1", "3,000", "200.0", "0.0", "2,500", "100.0", "0.0", "300.0", "12"],
    ]
    table, sentence = page.training(read_runs([tmp_path]))
    assert cells(table)[2][5] == "2,500 (1 of 2 seeds)"
    assert "a run ends with a whole batch" in sentence  # as frames differ


def test_runs_without_a_test_at_their_end_are_counted_apart():
    def sentences(*chosen):
        return page.handed_over([Run(Path(), "any", 0, True, handed_over=name) for name in chosen])

    tested, untested = sentences("last", UNTESTED, "guide", "last", UNTESTED)
    assert tested.endswith(
        "best in a test at their end, whose steps are among their frames: last 2, guide 1."
    )
    assert untested.startswith("Of the runs of any 2 had no frames left for a test")
    assert sentences(UNTESTED, UNTESTED) == [untested]
    assert sentences("last", "last", "guide", "") == [tested]


def test_frames_of_other_runs_are_said():
    """A policy or data to begin with cost frames, which are in no column of this run."""

    def runs(label, *settings):
        return [Run(Path(), label, seed, True, settings=each) for seed, each in enumerate(settings)]

    def begun(*settings):
        """Return what is said of runs of a label, whose seeds are there twice."""
        return page.begun(2 * runs("own", *({"init": name} for name in settings)))

    of_data = runs("data", {"learner": {"dataset": "dataset.pt"}})
    end = ", whose frames are not among theirs."
    assert page.begun(runs("own", {"init": None, "learner": {"dataset": None}})) == []
    assert page.begun([*runs("init", {"init": "outputs/first"}), *of_data]) == [
        f"Runs of init began with the policy of outputs/first{end}",
        f"Runs of data began with the data of dataset.pt{end}",
    ]
    assert begun("a", "b") == [f"Runs of own began with the policy of a, the policy of b{end}"]
    (sentence,) = begun(*"abcde")
    assert sentence.endswith(
        f"with the policy of a, the policy of b, the policy of c and 2 more{end}"
    )


def test_envs_are_counted_by_sign(tmp_path):
    tables = {}
    for env, gain, unit in (("one", 1.0, 1.0), ("other", -1.0, 1e6), ("third", 1.0, 1.0)):
        for seed in range(3):
            agent = {"a": unit * (2 + gain + 0.01 * seed), "b": unit * (3 + gain)}
            rows = driven("guide", {"a": 2 * unit, "b": 3 * unit}) + driven("coil", agent)
            make_run(tmp_path / env / str(seed), "coil", seed, rows)
        tables[env] = compare(read_runs([tmp_path / env])).table("guide")
    (summary,) = page.summary(tables, "guide")
    assert cells(summary)[1] == ["coil", "2", "0", "1"]
    assert page.summary({"one": tables["one"]}, "guide") == []


def test_empty_columns_and_many_cases_are_omitted(tmp_path):
    cases = {f"case_{k}": 1.0 * k for k in range(9)}
    make_run(tmp_path / "run", "coil", 0, driven("guide", cases) + driven("coil", cases))
    text = "\n\n".join(section(tmp_path))
    assert not [word for word in ("advice", "better than") if word in text]
    assert text.endswith("The rewards in each of the 9 cases are in report_cases.csv.")
    assert "Return over" not in page.notes(None, sampled=True)[0]
    assert "Return over its guide: the difference" in page.notes("guide", sampled=True)[0]


def test_means_of_some_seeds_only_say_so(tmp_path):
    for label, seeds in (("coil", 3), ("ppo", 2)):
        for seed in range(seeds):
            rows = driven(label, {"a": 10.0 + seed, "b": 20.0})
            make_run(tmp_path / f"{label}{seed}", label, seed, rows)
    (tmp_path / "coil1" / "training_time.json").write_text('{"seconds": 100}')
    rows = compare(read_runs([tmp_path])).table("ppo")
    assert [row["difference_seeds"] for row in rows if row["driver"] == "coil"] == [2]
    drivers, _ = section(tmp_path, "ppo")
    assert "+0.0 (+0.0 to +0.0) (2 of 3 seeds)" in drivers
    (training,) = page.training(read_runs([tmp_path]))
    assert "100 (1 of 3 seeds)" in str(training)


def test_measure_of_some_episodes_counts_as_often_as_it_is_known(tmp_path):
    rows = driven("coil", {"a": 1.0, "b": 2.0}, "sampled")
    for row, lap, known in zip(rows, (50.0, 80.0, 55.0), (5, 1, 6), strict=True):
        row |= {"lap_time": lap, "episodes": 5 * (1 + (row["case"] == "mean"))}
        row["lap_time_episodes"] = known
    make_run(tmp_path / "0", "coil", 0, rows)
    make_run(tmp_path / "1", "coil", 1, driven("coil", {"a": 1.0, "b": 2.0}, "sampled"))
    comparison = compare(read_runs([tmp_path]), "sampled")
    # The second run has no such columns: all of its ten episodes have a lap.
    row = comparison.table()[0]
    assert row["lap_time"] == (5 * 50 + 80 + 10 * 50) / 16
    assert (row["lap_time_episodes"], row["episodes"]) == (16, 20)
    assert "51.88 (16 of 20)" in str(page.section(comparison, None)[0])
    by_case = {case["case"]: case for case in comparison.case_table()}
    assert [by_case[case]["episodes"] for case in "ab"] == [10, 10]
    assert [by_case[case]["lap_time_episodes"] for case in "ab"] == [10, 6]
    assert by_case["b"]["lap_time"] == (80 + 5 * 50) / 6


def test_case_may_be_called_like_a_column(tmp_path):
    make_run(tmp_path / "0", "coil", 0, driven("coil", {"driver": 1.0, "b": 2.0}))
    assert cells(section(tmp_path)[1]) == [["mean reward", "driver", "b"], ["coil", "1.00", "2.00"]]
