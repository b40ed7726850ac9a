"""What tables 6 and 7 say of drives whose numbers are known."""

import math

import pytest

from coil_rl.reproduce.table_6_page import page

KNOWN = {"crashed": False, "laps": 3, "lap_time": 40.0, "corner_cut": 1.0, "off_centre": 0.02, "clearance": 0.04}


def drive(method, seed=None, **others):
    return KNOWN | {"method": method, "seed": seed, "smoothness": 0.3} | others


def made(*drives):
    return page(drives, "", 80.0, 200, 0)


def cells(text, begins, last=True):
    found = [line for line in text.splitlines() if line.startswith(f"| {begins}")]
    return [cell.strip() for cell in found[-1 if last else 0].split("|")[1:-1]]


@pytest.fixture(scope="module")
def text():
    """COIL steers more smoothly than the guide with every seed, and comes around with two of three."""
    lost = {"laps": 0, "lap_time": math.nan, "corner_cut": math.nan, "crashed": True, "clearance": -0.01}
    coil = [drive("coil", seed, smoothness=0.1 + int(seed) / 100, lap_time=38.0) for seed in "01"]
    ppo = [drive("ppo", seed, smoothness=0.106, lap_time=39.0, clearance=0.02) for seed in "012"]
    return made(drive("guide"), drive("guide", clearance=0.05), *ppo, *coil, drive("coil", "2", smoothness=0.2, **lost))


def test_a_method_is_the_mean_of_its_drives_beside_the_paper(text):
    row = cells(text, "guide", last=False)
    assert row == ["guide", "-", "2", "6", "0", "0.300", "0.265", "40.00", "43.67"]
    row = cells(text, "coil ", last=False)
    assert row == ["coil", "3", "3", "6", "1", "0.137", "0.082", "38.00", "39.53"]
    assert cells(text, "guide") == ["guide", "0.020", "0.040", "1.000", "sways, stays central"]


def test_what_the_paper_says_is_judged_seed_by_seed(text):
    expected = "**held up**: -0.194 (-0.194 to -0.194)"
    assert cells(text, "PPO steers more smoothly than the guide")[1:] == ["-0.163", "3 of 3", expected]
    assert cells(text, "COIL steers more smoothly than PPO")[3] == "**undecided**: -0.001 (-0.006 to +0.004)"


def test_who_never_came_around_is_compared_by_clearance_alone(text):
    assert cells(text, "COIL's laps")[1:] == ["-0.61", "2 of 3", "**held up**: -1.00 (-1.00 to -1.00)"]
    expected = "**held up**: -0.195 (-0.200 to -0.190)"
    assert cells(text, "COIL steers more smoothly than its guide")[1:] == ["-0.183", "2 of 3", expected]
    assert cells(text, "PPO drives nearer")[2] == "3 of 3"


def test_nobody_who_came_around_leaves_nothing_to_compare():
    lost = {"laps": 0, "lap_time": math.nan, "corner_cut": math.nan, "crashed": True, "clearance": -0.01}
    text = made(drive("guide"), drive("ppo", "0", **lost))
    assert cells(text, "PPO steers more smoothly")[2:] == ["0 of 1", "-"]
    assert cells(text, "PPO drives nearer")[2:] == ["1 of 1", "**undecided**: -0.050"]


def test_a_crash_is_told_with_its_driver(text):
    expected = "**did not hold up**: guide 0 of 2 drives, ppo 0 of 3 drives, coil 1 of 3 drives"
    assert cells(text, "Nobody crashes") == ["Nobody crashes", "0", "-", expected]


def test_one_agent_of_an_unknown_seed_leaves_all_undecided():
    text = made(drive("guide"), drive("coil", smoothness=0.1))
    assert cells(text, "COIL steers")[2:] == ["1 of 1", "**undecided**: -0.200"]


def test_drivers_that_are_not_the_papers_have_no_claims():
    assert "held up" not in made(drive("mine"), drive("guide"))
