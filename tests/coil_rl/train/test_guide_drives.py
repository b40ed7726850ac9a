"""Guides are driven once for all runs of a process that drive them alike."""

import pytest
from hydra import compose, initialize_config_module

from coil_rl.train.build import build_guides
from coil_rl.train.guide_drives import drive_guides

TINY = ["env.time_limit=1", "guide=[spline,random]", "run_dir=unused"]


@pytest.fixture
def composed():
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        yield lambda *overrides: compose("train", [*TINY, *overrides])


def driven(config, guides=None):
    return drive_guides(config, config.evaluation.env, ["a", "b", "c"], guides)


def test_guides_of_a_sweep_are_driven_once(composed):
    first, again = (driven(composed(f"method={method}")) for method in ("coil", "ppo"))
    assert list(first) == ["guide spline", "guide random"]
    assert all(again[driver] is drive for driver, drive in first.items())


@pytest.mark.parametrize("other", ["seed=1", "preset=authors", "degrade=delayed", "env.smoothing=0.2"])
def test_guides_are_driven_anew_where_anything_about_them_differs(composed, other):
    first, others = driven(composed()), driven(composed(other))
    assert all(others[driver] is not drive for driver, drive in first.items())


def test_guides_that_are_given_are_driven_as_they_are_now(composed):
    config = composed()
    known, given = driven(config), driven(config, build_guides(config))
    assert given["guide spline"] is not known["guide spline"]
    assert given["guide spline"].mean_reward == known["guide spline"].mean_reward
