"""Tracks of Formula Student simulators."""

import re

import numpy as np
import pytest
from ovals import circle

from coil_rl.envs import ConeTrackEnv, load_track, load_tracks
from coil_rl.envs.track import TrackError

CIRCLE = circle(1, 24)
SIMULATOR = "cone_type,X,Y,Z,std_X,std_Y,std_Z,right,left"
EUFS = "tag,x,y,direction,x_variance,y_variance,xy_covariance"


def cones(kind, points, rest=""):
    return [f"{kind},{x:.4f},{y:.4f}{rest}" for x, y in points]


def write(path, header, *lines):
    path.write_text("\n".join([header, *lines]) + "\n")
    return path


@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize("outer", ["blue", "yellow"])
def test_blue_cones_are_left_in_any_order_and_on_either_side(tmp_path, outer, shuffled):
    order = np.random.default_rng(0).permutation(24) if shuffled else np.arange(24)
    inner = "yellow" if outer == "blue" else "blue"
    lines = cones(inner, 9 * CIRCLE[order]) + cones(outer, 12 * CIRCLE[order])
    track = load_track(write(tmp_path / "ring.csv", SIMULATOR, *lines))
    radius = {"blue": np.hypot(*track.left.T), "yellow": np.hypot(*track.right.T)}
    np.testing.assert_allclose(radius[outer], 12, atol=1e-3)
    np.testing.assert_allclose(radius[inner], 9, atol=1e-3)
    assert track.length == pytest.approx(2 * np.pi * 10.5, rel=0.01)
    ConeTrackEnv([track], 2).rollout(2)


def test_orange_cones_count_where_a_column_names_their_side(tmp_path):
    lines = cones("blue", 9 * CIRCLE[1:]) + cones("yellow", 12 * CIRCLE[1:])
    lines += cones("big_orange", 9 * CIRCLE[:1], ",0,0,0,0,0,1")
    lines += cones("big_orange", 12 * CIRCLE[:1], ",0,0,0,0,1,0")
    lines += cones("small_orange", 20 * CIRCLE[:1])
    track = load_track(write(tmp_path / "ring.csv", SIMULATOR, *lines))
    assert (len(track.left), len(track.right)) == (24, 24)


def test_start_of_the_file_is_that_of_the_car(tmp_path):
    lines = [f"car_start,0,-10.5,{0.0}", *cones("blue", 9 * CIRCLE), *cones("yellow", 12 * CIRCLE)]
    track = load_track(write(tmp_path / "ring.csv", EUFS, *lines))
    assert track.start == (0.0, -10.5, 0.0)
    assert track.finish[0] > 0
    assert abs(track.finish[1] + 10.5) < 1
    assert load_track(tmp_path / "ring.csv", [10.5, 0.0, 90.0]).start[0] == 10.5


def test_folder_may_hold_levels_of_both_kinds(tmp_path):
    write(
        tmp_path / "a.csv",
        ",Cone_Type,Cone_X,Cone_Y",
        *(f"{i},LEFT,{x},{-y}" for i, (x, y) in enumerate(9 * CIRCLE)),
        *(f"{i},RIGHT,{x},{-y}" for i, (x, y) in enumerate(12 * CIRCLE)),
    )
    write(tmp_path / "b.csv", EUFS, *cones("blue", 9 * CIRCLE), *cones("yellow", 12 * CIRCLE))
    a, b = load_tracks(tmp_path)
    np.testing.assert_allclose(a.left, b.left, atol=1e-3)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["blue,1,2"], "it has 1 blue (left) and 0 yellow (right) cones; give both."),
        (["blue,1,up", "yellow,1,2"], "line 2: x, y are ['1', 'up']; they must be finite numbers"),
        (["blue,1", "yellow,1,2"], "line 2: x, y are ['1', '']"),
        ([*cones("blue", CIRCLE[:3]), *cones("yellow", 2 * CIRCLE)], "has 3 cones"),
    ],
)
def test_other_files_are_refused_in_one_sentence(tmp_path, lines, words):
    path = write(tmp_path / "odd.csv", EUFS, *lines)
    with pytest.raises(TrackError, match=re.escape(words)) as caught:
        load_track(path)
    assert str(caught.value).startswith(str(path))
