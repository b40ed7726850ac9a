import functools
import gc
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from hydra._internal import defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import ConfigRepository
from hydra.core.config_store import ConfigStore
from hypothesis import settings
from omegaconf import base
from outside_package.install import SOURCE
from package_entries import find_entry_points
from torch._export import utils

from coil_rl.config.schema import shipped_places
from coil_rl.envs import Track, load_track
from coil_rl.report import style

LEVELS = Path(__file__).resolve().parents[2] / "shared" / "tracks"

find_entry_points()
OURS = shipped_places()  # of files of a configuration that no test changes

# The tensors of the tests are too small for several threads.
torch.set_num_threads(1)
settings.register_profile("deterministic", derandomize=True, deadline=None)
settings.load_profile("deterministic")


def remembered(function, key_of):
    """Return a function with a memory; it has none for what has no key, which is None."""
    known = {}

    def call(*arguments, **options):
        key = key_of(*arguments, **options)
        if key is None:
            return function(*arguments, **options)
        if key not in known:
            known[key] = pickle.dumps(function(*arguments, **options))
        return pickle.loads(known[key])

    return call


def key_of_text(stream, Loader):
    text = stream if isinstance(stream, (str, bytes)) else stream.read()
    if stream is not text:
        stream.seek(0)
    return text, Loader.__module__, Loader.__qualname__


def places_of(sources):
    """Return the folders of a configuration; None if one is not of this project."""
    places = tuple(each.full_path() for each in sources)
    return places if all(place.startswith(OURS) for place in places) else None


def key_of_file(self, config_path):
    places = places_of(self.sources)
    return places and (config_path, places)


def key_of_list(self, defaults, repo):
    places = places_of(repo.get_sources())
    return places and (places, repr(defaults))


def list_defaults_once(create):
    """Return `defaults_list._create_defaults_list` with a memory for the files of this project.

    The list depends on the files and on the overrides of groups; values change nothing in it.
    """
    known = {}

    def create_known(repo, config_name, overrides, **options):
        places = places_of(repo.get_sources())
        if places is None:
            return create(repo, config_name, overrides, **options)
        values, groups = overrides.config_overrides, vars(overrides)
        overrides.config_overrides = []
        key = (places, config_name, repr(groups), repr(options))
        if key not in known:
            result = create(repo, config_name, overrides, **options)
            known[key] = pickle.dumps((result, groups))
        result, after = pickle.loads(known[key])
        groups |= after | {"config_overrides": values}
        return result

    return create_known


# Hydra reads and merges the same files for every test.
yaml.load = remembered(yaml.load, key_of_text)
ConfigRepository.load_config = remembered(ConfigRepository.load_config, key_of_file)
defaults_list._create_defaults_list = list_defaults_once(defaults_list._create_defaults_list)
ConfigLoaderImpl._compose_config_from_defaults_list = remembered(
    ConfigLoaderImpl._compose_config_from_defaults_list, key_of_list
)
base.parse = functools.lru_cache(maxsize=None)(base.parse)  # the trees of references are only read
# Each export asks for the operations of PyTorch anew.
utils._materialize_cpp_cia_ops = functools.cache(utils._materialize_cpp_cia_ops)
# Hydra copies the registered configurations for every test, and changes none of them.
ConfigStore.__deepcopy__ = lambda self, memo: self
os.fsync = lambda descriptor: None  # no test cuts the power
style.RESOLUTION //= 2  # most tests only look whether there is a picture


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark slow what is not among the fast cases of its table."""
    tables = {}
    for item in items:
        if mark := item.get_closest_marker("fast"):
            tables.setdefault((item.path, item.function), (mark.args, []))[1].append(item)
    for fast, cases in tables.values():
        if isinstance(fast[0], int):
            step = -(-len(cases) // fast[0])
            fast = [case.callspec.id for case in cases[::step]]
        for case in cases:
            if case.callspec.id not in fast:
                case.add_marker("slow")


def pytest_collection_finish():
    """Keep the garbage collector from visiting all imported modules in each of its rounds."""
    gc.freeze()
    gc.set_threshold(50_000, 50, 50)


@pytest.fixture(scope="session")
def levels() -> list[Track]:
    """Return three levels of the authors of the paper, which are not part of this project."""
    missing = [path for path in (LEVELS / f"MAP_{k}.csv" for k in (1, 2, 3)) if not path.exists()]
    if missing:
        pytest.skip(
            f"{missing[0]} does not exist: the levels of the authors are not in the repository"
        )
    return [load_track(LEVELS / f"MAP_{k}.csv", start=(7, -10, 0)) for k in (1, 2, 3)]


@pytest.fixture
def thermostat(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the package of a user importable, as one that is installed."""
    monkeypatch.syspath_prepend(SOURCE)


@pytest.fixture(scope="session")
def ring() -> Track:
    """Return a round track of 31 m, driven anticlockwise."""
    inner, outer = (np.linspace(0, 2 * np.pi, count, endpoint=False) for count in (16, 26))
    left, right = (np.stack([np.cos(turn), np.sin(turn)], axis=1) for turn in (inner, outer))
    return Track("ring", left=3.7 * left, right=6.3 * right)


@pytest.fixture(scope="session")
def rings(ring: Track) -> list[Track]:
    """Return three round tracks with maps that are fast to build."""
    return [Track(f"ring_{size}", size * ring.left, size * ring.right) for size in (1.0, 1.1, 1.2)]
