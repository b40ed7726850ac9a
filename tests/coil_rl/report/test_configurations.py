"""Test of runs with one label and different configurations."""

import json
from dataclasses import replace

import pytest
from run_folders import driven, make_run

from coil_rl.measures import Measure
from coil_rl.report.configurations import (
    distinguish,
    of_several_conditions,
    of_several_definitions,
    of_several_envs,
)
from coil_rl.report.runs import read_runs

CASES = {"a": 1.0, "b": 2.0}


@pytest.fixture
def runs(tmp_path):
    """Return what makes two runs of one label, seeds 0 and 1, with changes of their settings."""

    def make(*changes):
        for seed, change in enumerate(changes):
            folder = make_run(tmp_path / str(seed), "coil", seed, driven("coil", CASES))
            config = json.loads((folder / "config.yaml").read_text())
            (folder / "config.yaml").write_text(json.dumps(config | change))
        return read_runs([tmp_path])

    return make


def labels(runs):
    return [run.label for run in distinguish(runs)[0]]


@pytest.mark.parametrize(
    ("one", "two", "names"),
    [
        ({"learner": {"gamma": 0.9}}, {"learner": {"gamma": 0.99}}, "learner.gamma"),
        ({"env": {"id": "A"}}, {"env": {"id": "B"}}, "env.id"),
        ({"budget": {"frames": 10}}, {"budget": {"frames": 20}}, "budget.frames"),
        ({"guide": {"a": {"x": 1}}}, {"guide": {}}, "guide.a.x"),
        ({"env": {"first_seed": 5}}, {"env": {"first_seed": 6}}, "env.first_seed"),
        ({"observes": ["a"]}, {"observes": ["a", "b"]}, "observes"),
        ({"learner": {"normalise": False}}, {"learner": {"normalise": True}}, "learner.normalise"),
        ({"disturb": {"lag": 0}}, {"disturb": {"lag": 1}}, "disturb.lag"),
        ({"init": None}, {"init": "policy.pt"}, "init"),
    ],
)
def test_runs_that_differ_are_divided_and_the_key_is_named(runs, one, two, names):
    read = runs(one, two)
    divided, sentences = distinguish(read)
    assert len({run.label for run in divided}) == 2
    assert all(run.label.startswith("coil (") and names in run.label for run in divided)
    assert names in sentences[0]
    for run in divided:
        assert set(run.evaluation["driver"]) == {run.label}


@pytest.mark.parametrize(
    ("one", "two"),
    [
        ({}, {}),
        ({"learner": {"seed": 0}}, {"learner": {"seed": 1}}),
        ({"learner": {"random_state": 0}}, {"learner": {"random_state": 1}}),
        ({"run_dir": "a", "existing": "refuse"}, {"run_dir": "b", "existing": "resume"}),
        ({"device": "cpu", "threads": 1}, {"device": "cuda", "threads": 4}),
        ({"logger": {"a": 1}}, {"logger": None}),
        ({"guide": {"run": "x/coil_seed0"}}, {"guide": {"run": "x/coil_seed1"}}),
        ({"proxy": {"folder": "a"}}, {"proxy": {"folder": "b"}}),
    ],
)
def test_runs_that_differ_in_their_seed_only_are_pooled(runs, one, two):
    assert labels(runs(one, two)) == ["coil", "coil"]


def test_keys_of_a_label_tell_the_runs_apart(runs):
    env = dict.fromkeys("abcd", 1)
    of_two = [env, env | {"network": "gru"}, dict.fromkeys("abcd", 2), {"guide": "x", "a": 3}]
    found = labels(runs(*of_two))
    assert len({label.partition(": ")[2] for label in found}) == 4
    assert "network=gru" in found[1]


def test_runs_in_several_envs_are_said(runs):
    read = runs({"env": {"id": "A"}, "label": "a"}, {"env": {"_target_": "my.B"}, "label": "b"})
    assert of_several_envs(read) == [
        "The runs are in 2 envs (A, my.B): compare those of one env only."
    ]
    assert of_several_envs(read[:1]) == []


