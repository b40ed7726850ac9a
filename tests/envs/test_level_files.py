"""Level files: what is read is what was written, and what cannot be driven is refused in one sentence."""

import re
from pathlib import Path

import numpy as np
import pytest

from coil_rl.envs.level_files import load_track, load_tracks, save_track, shipped_track, shipped_tracks
from coil_rl.envs.track import Track, TrackError

TURN = np.linspace(0, 2 * np.pi, 32, endpoint=False)
CIRCLE = np.stack([np.cos(TURN), np.sin(TURN)], axis=1)
LEVELS = Path(__file__).parents[2] / "../shared/tracks"
HEADER = ",Cone_Type,Cone_X,Cone_Y"
levels_needed = pytest.mark.skipif(not LEVELS.is_dir(), reason="the example level files lie beside the repository only")


def ring(**changes):
    """A ring between circles of 9 and 11 m, driven anticlockwise."""
    return Track(**({"name": "ring", "left": 9 * CIRCLE, "right": 11 * CIRCLE} | changes))


def level(path, left=9 * CIRCLE, right=11 * CIRCLE, header=HEADER):
    sides = [("LEFT", x, -y) for x, y in left] + [("RIGHT", x, -y) for x, y in right]
    path.write_text("\n".join([header, *(f"{i},{kind},{x},{y}" for i, (kind, x, y) in enumerate(sides))]))
    return path


def refusal(call, *args, **kwargs):
    with pytest.raises(TrackError) as caught:
        call(*args, **kwargs)
    message = str(caught.value)
    assert message.endswith(".")
    assert "\n" not in message
    return message


def test_saved_track_is_read_back(tmp_path):
    track = ring()
    save_track(track, tmp_path / "new" / "ring.csv")
    again = load_track(tmp_path / "new" / "ring.csv")
    assert again.name == "ring"
    np.testing.assert_allclose(again.left, track.left, atol=1e-5)
    np.testing.assert_allclose(again.right, track.right, atol=1e-5)
    assert again.start == pytest.approx(track.start, abs=1e-4)
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["ring.csv"]


def test_saved_level_has_the_format_of_level_files(tmp_path):
    save_track(ring(), tmp_path / "ring.csv")
    lines = (tmp_path / "ring.csv").read_bytes().decode().split("\n")
    assert lines[:2] == [HEADER, "0,LEFT,9.0,0.0"]
    assert lines[33] == "32,RIGHT,11.0,0.0"
    assert lines[2].split(",")[3].startswith("-"), "y points down in the file"


def test_file_start_is_in_degrees(tmp_path):
    start = load_track(level(tmp_path / "ring.csv"), start=(0, -10, 90)).start
    assert start == pytest.approx((0, -10, np.pi / 2))


def test_reader_forgives_what_does_no_harm(tmp_path):
    plain = load_track(level(tmp_path / "plain.csv"))
    text = (tmp_path / "plain.csv").read_text().replace(HEADER, ", cone_type ,CONE_X,Cone_Y,Colour")
    text = text.replace("LEFT", " left ").replace("\n", "\r\n\r\n")
    (tmp_path / "odd.csv").write_bytes(b"\xef\xbb\xbf" + text.encode())
    np.testing.assert_array_equal(load_track(tmp_path / "odd.csv").left, plain.left)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b" \n\n", "is empty"),
        (b"\xff\xfe\x00\x81", "is not a text file"),
        (b",Cone_Type,X,Y\n", "has no column Cone_X; its first line names these: Cone_Type, X, Y."),
        (b",,\n", "has no column Cone_Type; its first line names these: none."),
        (f"{HEADER}\n0,LEFT,1,2\n\n1,BLUE,1,2".encode(), "line 4: Cone_Type is 'BLUE'; it must be LEFT or RIGHT."),
        (f"{HEADER}\n0,LEFT,1,two".encode(), "line 2: Cone_Y is 'two'; it must be a finite number"),
        (f"{HEADER}\n0,LEFT,nan,2".encode(), "line 2: Cone_X is 'nan'"),
        (f"{HEADER}\n0,LEFT,1,-inf".encode(), "line 2: Cone_Y is '-inf'"),
        (f"{HEADER}\n0,LEFT,1".encode(), "line 2: Cone_Y is ''"),
        (f"{HEADER}\n0,LEFT,{'1' * 140_000},2".encode(), "line 2: field larger than field limit"),
        (HEADER.encode(), "left side of track 'bad' has 0 cones"),
    ],
)
def test_file_that_is_no_level_is_refused(tmp_path, content, words):
    (tmp_path / "bad.csv").write_bytes(content)
    message = refusal(load_track, tmp_path / "bad.csv")
    assert words in message
    assert str(tmp_path / "bad.csv") in message


