import pytest

from coil_rl.schedules import Linear, schedule


def test_linear_interpolates_and_then_is_constant():
    line = Linear(2.0, 1.0, until=0.5)
    assert [schedule(line)(progress) for progress in (0, 0.25, 0.5, 1)] == [2.0, 1.5, 1.0, 1.0]
    assert schedule(3.0)(0) == schedule(3.0)(1) == 3.0
    with pytest.raises(ValueError, match="until=0 must be more than 0"):
        Linear(0, 1, until=0)
