"""Test of guides whose returns differ between runs of one configuration."""

import pytest
from run_folders import driven, make_run

from coil_rl.report import guides
from coil_rl.report.configurations import guide_follows_seed
from coil_rl.report.guides import of_changed_guides, of_guides_of_labels
from coil_rl.report.runs import read_runs


@pytest.fixture
def runs(tmp_path):
    """Return what makes the runs of a label, by seed its guide's return and its settings."""

    def make(of_seeds, label="coil", name="guide", settings=lambda _: {}):
        for seed, reward in of_seeds.items():
            rows = driven(name, {"a": reward, "b": -3.0}) + driven(label, {"a": 1.0, "b": 2.0})
            folder = tmp_path / f"{label}_{seed}"
            make_run(folder, label, seed, rows, settings=settings(seed))
        return read_runs([tmp_path])

    return make


def test_guide_with_other_returns_in_runs_of_one_configuration_is_said(runs):
    runs({0: -14.0, 1: -14.0, 2: -28.0, 3: -28.0})
    (sentence,) = of_changed_guides(runs({0: -14.0, 1: -14.0}, "ppo"))
    assert sentence.startswith("The guide has different returns in the same cases in runs of the s")
    assert "(coil seeds 0, 1 / 2, 3): " in sentence


def test_each_guide_and_each_label_with_such_runs_is_named(runs):
    runs({0: 1.0, 1: 2.0}, name="guide spline")
    runs({0: 1.0, 1: 2.0, 3: 1.0}, "ppo", name="guide spline")
    first, second = of_changed_guides(runs({4: 1.0, 5: 2.0}, "sac"))
    assert "The guide spline has" in first
    assert "(coil seeds 0 / 1; ppo seeds 0, 3 / 1)" in first
    assert "The guide has" in second
    assert "(sac seeds 4 / 5)" in second


def test_evaluations_are_compared_with_those_of_the_same_guide_only(runs, monkeypatch):
    asked = []
    monkeypatch.setattr(guides, "_is_same", lambda *both: asked.append(both) or False)
    for number in range(3):
        found = runs({0: 1.0, 1: 2.0}, f"label{number}", name=f"guide g{number}")
    assert len(of_changed_guides(found)) == 3
    assert len(asked) == 3


def test_many_seeds_are_shortened(runs):
    (sentence,) = of_changed_guides(runs({seed: float(seed) for seed in range(6)}))
    assert "(coil seeds 0 / 1 / 2 and 3 more)" in sentence


def test_equal_guides_and_those_of_other_labels_are_not_accused(runs):
    runs({0: -14.0, 1: -14.000001, 2: -14.0})
    assert of_changed_guides(runs({0: -28.0, 1: -28.0}, "ppo")) == []


@pytest.mark.parametrize(
    ("follows", "settings"),
    [
        (True, lambda seed: {"guide": {"random": {"_target_": "any.Random", "seed": seed}}}),
        (True, lambda seed: {"guide": {"learned": {"run": f"sweep/ppo_seed{seed}"}}}),
        (True, lambda seed: {"degrade": {"noisy": {"sigma": 0.3, "seed": seed}}}),
        (True, lambda seed: {"disturb": {"observation_noise": {"seed": seed}}}),
        (True, lambda seed: {"env": {"id": "any", "seed": seed}}),
        (True, lambda seed: {"env": {"id": "any"}, "evaluation": {"env": {"seed": seed}}}),
        (True, lambda _: {"method": {"name": "x", "needs_guide": True, "learner": "guides"}}),
        (False, lambda _: {"guide": {"mine": {"_target_": "any.Mine", "gain": 3.0, "seed": 5}}}),
        (False, lambda seed: {"env": {"seed": seed}, "evaluation": {"env": {"first_seed": 9}}}),
        (False, lambda seed: {"env": {"seed": seed}, "evaluation": {"env": {"seed": 0}}}),
        (False, lambda seed: {"learner": {"seed": seed}, "training": {"disturb": {"seed": seed}}}),
    ],
)
def test_only_a_guide_that_does_not_depend_on_the_seed_is_accused(runs, follows, settings):
    found = runs({0: 1.0, 1: 2.0, 2: 3.0}, settings=settings)
    assert guide_follows_seed(found) == follows
    assert len(of_changed_guides(found)) == (not follows)


def test_guide_of_one_configuration_with_other_returns_in_another_label_is_said(runs):
    runs({0: -14.0, 1: -14.0}, "coil")
    assert of_guides_of_labels(runs({0: -14.000001, 2: -14.0}, "residual")) == []
    (sentence,) = of_guides_of_labels(runs({0: -28.0, 1: -28.0}, "ppo"))
    assert sentence.startswith("The guide has different returns in the same cases in runs of dif")
    assert "(coil / ppo): either the env, the guide or what they use changed" in sentence


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"guide": {"spline": {"gain": 2.0}}}, 0),
        ({"degrade": {"noisy": {"sigma": 1.0}}}, 0),
        ({"env": {"rate": 10.5}}, 0),
        ({"evaluation": {"env": {"first_seed": 7}}}, 0),
        ({"method": {"learner": "guides", "needs_guide": True}}, 0),
        # Batch and training of a label are no other configuration of its guide.
        ({"env": {"num_envs": 3}, "learner": {"gamma": 0.5}, "evaluation": {"repeats": 9}}, 1),
    ],
)
def test_guides_of_different_configurations_may_have_other_returns(runs, settings, said):
    runs({0: -14.0, 1: -14.0}, "coil")
    assert len(of_guides_of_labels(runs({0: -28.0}, "ppo", settings=lambda _: settings))) == said
