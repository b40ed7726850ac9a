import math

import pytest
from worlds import driving_measures

from coil_rl.measures import (
    Measure,
    denominators,
    measures_of,
    summarise,
    with_denominators,
)


def test_measure_of_a_yaml_file_has_tuples_as_keys():
    node = {
        "entry": ["info", "lap_time"],
        "where": ["info", "task", "left"],
        "reduction": "max",
        "title": "lap (s)",
    }
    expected = Measure(("info", "lap_time"), "max", ("info", "task", "left"), title="lap (s)")
    assert measures_of({"lap": node}) == {"lap": expected}
    assert Measure.of("reward") == Measure("reward", "mean")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"reduction": "median"}, "reduction=median must be one of mean, sum, min, max, last, any"),
        ({"at_least": 1.0, "at_most": 2.0}, "at_least and at_most cannot both be given; give one"),
        ({"reduction": "any", "at_least": 3.0}, "reduction=any is a flag without bounds"),
        ({"reduction": "any", "at_most": 3.0}, "write max with at_least, min with at_most"),
    ],
)
def test_unknown_reduction_and_bounds_without_a_meaning_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Measure("reward", **options)


@pytest.mark.parametrize(
    ("reduction", "pooled"),
    [
        ("mean", 3.0),
        ("sum", 3.0),
        ("last", 3.0),
        ("count", 3.0),
        ("mean_nonzero", 3.0),
        ("min", 1.0),
        ("max", 6.0),
    ],
)
def test_episodes_are_pooled_without_nan_by_their_mean_or_extreme(reduction, pooled):
    assert Measure("x", reduction).pool([2.0, math.nan, 1.0, 6.0]) == pooled
    assert math.isnan(Measure("x", reduction).pool([math.nan, math.nan]))
    assert math.isnan(Measure("x", reduction).pool([]))


@pytest.mark.parametrize(
    "measure",
    [
        Measure("x", "any"),
        *(Measure("x", reduction, at_least=1.0) for reduction in ("last", "min", "max")),
        Measure("x", "max", at_most=1.0),
    ],
)
def test_flags_are_pooled_to_the_share_of_episodes(measure):
    assert measure.pool([True, False, False, True, True]) == 0.6


def test_summary_is_the_mean_over_cases_of_means_over_episodes():
    def episode(case, reward, lap_time, crashed):
        return {
            "case": case,
            "reward": reward,
            "lap_time": lap_time,
            "crashed": crashed,
            "clearance": reward / 100,
            "steps": 7,
            "not measured": 1,
        }

    measures = {name: driving_measures()[name] for name in ("lap_time", "crashed", "clearance")}
    episodes = [
        episode("a", 10, 5.0, False),
        episode("b", 40, math.nan, True),
        episode("a", 20, math.nan, True),
    ]
    rows = summarise(episodes, measures)
    assert list(rows[0]) == ["case", "reward", "lap_time", "crashed", "clearance"]
    assert [row["case"] for row in rows] == ["a", "b", "mean"]
    assert [row["reward"] for row in rows] == [15, 40, 27.5]
    assert rows[0]["lap_time"] == rows[2]["lap_time"] == 5
    assert math.isnan(rows[1]["lap_time"])
    assert [row["crashed"] for row in rows] == [0.5, 1, 0.75]
    assert [row["clearance"] for row in rows] == [0.1, 0.4, 0.1]


def test_episodes_of_a_mean_over_fewer_are_counted():
    measures = {"lap_time": Measure("lap"), "speed": Measure("speed")}
    lap_times = [5.0, math.nan, 7.0, math.nan]
    episodes = [
        {"case": case, "reward": 1.0, "lap_time": lap_time, "speed": 2.0}
        for case, lap_time in zip("aabb", lap_times, strict=True)
    ]
    rows, counts = summarise(episodes, measures), denominators(episodes, measures)
    assert [count["lap_time"] for count in counts] == [1, 1, 2]
    full = with_denominators(rows, counts)
    assert list(full[0]) == [*rows[0], "episodes", "lap_time_episodes"]
    assert (full[-1]["episodes"], full[-1]["lap_time_episodes"]) == (4, 2)
    complete = [{**episode, "lap_time": 1.0} for episode in episodes]
    rows, counts = summarise(complete, measures), denominators(complete, measures)
    assert with_denominators(rows, counts) == rows


def test_mean_over_cases_counts_a_measure_by_the_episodes_that_have_it():
    lap_times = {"a": [5.0, math.nan, math.nan], "b": [7.0, 7.0, 7.0]}
    episodes = [
        {"case": case, "reward": 1.0, "lap_time": lap_time}
        for case, numbers in lap_times.items()
        for lap_time in numbers
    ]
    *_, mean = summarise(episodes, {"lap_time": Measure("lap")})
    assert mean["lap_time"] == pytest.approx((5 + 7 + 7 + 7) / 4)
