"""Level files: reading, writing, and one-sentence errors for every other file."""

import os
import re

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from ovals import circle

from coil_rl.envs import ConeTrackEnv, random_track
from coil_rl.envs.level_files import (
    load_track,
    load_tracks,
    save_track,
    shipped_track,
    shipped_tracks,
)
from coil_rl.envs.track import Track, TrackError

CIRCLE = circle(1, 32)
HEADER = ",Cone_Type,Cone_X,Cone_Y"


def level(left=9 * CIRCLE, right=11 * CIRCLE):
    """Return the text of a level file."""
    sides = [("LEFT", x, -y) for x, y in left] + [("RIGHT", x, -y) for x, y in right]
    return "\n".join([HEADER, *(f"{i},{kind},{x},{y}" for i, (kind, x, y) in enumerate(sides))])


def write_level(path):
    path.write_text(level())
    return path


def error_of(call, *args, **kwargs):
    with pytest.raises(TrackError) as caught:
        call(*args, **kwargs)
    message = str(caught.value)
    assert message.endswith(".")
    assert "\n" not in message
    return message


def test_saved_track_is_read_back(tmp_path):
    track = Track("ring", 9 * CIRCLE, 11 * CIRCLE)
    save_track(track, tmp_path / "new" / "ring.csv")
    lines = (tmp_path / "new" / "ring.csv").read_bytes().decode().split("\n")
    assert lines[:2] == [HEADER, "0,LEFT,9.0,0.0"]
    assert lines[33] == "32,RIGHT,11.0,0.0"
    assert lines[2].split(",")[3].startswith("-"), "y points down in the file"
    loaded = load_track(tmp_path / "new" / "ring.csv")
    assert loaded.name == "ring"
    np.testing.assert_allclose(loaded.left, track.left, atol=1e-5)
    np.testing.assert_allclose(loaded.right, track.right, atol=1e-5)
    assert loaded.start == pytest.approx(track.start, abs=1e-4)


def test_case_blank_lines_line_ends_and_extra_columns_are_ignored(tmp_path):
    plain = load_track(write_level(tmp_path / "plain.csv"))
    text = (tmp_path / "plain.csv").read_text().replace(HEADER, ", cone_type ,CONE_X,Cone_Y,Colour")
    text = text.replace("LEFT", " left ").replace("\n", "\r\n\r\n")
    (tmp_path / "odd.csv").write_bytes(b"\xef\xbb\xbf" + text.encode())
    np.testing.assert_array_equal(load_track(tmp_path / "odd.csv").left, plain.left)


def test_start_is_three_numbers_with_the_heading_in_degrees(tmp_path):
    path = write_level(tmp_path / "ring.csv")
    assert load_track(path, start=(0, -10, 90)).start == pytest.approx((0, -10, np.pi / 2))
    for start in ((1, 2), ("a", 0, 0), 5):
        assert "give three numbers" in error_of(load_track, path, start)


LONG_CELL = "1" * 140_000


FAR_APART = [(200.0 * (k % 2), k / 9) for k in range(900)]
NEARLY_IN_A_POINT = [(x * 1e-5, 0.0) for x in range(999)] + [(300.0, 9.0)]
SCATTERED = [(7.0 * (k * k % 97), 5.0 * (k * 31 % 89)) for k in range(19)]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "is empty"),
        (b"\xff\xfe\x00\x81", "is not a text file"),
        (",Cone_Type,X,Y\n", "has no column Cone_X; the columns of its first line are"),
        (f"{HEADER}\n0,LEFT,1,2\n\n1,BLUE,1,2", "line 4: Cone_Type is 'BLUE'"),
        (f"{HEADER}\n0,LEFT,1,two", "line 2: Cone_X, Cone_Y are ['1', 'two']"),
        (f"{HEADER}\n0,LEFT,1,-inf", "['1', '-inf']"),
        (f"{HEADER}\n0,LEFT,1", "['1', '']"),
        (f"{HEADER}\n0,LEFT,{LONG_CELL},2", "line 2: field larger than field limit"),
        (HEADER, "left side of track 'bad' has 0 cones"),
        (HEADER + "\n0,LEFT,1.0,2.0" * 10**6, "(it has more than 10,000,000 bytes)"),
        (level(circle(9, 1001)), "has 1001 cones, of shape [1001, 2]; give 4 to 1000"),
        (level(9000 * CIRCLE, 9002 * CIRCLE), "is too large; the limits are 500 m across"),
        (level(FAR_APART), "is too large"),
        # Without filling the memory.
        (level(NEARLY_IN_A_POINT), ""),
        (level(SCATTERED), ""),
    ],
    ids=range(15),
)
def test_invalid_files_are_rejected_with_a_message(tmp_path, content, words):
    data = content if isinstance(content, bytes) else content.encode()
    (tmp_path / "bad.csv").write_bytes(data)
    message = error_of(load_track, tmp_path / "bad.csv")
    assert words in message
    assert str(tmp_path / "bad.csv") in message


