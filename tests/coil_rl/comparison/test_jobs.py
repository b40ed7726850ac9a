"""The progress bar of the trainings of a comparison."""

import pytest

from coil_rl.comparison.jobs import Tick, show_progress
from coil_rl.output import progress


@pytest.mark.parametrize("updates", [3, 7, 10, 49])
def test_bar_ends_at_its_total_whatever_the_shares_add_up_to(updates):
    with progress(total=8) as bar:
        for job in range(8):
            tick = Tick(bar)
            for update in range(1, updates + 1):
                assert tick.due(update, updates, {"frames": 1.0})
                tick.after_update(update)
                assert bar.n == job + update / updates
            show_progress(bar, job + 1)
        assert bar.n == 8
