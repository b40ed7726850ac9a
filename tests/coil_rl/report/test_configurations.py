"""Test of runs with one label and different configurations."""

from dataclasses import replace

import pytest
from run_folders import driven, make_run

from coil_rl.measures import Measure
from coil_rl.report.configurations import (
    LONGEST_NAME,
    by_test,
    distinguish,
    of_several_conditions,
    of_several_definitions,
)
from coil_rl.report.runs import read_runs

CASES = {"a": 1.0, "b": 2.0}


@pytest.fixture
def runs(tmp_path):
    """Return what makes two runs of one label, seeds 0 and 1, with changes of their settings."""

    def make(*changes):
        for seed, settings in enumerate(changes):
            rows = driven("coil", CASES)
            make_run(tmp_path / str(seed), "coil", seed, rows, settings=settings)
        return read_runs([tmp_path])

    return make


def typed(run, *words):
    """Return a run with the words of its command."""
    return replace(run, command=["coil-train", *words, f"seed={run.seed}"])


def labels(runs):
    return [run.label for run in distinguish(runs)[0]]


@pytest.mark.parametrize(
    ("one", "two", "names"),
    [
        ({"guide": {"a": {"x": 1}}}, {"guide": {}}, "guide.a.x"),
        ({"env": {"first_seed": 5}}, {"env": {"first_seed": 6}}, "env.first_seed"),
        ({"observes": ["a"]}, {"observes": ["a", "b"]}, "observes"),
        ({"learner": {"normalise": False}}, {"learner": {"normalise": True}}, "learner.normalise"),
        ({"disturb": {"lag": 0}}, {"disturb": {"lag": 1}}, "disturb.lag"),
        ({"init": None}, {"init": "policy.pt"}, "init"),
        ({"budget": {"frames": 10}}, {"budget": {"frames": 20}}, "budget.frames"),
        ({}, {}, None),
        ({"learner": {"seed": 0}}, {"learner": {"seed": 1}}, None),
        ({"learner": {"random_state": 0}}, {"learner": {"random_state": 1}}, None),
        ({"run_dir": "a", "existing": "refuse"}, {"run_dir": "b", "existing": "resume"}, None),
        ({"device": "cpu", "threads": 1}, {"device": "cuda", "threads": 4}, None),
        ({"logger": {"a": 1}}, {"logger": None}, None),
        ({"guide": {"run": "x/coil_seed0"}}, {"guide": {"run": "x/coil_seed1"}}, None),
        ({"proxy": {"folder": "a"}}, {"proxy": {"folder": "b"}}, None),
    ],
)
def test_runs_that_differ_in_more_than_their_seed_are_divided_and_the_key_is_named(
    runs, one, two, names
):
    read = runs(one, two)
    divided, rows = distinguish(read)
    if names is None:
        assert [run.label for run in divided] == ["coil", "coil"]
        return
    assert [run.label for run in divided] == ["coil 1", "coil 2"]
    assert [row["name"] for row in rows] == ["coil 1", "coil 2"]
    assert all(names in row["differs"] for row in rows)
    for run in divided:
        assert set(run.evaluation["driver"]) == {run.label}


def test_what_differs_tells_the_runs_apart(runs):
    env = dict.fromkeys("abcd", 1)
    of_two = [env, env | {"network": "gru"}, dict.fromkeys("abcd", 2), {"guide": "x", "a": 3}]
    _, rows = distinguish(runs(*of_two))
    assert len({row["differs"] for row in rows}) == 4
    assert "network=gru" in rows[1]["differs"]


def test_only_what_somebody_typed_is_said(runs):
    learner = {"lr": 1e-3, "gamma": 0.9, "buffer": {"size": 5}}
    read = runs({"learner": {"lr": 3e-4}}, {"learner": learner}, {"learner": learner | {"lr": 0.1}})
    words = ([], ["learner=sac", "label=x", "hydra.run.dir=x"], ["learner=sac", "learner.lr=0.1"])
    read = [typed(run, *of_run) for run, of_run in zip(read, words, strict=True)]
    assert [row["differs"] for row in distinguish(read)[1]] == [
        "learner.lr=0.0003",
        "learner=sac, learner.lr=0.001",
        "learner=sac, learner.lr=0.1",
    ]


def test_many_differences_that_nobody_typed_are_a_few(runs):
    one, two = (dict.fromkeys("abcde", seed) for seed in (5, 7))
    _, rows = distinguish(runs(one, two))
    assert [row["differs"] for row in rows] == ["a=5, b=5, c=5, ...", "a=7, b=7, c=7, ..."]


