import itertools

import numpy as np
import pytest
import torch
from ovals import oval_line

from coil_rl.envs import Track, shipped_tracks
from coil_rl.listening import PLACES, Places
from coil_rl.listening.places import curvature, kinds, smooth_line


def circle(radius, points=60, clockwise=False):
    angle = np.linspace(0, 2 * np.pi, points, endpoint=False) * (-1 if clockwise else 1)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def names(line, **lengths):
    return {PLACES[kind] for kind in kinds(line, **lengths)}


def test_a_circle_is_one_turn_everywhere():
    assert names(circle(8)) == {"left"}
    assert names(circle(8, clockwise=True)) == {"right"}
    assert names(circle(12)) == {"straight"}, "wider than what counts as a turn"
    assert names(circle(12), turn_radius=13) == {"left"}


def test_curvature_is_positive_to_the_left_and_one_over_the_radius():
    np.testing.assert_allclose(curvature(circle(8, 1000)), 1 / 8, rtol=1e-4)
    np.testing.assert_allclose(curvature(circle(5, 1000, clockwise=True)), -1 / 5, rtol=1e-4)


def test_entries_come_before_turns_and_exits_after_them():
    line = oval_line()
    kind = [PLACES[place] for place in kinds(line, approach=4.0)]
    pieces = [kind[0], *(b for a, b in itertools.pairwise(kind) if a != b)]
    assert pieces == ["exit", "straight", "entry", "left"] * 2
    metres = {name: 0.1 * kind.count(name) / 2 for name in PLACES}
    assert metres == pytest.approx({"straight": 32, "left": 6 * np.pi, "right": 0, "entry": 4, "exit": 4}, abs=0.3)


def test_between_near_turns_the_exit_ends_half_way():
    kind = [PLACES[place] for place in kinds(oval_line(length=5.0), approach=4.0)]
    assert set(kind) == {"left", "entry", "exit"}
    assert kind.count("entry") == pytest.approx(kind.count("exit"), abs=2)


def test_places_do_not_depend_on_where_the_lap_begins():
    line = oval_line()
    assert (np.roll(kinds(line), 137) == kinds(np.roll(line, 137, axis=0))).all()


@pytest.mark.parametrize("clockwise", [False, True])
def test_the_smooth_line_is_half_way_between_the_sides(clockwise):
    inner, outer = circle(7, 40, clockwise), circle(9, 50, clockwise)
    track = Track("ring", *((outer, inner) if clockwise else (inner, outer)))
    line = smooth_line(track)
    np.testing.assert_allclose(np.linalg.norm(line, axis=1), 8, atol=0.1)
    assert names(line) == {"right" if clockwise else "left"}


def test_each_shipped_track_is_one_turn_around_with_a_bit_of_everything():
    for track in shipped_tracks("test"):
        line = smooth_line(track)
        step = np.linalg.norm(np.roll(line, -1, axis=0) - line, axis=1)
        assert step.sum() == pytest.approx(track.length, rel=0.03)
        assert abs((curvature(line) * step).sum()) == pytest.approx(2 * np.pi, rel=0.01)
        assert names(line) >= {"left", "right", "entry", "exit"}


def test_cars_are_found_on_their_own_track():
    tracks = shipped_tracks("test")
    places = Places(tracks)
    for index, line in enumerate(places.lines):
        rng = np.random.default_rng(0)
        aside = torch.as_tensor(line + rng.uniform(-0.05, 0.05, line.shape), dtype=torch.float32)
        track = torch.full((len(line),), index)
        assert (places.nearest(track, aside) - torch.arange(len(line))).abs().max() <= 1
        exact = torch.as_tensor(line, dtype=torch.float32)
        assert places.kind(track, exact).tolist() == places.kinds[index].tolist()


@pytest.mark.parametrize("wrong", [{"turn_radius": 0.0}, {"approach": -1.0}])
def test_lengths_are_positive(wrong):
    with pytest.raises(ValueError, match="must be more than 0"):
        Places(shipped_tracks("test"), **wrong)
