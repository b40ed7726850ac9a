"""A policy drives with what it was trained with."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from drives import SplineDriver, drive

from coil_rl.envs import (
    ConeTrackEnv,
    McapReplayEnv,
    Perception,
    SimulatedRobotEnv,
    shipped_tracks,
    simulated_cone_classifier,
)
from coil_robot import Car, Limits, LiveDriver, Scan, Setup, setup_of

AUTHORS = {"range_max": 1.25, "bearing_max": 120.0, "scale": 5.625}


def seen(setup):
    perception = setup.perception
    return perception.range_max, perception.bearing_max, perception.scale


def test_observations_are_those_of_the_training():
    perception = Perception(simulated_cone_classifier(), **AUTHORS)
    options = {"spline": "quadratic", "max_steering": 60.0, "assignment": "cyclic"}
    env = SimulatedRobotEnv(perception=perception, **options)
    setup, moments = setup_of(env), []
    limits, settings = Limits(setup.rate), {"spline": setup.spline, "smoothing": setup.smoothing}
    driver = LiveDriver(
        SplineDriver(), setup.perception, limits, setup.car, **settings, log=moments.append
    )
    assert driver.car.max_steering == pytest.approx(60)
    state = env.reset()
    for index in range(8):
        scan = Scan(index / env.rate, env.scan[0].numpy().copy(), env.lidar.angles.numpy())
        driver.scan(scan, (index + 1) / env.rate)
        np.testing.assert_array_equal(moments[-1].observation, state["observation"][0])
        state = env.step_mdp(env.step(state.set("action", torch.zeros(1, 1))))


def test_a_car_of_the_cone_world_is_the_papers_robot_in_its_scale():
    env = ConeTrackEnv(shipped_tracks("train"), 1, rate=12, max_steering=70.0, smoothing=0.2)
    setup = setup_of(env)
    assert seen(setup) == pytest.approx((1.0, 60.0, 7.0))
    assert setup.car == replace(Car(), max_steering=setup.car.max_steering)
    assert (setup.car.max_steering, setup.smoothing) == (pytest.approx(70), 0.2)
    assert setup.rate == pytest.approx(6.3)
    longer = setup.for_car(Car(speed=0.3, car_length=0.4))
    assert seen(longer) == pytest.approx((1.4, 60.0, 5.0))
    assert longer.perception.sight == pytest.approx(env.sight)
    assert longer.rate == pytest.approx(9.0)


def test_setup_of_a_replay_is_that_of_its_robot_at_the_rate_of_its_scans(tmp_path):
    perception = Perception(simulated_cone_classifier(), laser_yaw=180.0)
    options = {"speed": 0.3, "car_length": 0.6, "max_steering": 40.0, "smoothing": 0.3}
    env = McapReplayEnv(drive(tmp_path / "a.mcap", 3), perception, **options)
    setup = setup_of(env)
    car = setup.car
    assert (car.speed, car.car_length, car.max_steering) == (0.3, 0.6, pytest.approx(40))
    assert (setup.perception, setup.smoothing) == (perception, 0.3)
    assert setup.rate == pytest.approx(1 / env.recordings[0].turn)


def test_differences_are_named_and_rounding_is_none():
    trained = Setup(rate=5.5)
    assert replace(trained, rate=5.5001).differences(trained) == []
    other = replace(trained, spline="quadratic", rate=6.0, car=Car(max_steering=40.0))
    assert other.differences(trained) == [
        "car.max_steering=40.0 instead of 80",
        "spline=quadratic instead of cubic",
        "rate=6.0 instead of 5.5",
    ]
    assert trained.differences(Setup()) == []  # no rate is known
    assert trained.for_car(Car(0.3, 0.6)).differences(trained) == []
