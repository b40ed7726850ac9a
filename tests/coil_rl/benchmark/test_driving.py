import torch

from coil_rl.benchmark.driving import Driving
from coil_rl.envs import ConeTrackEnv


def test_driving_counts_steps_and_resets(ring):
    driving = Driving(ConeTrackEnv([ring], 4))
    assert driving() == 4
    driving.until_some_crash()
    assert driving.steps == 0
    for _ in range(60):
        driving()
    assert 0 < driving.resets < 1
    assert driving.resets * 240 == int(driving.ended)


def test_a_car_that_crashed_drives_on_from_the_start(ring):
    driving = Driving(ConeTrackEnv([ring], 1)).until_some_crash()
    start = driving.env.start_observation[:, 0]
    torch.testing.assert_close(driving.state["observation"][0], start)
