import mmap

import pytest

from coil_rl.benchmark.fresh import forget_peak, peak_memory, state_bytes_per_car
from coil_rl.envs import ConeTrackEnv


def test_state_is_all_that_grows_with_the_cars(ring):
    # 20 past actions, a pose and 20 numbers of samples alone are 172 bytes.
    assert 172 < state_bytes_per_car() < 2000
    env = ConeTrackEnv([ring], 16)
    assert all(16 in buffer.shape for name, buffer in env.named_buffers() if name in ("pose", "history", "known"))


def test_peak_of_memory_can_be_forgotten():
    forget_peak()
    before = peak_memory()
    if before is None:
        pytest.skip("this system does not say how much memory a process holds")
    with mmap.mmap(-1, 64 * 2**20) as ballast:  # not from the heap, which may have as much to spare
        for page in range(0, len(ballast), mmap.PAGESIZE):
            ballast[page] = 1
        assert peak_memory() - before > 32 * 2**20
    forget_peak()
    assert peak_memory() - before < 32 * 2**20
