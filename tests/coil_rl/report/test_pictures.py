"""Pictures of an evaluation."""

import math

import numpy as np
import pytest
from ovals import ring_track
from PIL import Image

from coil_rl.report import DrivenLines, Returns
from coil_rl.run.evaluation import EvaluationResult

TRACKS = [ring_track("small", 5.0), ring_track("large", 8.0)]


def drive(rate=2.0, **measures):
    """Return episodes of half a round on each track."""
    episodes = [{"case": name, "reward": 10.0, "steps": 30} | measures for name in "ab"]
    turn = np.linspace(0, np.pi, 30)
    poses = [np.stack([r * np.cos(turn), r * np.sin(turn), turn], axis=1) for r in (5.0, 8.0)]
    return EvaluationResult(episodes, {"pose": poses}, rate)


def names(folder):
    return {path.name for path in folder.iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize("measures", [{"crashed": True}, {}])
def test_driven_lines_are_drawn_with_an_animation(measures, tmp_path):
    picture = DrivenLines(TRACKS)
    assert picture.record == {"pose": ("info", "pose")}
    picture.watch(None, {}, None, None)
    assert not picture.watches
    picture.draw({"guide": drive(), "agent": drive(**measures)}, tmp_path)
    assert names(tmp_path) == {"lines.png", "lines.gif"}
    with Image.open(tmp_path / "lines.gif") as animation:
        assert animation.n_frames > 10


def test_only_the_first_tracks_and_cases_are_drawn(tmp_path):
    pictures = set()
    for tracks, cases, most in ((2, 2, 1), (1, 1, 12), (1, 2, 12), (2, 1, 12)):
        picture = DrivenLines(TRACKS[:tracks], gif=False, most=most)
        picture.draw({"agent": drive()[:cases]}, tmp_path)
        pictures.add((tmp_path / "lines.png").read_bytes())
    assert len(pictures) == 1


@pytest.mark.parametrize(("gif", "rate"), [(False, 2.0), (True, math.nan)])
def test_animation_is_left_out_on_request_or_without_the_rate_of_the_env(gif, rate, tmp_path):
    DrivenLines(TRACKS, gif=gif).draw({"agent": drive(rate)}, tmp_path)
    assert names(tmp_path) == {"lines.png"}


def test_returns_are_drawn_without_a_record(tmp_path):
    Returns().draw(dict.fromkeys(["guide", "agent", "agent, zeroed"], drive()), tmp_path)
    assert names(tmp_path) == {"returns.png"}
    assert Returns().record == {}
