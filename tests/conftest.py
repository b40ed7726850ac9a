from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import settings

from coil_rl.envs import Track, load_track

LEVELS = Path(__file__).resolve().parents[2] / "shared" / "tracks"

# The tensors here are tiny: a second thread only waits for the first.
torch.set_num_threads(1)
settings.register_profile("deterministic", derandomize=True, deadline=None)
settings.load_profile("deterministic")


@pytest.fixture(scope="session")
def levels() -> list[Track]:
    """Three levels of the paper's authors, which this project may not ship."""
    missing = [path for path in (LEVELS / f"MAP_{k}.csv" for k in (1, 2, 3)) if not path.exists()]
    if missing:
        pytest.skip(f"{missing[0]} is not here: the authors' levels lie beside the repository, not in it")
    return [load_track(LEVELS / f"MAP_{k}.csv", start=(7, -10, 0)) for k in (1, 2, 3)]


@pytest.fixture(scope="session")
def ring() -> Track:
    """A round track driven anticlockwise, 31 m a lap: the shortest way to a lap."""
    inner, outer = np.linspace(0, 2 * np.pi, 16, endpoint=False), np.linspace(0, 2 * np.pi, 26, endpoint=False)
    left, right = (np.stack([np.cos(turn), np.sin(turn)], axis=1) for turn in (inner, outer))
    return Track("ring", left=3.7 * left, right=6.3 * right)