@pytest.mark.parametrize(
    "path", ["/dev/zero", "pipe", "loop", "a" * 300, "C:\\levels\\1.csv", "nul\0byte", ".", "x.csv"]
)
def test_paths_without_a_level_are_rejected_by_name(tmp_path, monkeypatch, path):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    os.symlink("loop", "loop")
    for load in (load_track, load_tracks):
        assert path in error_of(load, path)
    (tmp_path / "notes.txt").write_text("no level")
    assert "holds no level files" in error_of(load_tracks, tmp_path)
    (tmp_path / "bad.csv").mkdir()
    assert "bad.csv cannot be read" in error_of(load_tracks, tmp_path)


def test_folders_are_read_in_natural_order_with_one_start(tmp_path):
    for number in ("10", "2", "1", "²3"):
        write_level(tmp_path / f"MAP_{number}.csv")
    (tmp_path / ".MAP_3.csv").write_text("half a level")
    tracks = load_tracks(tmp_path, start=(0, -10, 0))
    assert [track.name for track in tracks] == ["MAP_1", "MAP_2", "MAP_10", "MAP_²3"]
    assert {track.start for track in tracks} == {(0.0, -10.0, 0.0)}
    assert [track.name for track in load_tracks(tmp_path / "MAP_2.csv")] == ["MAP_2"]


def test_seven_tracks_are_shipped_to_train_and_three_to_test():
    train, test, every = (shipped_tracks(split) for split in ("train", "test", "all"))
    assert (len(train), len(test)) == (7, 3)
    assert [track.name for track in every] == [track.name for track in train + test]
    assert shipped_track("test_2") is test[1]
    with pytest.raises(ValueError, match="'train', 'test' or 'all'"):
        shipped_tracks("tset")
    with pytest.raises(ValueError, match=r"no shipped track 'test_4'; there are train_1, .*test_3"):
        shipped_track("test_4")


def test_the_authors_level_files_are_read(levels):
    sizes = {track.name: (len(track.left), len(track.right)) for track in levels}
    assert sizes == {"MAP_1": (82, 91), "MAP_2": (83, 73), "MAP_3": (46, 54)}
    for track in levels:
        assert np.linalg.norm(track.finish - (7, -10)) < 2
        assert 57 < track.length < 148


# Mutated files

NUMBERS = ["nan", "inf", "-inf", "1e309", "1e300", "-0", "9999", "0,5", "1e-300"]
CELLS = [*NUMBERS, "LEFT", "RIGHT", "left ", "B", "", "\0"]


@pytest.fixture(scope="module")
def lines(tmp_path_factory):
    path = tmp_path_factory.mktemp("level") / "good.csv"
    save_track(random_track(3), path)
    return path.read_text().splitlines()


@st.composite
def mutations(draw, lines):
    """Draw the bytes of a level file with one to three changes, and perhaps another byte."""
    lines = list(lines)
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, max(0, len(lines) - 1)))
        kind = draw(st.sampled_from(["cut", "double", "cell", "cell", "reverse", "text"]))
        if not lines or kind == "text":
            lines.insert(at, draw(st.text(max_size=20)))
        elif kind == "cut":
            del lines[at : at + draw(st.sampled_from([1, 1, 2, 1000]))]
        elif kind == "double":
            lines[at:at] = lines[at : at + draw(st.sampled_from([1, 1, 1000]))]
        elif kind == "cell":
            cells = lines[at].split(",")
            value = draw(st.sampled_from(CELLS) | st.floats(-600, 600).map(str))
            cells[draw(st.integers(0, len(cells) - 1))] = value
            lines[at] = ",".join(cells)
        else:
            lines[1:] = lines[:0:-1]
    data = "\n".join(lines).encode(draw(st.sampled_from(["utf-8"] * 4 + ["utf-16"])), "replace")
    at = draw(st.integers(0, len(data)))
    byte = draw(st.sampled_from([b"", b"", b"", b"\xff", b"\0", b'"', b"\r"]))
    return data[:at] + byte + data[at:]


@pytest.mark.slow
@settings(
    max_examples=500,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    phases=[Phase.explicit, Phase.generate],
)
@given(data=st.data())
def test_mutated_files_are_rejected_by_name_or_can_be_driven(lines, tmp_path, data):
    path = tmp_path / "level.csv"
    path.write_bytes(data.draw(mutations(lines)))
    try:
        track = load_track(path)
    except TrackError as error:
        assert re.fullmatch(f".*{re.escape(str(path))}.*[.]", str(error))  # noqa: PT017
        return
    assert 0 < track.length < 10_000
    steps = ConeTrackEnv([track], num_envs=4).rollout(5, break_when_any_done=False)["next"]
    assert steps.select("observation", "reward", "cones").isfinite().all()
