import math

import pytest
from run_folders import driven, make_run, make_sweep

from coil_rl.errors import UserError
from coil_rl.report.comparison import compare, paired
from coil_rl.report.runs import read_runs

CASES = {"a": 500.0, "b": 600.0}


def run_of(folder, label, seed=0, rewards=CASES, guide=CASES, **measures):
    """Write a run of a policy and its guide."""
    rows = driven("guide", guide) + driven(label, rewards, **measures)
    make_run(folder / f"{label}{seed}", label, seed, rows)


def table(folder, against=None, actions="deterministic"):
    rows = compare(read_runs([folder]), actions).table(against)
    return {(row["driver"], row["advice"]): row for row in rows}


def groups_by_title(folder):
    comparison = compare(read_runs([folder]))
    return {group.title: group for group in (*comparison.guides, *comparison.agents)}


@pytest.fixture
def sweep(tmp_path):
    return make_sweep(tmp_path / "sweep")


# The other numbers of a sweep are those of the page, see test_page.
def test_policies_are_better_than_the_guide_or_with_sampled_actions_than_another(sweep):
    assert [row["better"] for row in table(sweep, against="guide").values()] == [None, 1, 1, 0]
    rows = table(sweep, "ppo", "sampled")
    assert list(rows) == [("guide", ""), ("coil", ""), ("ppo", "")]
    assert math.isnan(rows["guide", ""]["low"])
    assert rows["coil", ""]["reward"] == pytest.approx(561)
    assert rows["coil", ""]["better"] == 0.5, "better on a, worse on b"


def test_completion_ranks_before_the_mean(tmp_path):
    run_of(tmp_path, "fast", rewards={"a": 900.0, "b": 900.0}, completed=0.9, crashed=0.1)
    run_of(tmp_path, "safe")
    assert list(table(tmp_path)) == [("guide", ""), ("safe", ""), ("fast", "")]


def test_clearance_is_the_smallest_and_lap_time_the_mean_of_completed_laps(tmp_path):
    run_of(tmp_path, "coil", 0, clearance=0.2)
    run_of(tmp_path, "coil", 1, lap_time=math.nan, clearance=0.05, completed=0.0)
    row = table(tmp_path)["coil", ""]
    assert (row["clearance"], row["lap_time"], row["completed"]) == (0.05, 50, 0.5)


def test_labels_are_appended_to_guides_of_the_same_name(tmp_path):
    worse = {case: reward - 100 for case, reward in CASES.items()}
    for index, label in enumerate("abcde"):
        rewards = {"a": 550.0 - index, "b": 0.0}
        run_of(tmp_path, label, rewards=rewards, guide=worse if label == "e" else CASES)
    rows = table(tmp_path)
    assert list(rows)[:3] == [("guide (a, b and 2 more)", ""), ("guide (e)", ""), ("a", "")]
    assert rows["e", ""]["guide"] == "guide (e)"
    assert rows["guide (e)", ""]["reward"] == pytest.approx(450)


def guides_of_labels():
    """Yield returns of the guides of some labels by case, and the names of the different guides."""
    for unit in (1e-9, 1e-4, 1.0, 1e6):
        of_a, of_b, of_c = 3.0 * unit, 4.0 * unit, 3.0 * unit * (1 + 1e-9)
        yield [{"a": of_a, "b": -0.0}, {"a": of_b, "b": 0.0}, {"a": of_c, "b": 0.0}], ["a, c", "b"]
    for centre in (0.0, 1e6):
        # On both sides of any limit of a rounded number; b is another guide by a thousandth.
        yield (
            [{"a": centre + 500.00049 + more, "b": centre - 100.0} for more in (0.0, 0.6, 2e-3)],
            ["a, c", "b"],
        )
    yield [{"a": -100.0, "b": -110.0}, {"a": -130.0, "b": -110.0}], ["a", "b"]
    diverged = [{"a": each, "b": -110.0} for each in (-100.0, -130.0, -5e6)]
    yield diverged, ["a", "b", "c"]
    yield [{"x": 600.0}, {"x": 601.0}, {"x": 600.001}], ["a, c", "b"]
    yield [{"a": 500.0, "b": math.nan}] * 2, [None]


