"""Whatever is done to a level file, it is a track that can be driven or refused in one sentence that names it."""

import os

import pytest
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from coil_rl.envs import ConeTrackEnv, random_track, save_track
from coil_rl.envs.level_files import load_track, load_tracks
from coil_rl.envs.track import Track, TrackError

SHARED = {"suppress_health_check": [HealthCheck.function_scoped_fixture], "phases": [Phase.explicit, Phase.generate]}
CELLS = [
    "",
    "nan",
    "inf",
    "-inf",
    "1e309",
    "1e300",
    "-0",
    "9999",
    "0,5",
    "1e-300",
    "LEFT",
    "RIGHT",
    "left ",
    "BLUE",
    "\0",
]
NUMBERS = st.floats(-600, 600).map(str)


@pytest.fixture(scope="module")
def lines(tmp_path_factory):
    path = tmp_path_factory.mktemp("level") / "good.csv"
    save_track(random_track(3), path)
    return path.read_text().splitlines()


@st.composite
def mutations(draw, lines):
    """The bytes of a level file after one to three changes."""
    lines = list(lines)
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, max(0, len(lines) - 1)))
        kind = draw(st.sampled_from(["cut", "double", "swap", "cell", "cell", "more", "reverse", "text"]))
        if not lines or kind == "text":
            lines.insert(at, draw(st.text(max_size=20)))
        elif kind == "cut":
            del lines[at : at + draw(st.sampled_from([1, 1, 2, 1000]))]
        elif kind == "double":
            lines[at:at] = lines[at : at + draw(st.sampled_from([1, 1, 1000]))]
        elif kind == "swap":
            other = draw(st.integers(0, len(lines) - 1))
            lines[at], lines[other] = lines[other], lines[at]
        elif kind == "cell":
            cells = lines[at].split(",")
            cells[draw(st.integers(0, len(cells) - 1))] = draw(st.sampled_from(CELLS) | NUMBERS)
            lines[at] = ",".join(cells)
        elif kind == "more":
            lines[at] += draw(st.sampled_from([",", ",7,8", '"', ";", " "]))
        else:
            lines[1:] = lines[:0:-1]
    data = (
        draw(st.sampled_from(["\n", "\r\n", "\r"]))
        .join(lines)
        .encode(draw(st.sampled_from(["utf-8"] * 4 + ["utf-16"])), "replace")
    )
    if draw(st.integers(0, 5)) == 0:
        at = draw(st.integers(0, len(data)))
        data = data[:at] + draw(st.binary(max_size=8)) + data[at + draw(st.integers(0, 8)) :]
    return draw(st.sampled_from([b"", b"", b"", b"\xef\xbb\xbf"])) + data


def loaded(path):
    """The track, or None if it is refused as it should be."""
    try:
        track = load_track(path)
    except TrackError as error:
        message = str(error)
    else:
        assert isinstance(track, Track)
        assert 0 < track.length < 10_000
        return track
    assert str(path) in message
    assert message.endswith(".")
    assert "\n" not in message
    return None


def check(data, lines, path):
    path.write_bytes(data.draw(mutations(lines)))
    return loaded(path)


@settings(max_examples=150, **SHARED)
@given(data=st.data())
def test_changed_file_is_a_track_or_refused_by_name(lines, tmp_path, data):
    check(data, lines, tmp_path / "level.csv")


@settings(max_examples=12, **SHARED)
@given(data=st.data())
def test_track_of_a_changed_file_can_be_driven(lines, tmp_path, data):
    track = check(data, lines, tmp_path / "level.csv")
    if track is not None:
        steps = ConeTrackEnv([track], num_cars=4).rollout(5, break_when_any_done=False)
        assert all(torch.isfinite(steps["next", key]).all() for key in ("observation", "reward", "cones"))


@pytest.mark.slow
@settings(max_examples=5000, **SHARED)
@given(data=st.data())
def test_very_many_changed_files_are_tracks_or_refused_by_name(lines, tmp_path, data):
    check(data, lines, tmp_path / "level.csv")


def ring(count, radius):
    turn = torch.arange(count, dtype=torch.float64) * (2 * torch.pi / count)
    return [(radius * x, radius * y) for x, y in zip(turn.cos().tolist(), turn.sin().tolist(), strict=True)]


@pytest.mark.parametrize(
    ("left", "right", "words"),
    [
        (ring(1001, 9), ring(32, 11), "left side of track 'level' has 1001 cones; give at most 1000"),
        (ring(32, 9000), ring(32, 9002), "left side of track 'level' is too large; it may be 500 across"),
        (
            [(200.0 * (k % 2), k / 9) for k in range(900)],
            ring(32, 11),
            "is too large; it may be 500 across and 5000",
        ),
        ([(0.0, 0.0), (1e-5, 0.0), (1e-5, 1e-5), (400.0, 0.0)], ring(32, 11), ""),
        ([(x * 1e-5, 0.0) for x in range(999)] + [(300.0, 9.0)], ring(32, 11), ""),
        ([(7.0 * (k * k % 97), 5.0 * (k * 31 % 89)) for k in range(19)], ring(32, 11), ""),
    ],
)
def test_rings_that_would_fill_the_memory_are_refused_at_once(tmp_path, left, right, words):
    path = tmp_path / "level.csv"
    rows = [f"0,{side},{x},{y}" for side, cones in (("LEFT", left), ("RIGHT", right)) for x, y in cones]
    path.write_text("\n".join([",Cone_Type,Cone_X,Cone_Y", *rows]))
    with pytest.raises(TrackError) as caught:
        load_track(path)
    assert f"{path}: " in str(caught.value)
    assert words in str(caught.value)


def test_million_lines_are_refused_at_once(tmp_path):
    (tmp_path / "long.csv").write_text(",Cone_Type,Cone_X,Cone_Y\n" + "0,LEFT,1.0,2.0\n" * 10**6)
    with pytest.raises(TrackError, match=r"long\.csv is no file of at most"):
        load_track(tmp_path / "long.csv")


@pytest.mark.parametrize("path", ["/dev/zero", "pipe", "loop", "a" * 300, "C:\\levels\\1.csv", "nul\0byte", "."])
def test_path_that_holds_no_level_is_refused_by_name(tmp_path, monkeypatch, path):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    os.symlink("loop", "loop")
    with pytest.raises(TrackError) as caught:
        load_tracks(path)
    assert repr(path)[1:-1] in str(caught.value) or path in str(caught.value)


def test_folder_names_the_file_at_fault(tmp_path, lines):
    (tmp_path / "good²_1.csv").write_text("\n".join(lines))
    (tmp_path / "bad.csv").mkdir()
    with pytest.raises(TrackError, match=r"bad\.csv cannot be read"):
        load_tracks(tmp_path)