def test_many_differences_are_numbered(runs):
    one, two = (dict.fromkeys("abcde", seed) for seed in (5, 7))
    divided, sentences = distinguish(runs(one, two))
    assert [run.label for run in divided] == [
        "coil (1: a=5, b=5, c=5, ...)",
        "coil (2: a=7, b=7, c=7, ...)",
    ]
    assert "a, b, c and 2 more" in sentences[0]


@pytest.mark.parametrize(
    ("one", "two"), [("a" * 60 + "x", "a" * 60 + "y"), (3, "3"), (None, "null")]
)
def test_values_that_look_alike_are_numbered(one, two, runs):
    found = labels(runs({"of": one}, {"of": two}, {"of": one}))
    assert found[0] == found[2] != found[1]
    assert [label.partition(": ")[0] for label in found[:2]] == ["coil (1", "coil (2"]


def test_only_the_policy_of_a_label_is_renamed(tmp_path):
    for seed in range(2):
        drivers = ("guide", "g", "g or guide")
        rows = [row for driver in drivers for row in driven(driver, CASES)]
        folder = make_run(tmp_path / str(seed), "g", seed, rows)
        config = json.loads((folder / "config.yaml").read_text())
        (folder / "config.yaml").write_text(json.dumps(config | {"budget": {"frames": seed + 5}}))
    run = distinguish(read_runs([tmp_path]))[0][0]
    assert list(run.evaluation["driver"].unique()) == ["guide", run.label, f"{run.label} or guide"]


@pytest.mark.parametrize(
    ("other", "names"),
    [
        ({"evaluation": {"env": {"first_seed": 5}}}, "evaluation.env.first_seed"),
        ({"env": {"kwargs": {"hard": True}}, "budget": {"frames": 3}}, "env.kwargs, budget.frames"),
        ({"disturb": {"late": {"steps": 1}}}, "disturb.late.steps"),
        ({"track": {"test": "hard"}}, "track.test"),
        ({"evaluation": {"repeats": 5}}, "evaluation.repeats"),
        ({"observes": ["observation", "task"]}, "observes"),
    ],
)
def test_runs_under_other_conditions_are_said(other, names, runs):
    base = {"env": {"id": "A", "kwargs": {}}, "budget": {"frames": 2}, "disturb": {}}
    base |= {"observes": ["observation"]}
    read = runs(base | {"label": "a"}, base | {"label": "b"} | _inside(base, other))
    (sentence,) = of_several_conditions(read)
    assert all(name in sentence for name in names.split(", "))
    assert of_several_conditions(read[:1]) == []


def _inside(base, other):
    """Return what changes in a configuration, with the rest of each group."""
    groups = {key: base.get(key, {}) | value for key, value in other.items() if key != "observes"}
    return other | groups


def test_what_experiments_compare_is_no_other_condition(runs):
    one = {"label": "a", "env": {"id": "A", "num_envs": 4, "seed": 0}, "guide": {"x": 1}}
    two = {"label": "b", "env": {"id": "A", "num_envs": 8, "seed": 1}, "guide": {"x": 2}}
    more = [
        {"degrade": name, "learner": {"rate": name}, "method": {"needs_guide": True}}
        for name in ("none", "zeroed")
    ]
    assert of_several_conditions(runs(one | more[0], two | more[1])) == []


def test_measure_of_two_definitions_is_said(runs):
    speed = Measure("v", title="speed")
    ways = [speed, replace(speed, title="v"), replace(speed, reduction="max")]
    read = [
        replace(run, measures={"speed": way})
        for run, way in zip(runs(*({"label": label} for label in "abc")), ways, strict=True)
    ]
    assert of_several_definitions(read) == [
        "The measure speed is defined in 2 ways (by a and c): compare its numbers of one "
        "definition only."
    ]
    assert of_several_definitions(read[:2]) == []
