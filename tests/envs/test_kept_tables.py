import os

import pytest
import torch

from coil_rl.envs import Track, shipped_tracks
from coil_rl.envs.kept_tables import MOST_FILES, cache_folder, kept
from coil_rl.envs.track_map import TrackMap, _computed_tables, _tables


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    _tables.cache_clear()
    return cache_folder()


def numbers():
    return {
        "field": torch.arange(200_000, dtype=torch.float32),
        "empty": torch.zeros(0, 3, dtype=torch.int16),
        "counts": torch.tensor([[1, -(2**40)]]),
    }


class Computed:
    """Makes the tables, and counts how often."""

    def __init__(self):
        self.times = 0

    def __call__(self):
        self.times += 1
        return numbers()


def equal(tables, others):
    types = [{name: table.dtype for name, table in each.items()} for each in (tables, others)]
    return types[0] == types[1] and all(map(torch.equal, tables.values(), others.values()))


def test_tables_are_computed_once_for_each_source(cache):
    make = Computed()
    for source in ([b"a", b"b"], [b"a", b"b"], [b"ab"], [b"a", b"b"]):
        assert equal(dict(kept("numbers", source, make)), numbers())
    assert make.times == 2
    assert len(list(cache.iterdir())) == 2


def content(change):
    return lambda file: file.write_bytes(change(file.read_bytes()))


def pipe(file):
    """Put a pipe in place of the file, which must not be waited for."""
    file.unlink()
    os.mkfifo(file)


DAMAGES = {
    "cut": content(lambda whole: whole[:1000]),
    "flipped": content(lambda whole: whole[:1000] + bytes([whole[1000] ^ 1]) + whole[1001:]),
    "foreign": content(lambda whole: b"cos\nsystem\n(S'touch /tmp/hacked'\ntR."),
    "empty": content(lambda whole: b""),
    **({"pipe": pipe} if hasattr(os, "mkfifo") else {}),  # pipes of Windows have no path
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_damaged_file_is_computed_anew_and_replaced(damage, cache):
    make = Computed()
    kept("numbers", [b"a"], make)
    (file,) = cache.iterdir()
    whole = file.read_bytes()
    damage(file)
    assert equal(dict(kept("numbers", [b"a"], make)), numbers())
    assert make.times == 2
    assert file.read_bytes() == whole


def test_folder_that_cannot_be_used_costs_nothing_but_time(cache):
    cache.parent.mkdir(exist_ok=True)
    cache.write_text("a file in its place")
    make = Computed()
    for _ in range(2):
        assert equal(dict(kept("numbers", [b"a"], make)), numbers())
    assert make.times == 2
    assert cache.is_file()


def test_files_that_were_not_used_for_long_are_removed(cache):
    make = Computed()
    for number in range(MOST_FILES + 3):
        kept("numbers", [str(number).encode()], make)
        for age, file in enumerate(sorted(cache.iterdir(), key=lambda path: path.stat().st_mtime)):
            os.utime(file, (age, age))
        kept("numbers", [b"0"], make)  # its time of use is now
    assert len(list(cache.iterdir())) == MOST_FILES
    assert make.times == MOST_FILES + 3


def test_map_of_kept_tables_is_that_of_computed_ones(cache):
    tracks = tuple(shipped_tracks("test")[:1])
    computed = _computed_tables(tracks, 7.0, torch.float32)
    for _ in range(2):
        _tables.cache_clear()
        assert equal(dict(TrackMap(tracks).named_buffers()), computed)
    assert len(list(cache.iterdir())) == 1


def test_map_of_other_tracks_has_its_own_tables(cache, ring):
    (track,) = shipped_tracks("test")[:1]
    moved = Track(track.name, track.left + 0.5, track.right + 0.5)
    for tracks, sight in (([track], 7.0), ([moved], 7.0), ([track], 6.0), ([track, ring], 7.0)):
        TrackMap(tracks, sight=sight)
    assert len(list(cache.iterdir())) == 4
