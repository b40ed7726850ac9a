import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torchrl.record.loggers import TensorboardLogger

from coil_rl.errors import UserError
from coil_rl.train.metrics import Metrics

ROWS = [{"frames": 10 * update, "loss": 1 / update, "return": float("nan")} for update in range(1, 6)]


def written(path, rows, logger=None):
    metrics = Metrics(path, logger)
    for row in rows:
        metrics.append(row)
    return metrics


@pytest.mark.parametrize("torn", [b"", b"60,0.1", b"60,0.1,nan\r\n70"])
@pytest.mark.parametrize("count", [0, 1, 3, 5])
def test_what_goes_on_after_a_checkpoint_is_what_was_never_stopped(tmp_path, count, torn):
    whole, stopped = tmp_path / "whole.csv", tmp_path / "stopped.csv"
    written(whole, ROWS)
    written(stopped, ROWS)
    with stopped.open("ab") as file:
        file.write(torn)
    again = Metrics(stopped)
    assert str(again.keep(count)) == str([{k: float(v) for k, v in row.items()} for row in ROWS[:count]])
    for row in ROWS[count:]:
        again.append(row)
    assert stopped.read_bytes() == whole.read_bytes()


def test_rows_that_are_gone_are_missed(tmp_path):
    written(tmp_path / "metrics.csv", ROWS[:2])
    with pytest.raises(UserError, match="has 2 of the 3 rows that belong to the checkpoint"):
        Metrics(tmp_path / "metrics.csv").keep(3)
    with pytest.raises(UserError, match="has 0 of the 1 rows"):
        Metrics(tmp_path / "other.csv").keep(1)


@pytest.mark.parametrize("count", [0, 3])
def test_tensorboard_shows_no_point_twice(tmp_path, count):
    path = tmp_path / "metrics.csv"
    written(path, ROWS, TensorboardLogger("board", str(tmp_path))).flush()
    again = Metrics(path, TensorboardLogger("board", str(tmp_path)))
    again.keep(count)
    for row in ROWS[count:]:
        again.append(row)
    again.flush()
    points = EventAccumulator(str(tmp_path / "board")).Reload().Scalars("loss")
    assert [point.step for point in points] == [10, 20, 30, 40, 50]