@pytest.mark.parametrize(
    ("one", "two"), [("a" * 60 + "x", "a" * 60 + "y"), (3, "3"), (None, "null")]
)
def test_values_that_look_alike_are_two_names(one, two, runs):
    found = labels(runs({"of": one}, {"of": two}, {"of": one}))
    assert found == ["coil 1", "coil 2", "coil 1"]


def test_labels_are_short_and_different(runs):
    long = "a" * 40
    given = [long, f"{long}b", f"{long}c", "coil", "coil 1", "coil"]
    changes = [{"label": label, "of": label * (index == 5)} for index, label in enumerate(given)]
    divided, rows = distinguish(runs(*changes))
    found = [run.label for run in divided]
    assert len(set(found)) == len(given)
    assert max(map(len, found)) <= LONGEST_NAME
    assert found[3:] == ["coil 2", "coil 1", "coil 3"]
    assert rows[1]["differs"] == f"of {long}b"


def test_cases_belong_to_their_env(runs):
    a, other = {"env": {"id": "A", "num_envs": 4}}, {"env": {"_target_": "my.B"}}
    late = {"env": {"id": "A", "num_envs": 8}, "disturb": {"late": {"steps": 1}}}
    envs, rows = by_test(runs(a, a | {"label": "b"}, other, late))
    found = {name: [run.seed for run in of_env] for name, of_env in envs.items()}
    assert found == {"A 1": [0, 1], "A 2": [3], "B": [2]}
    assert [row["differs"] for row in rows] == ["disturb.late.steps=null", "disturb.late.steps=1"]


def test_env_of_a_module_has_its_own_name_and_words_of_no_test_are_left_out(runs):
    one = {"env": {"id": "plants.tanks:Tank", "size": 1}, "learner": {"gamma": 0.9}}
    read = runs(one, {"env": {"id": "plants.tanks:Tank", "size": 2}})
    words = (["env.size=1", "learner.gamma=0.1"], ["env.size=2", "learner.gamma=0.2"])
    envs, rows = by_test([typed(run, *of_run) for run, of_run in zip(read, words, strict=True)])
    assert list(envs) == ["Tank 1", "Tank 2"]
    assert [row["differs"] for row in rows] == ["env.size=1", "env.size=2"]


def test_only_the_policy_of_a_label_is_renamed(tmp_path):
    for seed in range(2):
        drivers = ("guide", "g", "g or guide")
        rows = [row for driver in drivers for row in driven(driver, CASES)]
        make_run(tmp_path / str(seed), "g", seed, rows, settings={"budget": {"frames": seed}})
    run = distinguish(read_runs([tmp_path]))[0][0]
    assert list(run.evaluation["driver"].unique()) == ["guide", run.label, f"{run.label} or guide"]


@pytest.mark.parametrize(
    ("other", "name"),
    [
        ({"budget": {"frames": 3}}, "budget.frames"),
        ({"evaluation": {"repeats": 5}}, "evaluation.repeats"),
        ({"observes": ["observation", "task"]}, "observes"),
    ],
)
def test_runs_under_other_conditions_are_said(other, name, runs):
    base = {"env": {"id": "A"}, "budget": {"frames": 2}, "observes": ["observation"]}
    read = runs(base | {"label": "a"}, base | {"label": "b"} | other)
    (sentence,) = of_several_conditions(read)
    assert name in sentence
    assert of_several_conditions(read[:1]) == []
    assert len(by_test(read)[0]) == 1


def test_what_experiments_compare_is_no_other_condition_or_test(runs):
    one = {"label": "a", "env": {"id": "A", "num_envs": 4, "seed": 0}, "guide": {"x": 1}}
    two = {"label": "b", "env": {"id": "A", "num_envs": 8, "seed": 1}, "guide": {"x": 2}}
    more = [
        {"degrade": name, "learner": {"rate": name}, "method": {"needs_guide": True}}
        for name in ("none", "zeroed")
    ]
    read = runs(one | more[0], two | more[1])
    assert of_several_conditions(read) == []
    assert list(by_test(read)[0]) == ["A"]


def test_measure_of_two_definitions_is_said(runs):
    speed = Measure("v", title="speed")
    ways = [speed, replace(speed, title="v"), replace(speed, reduction="max")]
    read = [
        replace(run, measures={"speed": way})
        for run, way in zip(runs(*({"label": label} for label in "abc")), ways, strict=True)
    ]
    (sentence,) = of_several_definitions(read)
    assert sentence.startswith("The measure speed is defined in 2 ways (by a and c)")
    assert of_several_definitions(read[:2]) == []
