"""Films of the first case of an evaluation."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from torchrl.envs import PendulumEnv

from coil_rl.foreign.torchrl_env import EnvBatch
from coil_rl.report import Film
from coil_rl.report.film import CAPTION, GAP
from coil_rl.run.evaluation import EvaluationResult

AGENT, GUIDE = {"agent": 0}, {"guide": 7}


class Screen:
    """An env whose row r draws its steps as a shade of red (row 0) or blue, or nothing."""

    def __init__(self, size=(40, 60)):
        self.size, self.drawn = size, 0

    def render(self, row):
        if self.size is None:
            return None
        self.drawn += 1
        picture = np.zeros((*self.size, 3), np.uint8)
        picture[..., 2 if row else 0] = 60 + 7 * (self.drawn % 25)
        return picture


def drive(steps=30, reward=10.0):
    return EvaluationResult([{"case": "a", "reward": reward, "steps": steps}])


def filmed(screen, steps, rows=AGENT, **options):
    film = Film(**options)
    for _ in range(steps):
        film.watch(screen, rows, None, None)
    return film


def frames(folder):
    """Return the frames as arrays [height, width, 3]."""
    with Image.open(folder / "episode.webp") as image:
        shown = []
        for number in range(image.n_frames):
            image.seek(number)
            shown.append(np.asarray(image.convert("RGB")).astype(int))
        return shown


@pytest.mark.parametrize(("most", "count", "drawn"), [(600, 10, 17), (4, 4, 4)])
def test_film_shows_every_so_many_steps_of_the_first_episode(most, count, drawn, tmp_path):
    screen = Screen()
    filmed(screen, 50, every=3, width=30, frames=most).draw({"agent": drive()}, tmp_path)
    shown = frames(tmp_path)
    # The episode of the first case has 30 steps.
    assert len(shown) == count
    assert shown[0].shape == (20 + CAPTION, 30, 3)
    assert screen.drawn == drawn, "the env is not drawn more often"


@pytest.mark.parametrize(("rate", "every"), [(50.0, 4), (30.0, 2), (1.0, 1), (float("nan"), 2)])
def test_film_has_the_pace_of_the_env(rate, every, tmp_path):
    screen = Screen()
    screen.rate = rate
    filmed(screen, 40).draw({"agent": replace(drive(24), rate=rate)}, tmp_path)
    assert len(frames(tmp_path)) == 24 // every
    with Image.open(tmp_path / "episode.webp") as image:
        image.load()
        assert image.info["duration"] == 80, "ms"


def test_film_shows_the_guide_left_and_the_agent_right_under_their_names(tmp_path):
    film = filmed(Screen(), 20, GUIDE | AGENT, every=1, width=60)
    film.draw({"guide": drive(20), "agent": drive(20), "agent, zeroed": drive(20)}, tmp_path)
    first = frames(tmp_path)[0]
    assert first.shape == (40 + CAPTION, 60 + GAP + 60, 3)
    left, right = first[CAPTION + 10, 10], first[CAPTION + 10, 60 + GAP + 10]
    assert left.argmax() == 2
    assert right.argmax() == 0
    captions = first[:CAPTION]
    for side in (captions[:, :60], captions[:, 60 + GAP :]):
        assert side.min() < 100, "there is a text"
    assert captions[:, 60 : 60 + GAP].min() > 200, "a long text is cut"


def test_episode_that_has_ended_keeps_its_last_frame_faint(tmp_path):
    film = filmed(Screen(), 20, GUIDE | AGENT, every=1)
    film.draw({"guide": drive(5), "agent": drive(20)}, tmp_path)
    shown = frames(tmp_path)
    assert len(shown) == 20
    before, after = shown[4][CAPTION + 20, 30], shown[-1][CAPTION + 20, 30]
    assert after.sum() > before.sum() + 100


def test_a_second_evaluation_has_a_film_of_its_own(tmp_path):
    screen = Screen()
    film = filmed(screen, 10, every=1)
    film.draw({"agent": drive(10)}, tmp_path)
    for _ in range(4):
        film.watch(screen, AGENT, None, None)
    film.draw({"agent": drive(4)}, tmp_path)
    assert len(frames(tmp_path)) == 4


@pytest.mark.parametrize(
    ("screen", "steps", "active"),
    [
        (Screen(None), 5, True),
        (EnvBatch(PendulumEnv, max_steps=5), 5, True),
        (Screen(), 0, True),
        (Screen(), 5, False),
    ],
)
def test_film_of_an_env_that_is_not_drawn_has_no_file(screen, steps, active, tmp_path, capsys):
    film = filmed(screen, steps, active=active)
    film.draw({"agent": drive()}, tmp_path)
    assert film.watches is active
    assert not list(tmp_path.iterdir())
    cannot = not (isinstance(screen, Screen) and screen.size)
    assert ("not drawn: the env gives no pictures" in capsys.readouterr().err) == cannot


def test_film_that_would_be_cut_has_no_file(tmp_path):
    screen = Screen()
    film = filmed(screen, 6, every=1)
    screen.size = None  # the env cannot draw any more
    film.watch(screen, AGENT, None, None)
    film.draw({"agent": drive(7)}, tmp_path)
    assert not list(tmp_path.iterdir())