@pytest.mark.parametrize(("guides", "expected"), list(guides_of_labels()))
@pytest.mark.parametrize("last", [1.0, -5e6], ids=["", "beside a policy that diverged"])
def test_guides_are_told_apart_by_their_returns(guides, expected, last, tmp_path):
    for label, cases in zip("abc", guides, strict=False):
        returns = dict.fromkeys(cases, last if label == "c" else 1.0)
        run_of(tmp_path, label, rewards=returns, guide=cases)
    found = [group.title for group in compare(read_runs([tmp_path])).guides]
    names = [f"guide ({labels})" if labels else "guide" for labels in expected]
    assert sorted(found) == names


def test_guide_with_random_actions_has_an_interval_over_its_different_evaluations(tmp_path):
    for label, seed in [("ppo", 0), ("ppo", 1), ("coil", 0), ("coil", 1), ("coil", 2)]:
        guide = {case: reward + 10 * seed for case, reward in CASES.items()}
        run_of(tmp_path, label, seed, guide=guide)
    guide = table(tmp_path)["guide", ""]
    assert guide["seeds"] == 3, "ppo has two of the three evaluations"
    assert guide["reward"] == pytest.approx(560)
    assert guide["low"] < guide["reward"] < guide["high"]


def test_guide_with_random_actions_is_paired_with_the_policy_of_its_run(tmp_path):
    losses = {("coil", 3): -5.0, ("coil", 1): -7.0, ("coil", 2): -9.0, ("ppo", 1): 4.0}
    for index, ((label, seed), gain) in enumerate(losses.items()):
        guide = {case: -reward - 100 * seed for case, reward in CASES.items()}
        agent = {case: reward + gain for case, reward in guide.items()}
        rows = [*driven("guide", guide), *driven(label, agent), *driven(f"{label} or guide", agent)]
        make_run(tmp_path / str(index), label, seed, rows)
    make_run(tmp_path / "9", "ppo", 9, driven("ppo", CASES))
    rows = table(tmp_path, against="guide")
    for driver in ("coil", "coil or guide"):
        found = rows[driver, ""]
        assert found["difference"] == pytest.approx(-7)
        assert found["p"] == pytest.approx(0.0523, abs=1e-4), "of a t test, for two rows"
        assert (found["difference_seeds"], found["better"]) == (3, 0)
    ppo = rows["ppo", ""]
    assert ppo["difference"] == pytest.approx(4)
    assert (ppo["seeds"], ppo["difference_seeds"]) == (2, 1), "seed 9 has no guide"
    assert math.isnan(rows["guide", ""]["difference"])


def test_agents_and_guides_may_be_alone(tmp_path):
    make_run(tmp_path / "agents" / "0", "alone", 0, driven("alone", CASES), needs_guide=False)
    row = table(tmp_path / "agents", against="guide")["alone", ""]
    assert (row["guide"], row["better"], row["seeds"]) == (None, None, 1)
    for label, cases in {"spline": CASES, "zero": {"a": 1.0, "b": 2.0}}.items():
        make_run(tmp_path / "guides" / label, label, 0, driven("guide", cases), needs_guide=None)
    assert list(table(tmp_path / "guides")) == [("guide (spline)", ""), ("guide (zero)", "")]


def test_best_of_several_guides_is_the_reference(tmp_path):
    good, bad = driven("guide spline", CASES), driven("guide random", {"a": -100.0, "b": -100.0})
    make_run(tmp_path / "multi", "multi", 0, bad + good + driven("multi", CASES))
    make_run(tmp_path / "other", "other", 0, good + driven("other", CASES))
    rows = table(tmp_path)
    assert list(rows) == [("guide spline", ""), ("guide random", ""), ("multi", ""), ("other", "")]
    assert rows["multi", ""]["guide"] == rows["other", ""]["guide"] == "guide spline"


