import math

import pytest
from run_folders import driven, make_run, make_sweep

from coil_rl.errors import UserError
from coil_rl.report.comparison import compare
from coil_rl.report.runs import read_runs

TRACKS = {"a": 500.0, "b": 600.0}


def rows_of(folder, against=None, actions="deterministic"):
    rows = compare(read_runs([folder]), actions).table(against)
    return {(row["driver"], row["advice"]): row for row in rows}


@pytest.fixture
def sweep(tmp_path):
    return make_sweep(tmp_path / "sweep")


def test_guide_comes_first_then_the_best_and_altered_advice_below_its_agent(sweep):
    rows = rows_of(sweep)
    assert list(rows) == [("guide", ""), ("ppo", ""), ("coil", ""), ("coil", "zeroed")]
    assert [row["seeds"] for row in rows.values()] == [None, 3, 3, 3]
    assert [row["needs_guide"] for row in rows.values()] == [None, False, True, None]


def test_numbers_are_those_of_the_runs(sweep):
    rows = rows_of(sweep, against="ppo")
    coil, zeroed = rows["coil", ""], rows["coil", "zeroed"]
    assert coil["mean"] == pytest.approx(571)
    assert coil["iqm"] == pytest.approx((0.5 * 521 + 522 + 620 + 0.5 * 621) / 3)
    assert coil["low"] < coil["iqm"] < coil["high"]
    assert (coil["smoothness"], coil["lap_time"], coil["completed"]) == (pytest.approx(0.2), 50, 1)
    assert (zeroed["crashed"], zeroed["completed"]) == (1, 0)
    assert math.isnan(zeroed["lap_time"])
    assert math.isnan(rows["guide", ""]["low"])
    assert (coil["improvement"], rows["guide", ""]["improvement"], rows["ppo", ""]["improvement"]) == (0, 0, None)


def test_improvement_can_be_over_each_ones_own_guide(sweep):
    rows = rows_of(sweep, against="guide")
    assert [row["improvement"] for row in rows.values()] == [None, 1, 1, 0]


def test_sampled_actions_are_a_comparison_of_their_own(sweep):
    rows = rows_of(sweep, "ppo", "sampled")
    assert list(rows) == [("guide", ""), ("coil", ""), ("ppo", "")]
    assert rows["coil", ""]["mean"] == pytest.approx(561)
    assert rows["coil", ""]["improvement"] == 0.5, "better on a, worse on b"


def test_smallest_clearance_and_laps_that_were_driven_count(tmp_path):
    make_run(tmp_path / "0", "coil", 0, driven("guide", TRACKS) + driven("coil", TRACKS, clearance=0.2))
    slow = driven("coil", TRACKS, lap_time=math.nan, clearance=0.05, completed=0.0)
    make_run(tmp_path / "1", "coil", 1, driven("guide", TRACKS) + slow)
    row = rows_of(tmp_path)["coil", ""]
    assert (row["clearance"], row["lap_time"], row["completed"]) == (0.05, 50, 0.5)


def test_guides_that_differ_get_rows_with_the_labels_they_belong_to(tmp_path):
    worse = {track: reward - 100 for track, reward in TRACKS.items()}
    for place, label in enumerate(["a", "b", "c", "d", "e"]):
        guide = driven("guide", worse if label == "e" else TRACKS)
        make_run(tmp_path / str(place), label, 0, guide + driven(label, {"a": 550.0 - place, "b": 0.0}))
    rows = rows_of(tmp_path)
    assert list(rows)[:3] == [("guide (a, b and 2 more)", ""), ("guide (e)", ""), ("a", "")]
    assert rows["e", ""]["guide"] == "guide (e)"
    assert rows["guide (e)", ""]["mean"] == pytest.approx(450)


def test_a_guide_that_draws_has_an_interval_over_its_different_drives(tmp_path):
    for place, (label, seed) in enumerate([("coil", 0), ("coil", 1), ("coil", 2), ("ppo", 0), ("ppo", 1)]):
        guide = driven("guide", {track: reward + 10 * seed for track, reward in TRACKS.items()})
        make_run(tmp_path / str(place), label, seed, guide + driven(label, TRACKS))
    guide = rows_of(tmp_path)["guide", ""]
    assert guide["seeds"] == 3, "ppo has two of the three drives"
    assert guide["mean"] == pytest.approx(560)
    assert guide["low"] < guide["iqm"] < guide["high"]


def test_track_table_has_the_mean_of_each_track(sweep):
    rows = compare(read_runs([sweep])).track_table()
    found = {(row["driver"], row["advice"], row["track"]): row["reward"] for row in rows}
    assert len(found) == 8
    assert found["coil", "", "b"] == pytest.approx(621)


def test_guides_alone_can_be_compared(tmp_path):
    make_run(tmp_path / "0", "spline", 0, driven("guide", TRACKS), needs_guide=None)
    make_run(tmp_path / "1", "zero", 0, driven("guide", {"a": 1.0, "b": 2.0}), needs_guide=None)
    assert list(rows_of(tmp_path)) == [("guide (spline)", ""), ("guide (zero)", "")]


def test_agents_may_drive_without_a_guide_beside_them(tmp_path):
    make_run(tmp_path / "0", "alone", 0, driven("alone", TRACKS), needs_guide=False)
    make_run(tmp_path / "1", "coil", 0, driven("guide", TRACKS) + driven("coil", {"a": 1.0, "b": 2.0}))
    rows = rows_of(tmp_path, against="guide")
    assert list(rows) == [("guide", ""), ("alone", ""), ("coil", "")]
    assert (rows["alone", ""]["guide"], rows["alone", ""]["improvement"], rows["alone", ""]["seeds"]) == (None, None, 1)
    assert rows["coil", ""]["improvement"] == 0


def test_the_same_seed_twice_is_refused(tmp_path):
    for name in ("one", "two"):
        make_run(tmp_path / name, "coil", 7, driven("guide", TRACKS) + driven("coil", TRACKS))
    with pytest.raises(UserError, match=r"one and .*two are both seed 7 of coil; take one out"):
        compare(read_runs([tmp_path]))


def test_seeds_on_different_tracks_are_refused(tmp_path):
    for seed, track in enumerate("ab"):
        make_run(tmp_path / track, "coil", seed, driven("guide", {"a": 1.0}) + driven("coil", {track: 1.0}))
    with pytest.raises(UserError, match=r"runs of coil drove different tracks \(a, and b\)"):
        compare(read_runs([tmp_path]))


def test_labels_on_different_tracks_are_not_said_to_improve(tmp_path):
    for label in "ab":
        make_run(tmp_path / label, label, 0, driven("guide", {label: 1.0}) + driven(label, {label: 1.0}))
    assert rows_of(tmp_path, against="b")["a", ""]["improvement"] is None
    assert len(compare(read_runs([tmp_path])).guides) == 2


def test_several_guides_are_rows_of_their_own_and_the_best_is_the_line_to_beat(tmp_path):
    good, bad = driven("guide spline", TRACKS), driven("guide random", {track: -100.0 for track in TRACKS})
    make_run(tmp_path / "multi", "multi", 0, bad + good + driven("multi", TRACKS))
    make_run(tmp_path / "other", "other", 0, good + driven("other", TRACKS))
    rows = rows_of(tmp_path)
    assert list(rows) == [("guide spline", ""), ("guide random", ""), ("multi", ""), ("other", "")]
    assert rows["multi", ""]["guide"] == rows["other", ""]["guide"] == "guide spline"
