import csv
import math

import pytest
import torch
from PIL import Image
from torchrl.envs.utils import step_mdp

from coil_rl.envs import ConeTrackEnv, Track, shipped_track
from coil_rl.envs.sight import SAMPLES, encode
from coil_rl.errors import UserError
from coil_rl.guides import SplineGuide
from coil_rl.reproduce import FigureWorld
from coil_rl.reproduce.figure_world_look import looks

MOMENTS = {"lost": 5.33, "start": 0.0}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The page, and the numbers by moment and part."""
    stem = tmp_path_factory.mktemp("world") / "f"
    page = FigureWorld("test_3", MOMENTS).make(stem)
    parts: dict = {name: {} for name in MOMENTS}
    with stem.with_suffix(".csv").open(newline="") as file:
        for row in csv.DictReader(file):
            numbers = {key: float(value) for key, value in row.items() if value and key not in ("moment", "part")}
            parts[row["moment"]].setdefault(row["part"], []).append(numbers)
    return page, parts, stem


@pytest.fixture(scope="module")
@torch.no_grad()
def driven():
    """What the env shows, and what the guide says, at the same moments of the same drive."""
    env, guide, found = ConeTrackEnv([shipped_track("test_3")], num_cars=1), SplineGuide(), {}
    state = env.reset()
    for step in range(129):
        state = guide(state)
        found[step] = state
        state = step_mdp(env.step(state))
    return {"start": found[0], "lost": found[128]}


@pytest.mark.parametrize("moment", MOMENTS)
def test_the_numbers_are_the_observation_and_the_samples_that_are_drawn_encode_to_it(made, driven, moment):
    samples = made[1][moment]["sample"]
    observation = driven[moment]["observation"][0]
    assert [value for row in samples for value in (row["r"], row["theta"])] == observation.tolist()
    places = torch.tensor([[[[row[axis]] for row in samples]] for axis in ("x", "y")])
    places = places.view(2, 2, SAMPLES, 1).transpose(1, 2)
    assert torch.allclose(encode(places, torch.ones(2, 1))[0], observation, atol=1e-5)


@pytest.mark.parametrize("moment", MOMENTS)
def test_cones_and_advice_are_those_of_env_and_guide(made, driven, moment):
    parts, state = made[1][moment], driven[moment]
    for side, name in enumerate(("left", "right")):
        count = int(state["cone_count"][0, side])
        cones = [[row["x"], row["y"]] for row in parts[f"cone {name}"]]
        assert cones == state["cones"][0, side, :count].tolist()
    assert parts["advice"][0]["degrees"] == pytest.approx(80 * state["action"].item())
    (target,) = parts["steered for"]
    distance, angle = math.hypot(target["x"], target["y"]), math.degrees(math.atan2(target["y"], target["x"]))
    # Equation 103.
    assert parts["advice"][0]["degrees"] == pytest.approx(160 / math.pi * math.atan(angle / distance**1.8), abs=1e-3)


def test_a_side_with_one_cone_has_samples_but_no_boundary(made):
    lost, start = made[1]["lost"], made[1]["start"]
    assert len(lost["cone left"]) == 1
    assert "boundary left" not in lost
    assert len(lost["boundary right"]) == len(start["boundary left"]) == 60


def test_page_and_picture_have_the_moments_as_they_were_asked_for(made):
    page, parts, stem = made
    first = parts["start"]["sample"][0]
    lines = page.splitlines()
    assert [line.split("|")[1].strip() for line in lines if "|" in line][2:4] == ["lost", "start"]
    (line,) = (line for line in lines if line.startswith("| left 1 "))
    assert line.split("|")[3].strip() == f"{first['r']:.3f}, {first['theta']:.3f}"
    with Image.open(stem.with_suffix(".png")) as image:
        assert image.width == 1600


def test_mistakes_are_refused():
    with pytest.raises(ValueError, match="no shipped track 'test_9'"):
        FigureWorld("test_9")
    with pytest.raises(ValueError, match="moments is empty"):
        FigureWorld(moments={})
    with pytest.raises(ValueError, match=r"moments\.early=-1 must be a finite number of seconds"):
        FigureWorld(moments={"early": -1})


def test_a_moment_after_the_drive_is_refused():
    track = shipped_track("test_3")
    x, y, heading = track.start
    to_the_side = Track("sideways", track.left, track.right, (x, y, heading + math.pi / 2))
    with pytest.raises(UserError, match=r"drive on sideways is over after 0\.\d s; give moments before that"):
        looks(to_the_side, {"late": 3.0})