def test_file_with_too_few_cones_or_crossing_sides_is_refused_by_name(tmp_path):
    few = level(tmp_path / "few.csv", right=11 * CIRCLE[:3])
    assert f"{few}: The right side of track 'few' has 3 cones" in refusal(load_track, few)
    crossed = level(tmp_path / "crossed.csv", left=9 * CIRCLE + [3, 0])
    assert f"{crossed}: The two sides cross" in refusal(load_track, crossed)


def test_missing_file_and_folder_are_refused(tmp_path):
    assert "none.csv cannot be read (No such file or directory)" in refusal(load_track, tmp_path / "none.csv")
    assert "none.csv cannot be read" in refusal(load_tracks, tmp_path / "none.csv")
    assert f"{tmp_path} cannot be read" in refusal(load_track, tmp_path)


def test_folder_without_levels_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("no level")
    assert "holds no level files" in refusal(load_tracks, tmp_path)


@pytest.mark.parametrize("start", [(1, 2), ("a", 0, 0), 5])
def test_start_of_a_file_that_is_no_pose_is_refused(tmp_path, start):
    assert "give three numbers" in refusal(load_track, level(tmp_path / "ring.csv"), start)


def test_folder_is_read_in_the_order_people_count(tmp_path):
    for number in (10, 2, 1):
        level(tmp_path / f"MAP_{number}.csv")
    (tmp_path / ".MAP_3.csv").write_text("half a level")
    assert [track.name for track in load_tracks(tmp_path)] == ["MAP_1", "MAP_2", "MAP_10"]
    assert [track.name for track in load_tracks(tmp_path / "MAP_2.csv")] == ["MAP_2"]


def test_one_start_serves_all_files_of_a_folder(tmp_path):
    for number in (1, 2):
        level(tmp_path / f"MAP_{number}.csv")
    assert {track.start for track in load_tracks(tmp_path, start=(0, -10, 0))} == {(0.0, -10.0, 0.0)}


def test_seven_tracks_are_shipped_to_train_and_three_to_test():
    train, test, every = (shipped_tracks(split) for split in ("train", "test", "all"))
    assert (len(train), len(test)) == (7, 3)
    assert [track.name for track in every] == [track.name for track in train + test]
    with pytest.raises(ValueError, match=re.escape("'train', 'test' or 'all'")):
        shipped_tracks("tset")


def test_a_shipped_track_goes_by_its_name():
    assert np.array_equal(shipped_track("test_2").left, shipped_tracks("test")[1].left)
    with pytest.raises(ValueError, match=r"no shipped track 'test_4'; there are train_1, .*test_3"):
        shipped_track("test_4")


@levels_needed
@pytest.mark.parametrize(("name", "left", "right"), [("MAP_1", 82, 91), ("MAP_2", 83, 73), ("MAP_3", 46, 54)])
def test_level_files_of_others_are_read(name, left, right):
    track = load_track(LEVELS / f"{name}.csv", start=(7, -10, 0))
    assert (len(track.left), len(track.right)) == (left, right)
    assert np.linalg.norm(track.finish - (7, -10)) < 2
    assert 57 < track.length < 148


@levels_needed
def test_levels_of_others_are_a_folder_of_tracks():
    assert [track.name for track in load_tracks(LEVELS)] == ["MAP_1", "MAP_2", "MAP_3"]