def test_label_with_the_same_seed_twice_or_with_different_cases_is_an_error(tmp_path):
    for name in ("one", "two"):
        run_of(tmp_path / "same" / name, "coil", 7)
    with pytest.raises(UserError, match=r"coil7 and .*coil7 are both seed 7 of coil; remove one"):
        compare(read_runs([tmp_path / "same"]))
    for seed, case in enumerate("ab"):
        run_of(tmp_path / "other", "coil", seed, {case: 1.0}, {"a": 1.0})
    with pytest.raises(UserError, match=r"runs of coil .* in different cases \(a, and b\)"):
        compare(read_runs([tmp_path / "other"]))


def test_labels_in_different_cases_are_not_compared(tmp_path):
    for label in "ab":
        run_of(tmp_path, label, rewards={label: 1.0}, guide={label: 1.0})
    assert table(tmp_path, against="b")["a", ""]["better"] is None
    groups = groups_by_title(tmp_path)
    assert paired(groups["a"], groups["b"]) is None
    assert set(groups) == {"a", "b", "guide (a)", "guide (b)"}


def test_pairs_are_the_common_seeds_in_any_order(tmp_path):
    for index, seed in enumerate([2, 0, 1]):
        make_run(tmp_path / f"a{index}", "a", seed, driven("a", {"x": 10.0 * seed, "y": 5.0}))
    for seed in (1, 2, 3):
        make_run(tmp_path / f"b{seed}", "b", seed, driven("b", {"x": 10.0 * seed - 4, "y": 5.0}))
    groups = groups_by_title(tmp_path)
    pairs = paired(groups["a"], groups["b"])
    assert pairs.difference[:4] == (2, 2, 2, 2), "4 more on x and equal on y, for both seeds"
    assert pairs.better == 0.75
    assert paired(groups["b"], groups["a"]).difference.mean == -2


def test_guide_is_paired_with_every_seed(sweep, tmp_path):
    groups = groups_by_title(sweep)
    pairs = paired(groups["coil"], groups["guide"])
    assert (pairs.difference.seeds, pairs.better) == (3, 1)
    assert pairs.difference.mean == pytest.approx(21)
    assert paired(groups["coil"], groups["ppo"], "smoothness").difference.mean == pytest.approx(0.1)
    assert paired(groups["coil, zeroed"], groups["coil"], "lap_time") is None, "no completed lap"
    make_run(tmp_path / "other" / "9", "coil", 9, driven("coil", CASES))
    coil = groups_by_title(tmp_path / "other")["coil"]
    assert paired(coil, groups["ppo"]) is None, "no common seed"


def test_policy_whose_return_is_no_number_is_last_and_has_no_difference(tmp_path):
    for label, rewards in {"a": {"x": 30.0, "y": math.nan}, "b": {"x": 1.0, "y": 1.0}}.items():
        for seed in range(2):
            make_run(tmp_path / f"{label}{seed}", label, seed, driven(label, rewards))
    rows = table(tmp_path, against="b")
    assert list(rows) == [("b", ""), ("a", "")]
    row = rows["a", ""]
    assert math.isnan(row["reward"])
    assert math.isnan(row["difference"])
    assert row["better"] is None


def test_policy_with_a_fallback_is_a_row_of_its_own(tmp_path):
    for seed in range(2):
        rows = [
            *driven("guide", CASES),
            *driven("coil", {"a": 510.0, "b": 610.0}),
            *driven("coil", {"a": 5.0, "b": 6.0}, advice="zeroed"),
            *driven("coil or guide", {"a": 520.0, "b": 620.0}),
        ]
        make_run(tmp_path / str(seed), "coil", seed, rows)
    rows = table(tmp_path, against="coil")
    assert list(rows) == [("guide", ""), ("coil or guide", ""), ("coil", ""), ("coil", "zeroed")]
    assert rows["coil or guide", ""]["reward"] == pytest.approx(570)
    assert rows["coil or guide", ""]["better"] == 1
