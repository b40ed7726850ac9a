from omegaconf import OmegaConf

from coil_rl.benchmark.robot import measure_robot
from coil_rl.benchmark.turns import Turns


def test_scans_a_second_of_reading_and_of_perception_at_once_and_one_by_one():
    rows = measure_robot(OmegaConf.create({"seed": 0}), Turns(seconds=0.2, repeats=2, device="cpu"))
    assert [row["what"].split()[0] for row in rows] == ["reading", "perception,", "perception,"]
    assert all(len(row["rounds"]) == 2 and row["scans_per_s"] > 0 for row in rows)
    assert rows[1]["scans_per_s"] > rows[2]["scans_per_s"]
