"""Pictures of an evaluation."""

import math

import numpy as np
import pytest
from ovals import ring_track
from PIL import Image

from coil_rl.report import DrivenLines, Film, Returns
from coil_rl.run.evaluation import EvaluationResult

TRACKS = [ring_track("small", 5.0), ring_track("large", 8.0)]


def drive(rate=2.0, **measures):
    """Return episodes of half a round on each track."""
    episodes = [
        {"case": name, "reward": 10.0 * number, "steps": 30} | measures
        for number, name in enumerate("ab")
    ]
    turn = np.linspace(0, np.pi, 30)
    poses = [
        np.stack([radius * np.cos(turn), radius * np.sin(turn), turn], axis=1)
        for radius in (5.0, 8.0)
    ]
    return EvaluationResult(episodes, {"pose": poses}, rate)


def frames(path):
    with Image.open(path) as image:
        return image.n_frames


def names(folder):
    return {path.name for path in folder.iterdir()}


@pytest.mark.parametrize("measures", [{"crashed": True}, {}])
def test_driven_lines_are_drawn_with_an_animation(measures, tmp_path):
    picture = DrivenLines(TRACKS)
    assert picture.record == {"pose": ("info", "pose")}
    picture.watch(None)
    picture.draw({"guide": drive(), "agent": drive(**measures)}, tmp_path)
    assert names(tmp_path) == {"lines.png", "lines.gif"}
    assert frames(tmp_path / "lines.gif") > 10
    with Image.open(tmp_path / "lines.png") as image:
        assert np.asarray(image.convert("L")).std() > 0


def test_only_the_first_tracks_are_drawn(tmp_path):
    pictures = []
    for tracks, most in ((TRACKS, 1), (TRACKS[:1], 12)):
        DrivenLines(tracks, gif=False, most=most).draw({"agent": drive()[: len(tracks)]}, tmp_path)
        pictures.append((tmp_path / "lines.png").read_bytes())
    assert pictures[0] == pictures[1]


@pytest.mark.parametrize(("gif", "rate"), [(False, 2.0), (True, math.nan)])
def test_animation_is_left_out_on_request_or_without_the_rate_of_the_env(gif, rate, tmp_path):
    DrivenLines(TRACKS, gif=gif).draw({"agent": drive(rate)}, tmp_path)
    assert names(tmp_path) == {"lines.png"}


def test_returns_have_a_row_for_each_driver(tmp_path):
    heights = []
    for drivers in (["agent"], ["guide", "agent", "agent, zeroed"]):
        Returns().draw(dict.fromkeys(drivers, drive()), tmp_path)
        with Image.open(tmp_path / "returns.png") as image:
            heights.append(image.height)
    assert names(tmp_path) == {"returns.png"}
    assert heights[1] > heights[0]
    assert Returns().record == {}


class Screen:
    """An env that draws its step as a shade of grey, or nothing."""

    def __init__(self, size=(40, 60)):
        self.size, self.step = size, 0

    def render(self):
        self.step += 1
        return np.full((*self.size, 3), self.step, np.uint8) if self.size else None


def filmed(screen, steps, **options):
    film = Film(**options)
    for _ in range(steps):
        film.watch(screen)
    return film


def test_film_shows_every_so_many_steps_of_the_first_episode(tmp_path):
    filmed(Screen(), 50, every=3, width=30).draw({"guide": drive(), "agent": drive()}, tmp_path)
    # The episode of the first case has 30 steps.
    assert frames(tmp_path / "episode.gif") == 10
    with Image.open(tmp_path / "episode.gif") as image:
        assert image.size == (30, 20)


def test_film_has_a_largest_number_of_frames(tmp_path):
    screen = Screen()
    filmed(screen, 50, every=1, frames=4).draw({"agent": drive()}, tmp_path)
    assert frames(tmp_path / "episode.gif") == 4
    assert screen.step == 4, "the env is not drawn more often"


@pytest.mark.parametrize(("screen", "steps"), [(Screen(None), 5), (Screen(), 0)])
def test_film_of_an_env_that_is_not_drawn_has_no_file(screen, steps, tmp_path):
    filmed(screen, steps).draw({"agent": drive()}, tmp_path)
    assert not names(tmp_path)
