import itertools

import numpy as np
import pytest
import torch
from ovals import circle, oval_line
from tensordict import TensorDict

from coil_rl.envs import Track, shipped_tracks
from coil_studies.listening.sections import (
    SECTIONS,
    TrackSections,
    classify,
    curvature,
    smooth_line,
)


def names(line, **lengths):
    return {SECTIONS[section] for section in classify(line, **lengths)}


def test_circle_is_one_turn():
    assert names(circle(8)) == {"left"}
    assert names(circle(8, clockwise=True)) == {"right"}
    assert names(circle(12)) == {"straight"}, "wider than a turn"
    assert names(circle(12), turn_radius=13) == {"left"}
    np.testing.assert_allclose(curvature(circle(8, 1000)), 1 / 8, rtol=1e-4)
    np.testing.assert_allclose(curvature(circle(5, 1000, clockwise=True)), -1 / 5, rtol=1e-4)


def test_entries_are_before_turns_and_exits_after_them():
    sections = [SECTIONS[section] for section in classify(oval_line(), approach=4.0)]
    pieces = [sections[0], *(b for a, b in itertools.pairwise(sections) if a != b)]
    assert pieces == ["exit", "straight", "entry", "left"] * 2
    metres = {name: 0.1 * sections.count(name) / 2 for name in SECTIONS}
    assert metres == pytest.approx(
        {"straight": 32, "left": 6 * np.pi, "right": 0, "entry": 4, "exit": 4}, abs=0.3
    )
    close = [SECTIONS[section] for section in classify(oval_line(length=5.0), approach=4.0)]
    assert set(close) == {"left", "entry", "exit"}
    assert close.count("entry") == pytest.approx(close.count("exit"), abs=2), (
        "half-way between close turns"
    )


def test_sections_do_not_depend_on_the_start_of_the_lap():
    line = oval_line()
    assert (np.roll(classify(line), 137) == classify(np.roll(line, 137, axis=0))).all()


@pytest.mark.parametrize("clockwise", [False, True])
def test_smooth_line_is_half_way_between_the_boundaries(clockwise):
    inner, outer = circle(7, 40, clockwise), circle(9, 50, clockwise)
    line = smooth_line(Track("ring", *((outer, inner) if clockwise else (inner, outer))))
    np.testing.assert_allclose(np.linalg.norm(line, axis=1), 8, atol=0.1)
    assert names(line) == {"right" if clockwise else "left"}


def test_shipped_tracks_turn_once_and_have_all_kinds_of_turns():
    for track in shipped_tracks("test"):
        line = smooth_line(track)
        step = np.linalg.norm(np.roll(line, -1, axis=0) - line, axis=1)
        assert step.sum() == pytest.approx(track.length, rel=0.03)
        assert abs((curvature(line) * step).sum()) == pytest.approx(2 * np.pi, rel=0.01)
        assert names(line) >= {"left", "right", "entry", "exit"}


def state(track, positions):
    """Return a state of cars at positions [N, 2] of a track."""
    poses = torch.as_tensor(np.pad(positions, ((0, 0), (0, 1))), dtype=torch.float32)
    return TensorDict(
        {"info": {"track": torch.full((len(poses), 1), track), "pose": poses}}, [len(poses)]
    )


def test_cars_are_located_on_their_own_track():
    sections = TrackSections(shipped_tracks("test"))
    for index, line in enumerate(sections.lines):
        noise = np.random.default_rng(0).uniform(-0.05, 0.05, line.shape)
        place = sections.locate(state(index, line + noise))
        assert (place["track"] == index).all()
        assert (place["point"] - torch.arange(len(line))).abs().max() <= 1
        exact = sections.locate(state(index, line))
        assert sections.section(exact).tolist() == sections.sections[index].tolist()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"turn_radius": 0.1}, "turn_radius=0.1 must be at least 0.5"),
        ({"approach": 0.0}, "approach=0.0 must be at least 0.1"),
        ({"bin": -1.0}, "bin=-1.0 must be at least 0.1"),
    ],
)
def test_lengths_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        TrackSections(shipped_tracks("test"), **options)
