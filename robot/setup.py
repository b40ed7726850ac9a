"""What a policy drives with: the car, the perception, the boundary estimate, the rate of scans.

A policy knows its training only. It expects observations and an effect of its actions as there, so
a car has the values of the training unless it differs itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from coil_rl.envs import (
    HALF_FIELD_OF_VIEW,
    ConeTrackEnv,
    McapReplayEnv,
    Perception,
    SimulatedRobotEnv,
    simulated_cone_classifier,
)
from coil_robot.driver import Car

CLOSE = 1e-4  # relative difference of two lengths that are rounded differently


def shipped_perception() -> Perception:
    """Return the perception of the paper's robot, with the shipped classifier."""
    return Perception(simulated_cone_classifier())


@dataclass(frozen=True)
class Setup:
    """What a policy drives with; by default that of the paper's robot.

    Args:
        car: the car.
        perception: from a scan to cones.
        spline: of the boundary estimate, "cubic" or "quadratic".
        smoothing: lambda of the cubic smoothing spline, m^3 in the scale of the cone world.
        rate: scans per second; None if unknown.
    """

    car: Car = field(default_factory=Car)
    perception: Perception = field(default_factory=shipped_perception)
    spline: Literal["cubic", "quadratic"] = "cubic"
    smoothing: float = 0.1
    rate: float | None = None

    def for_car(self, car: Car) -> Setup:
        """Return the setup for another car that drives alike, in lengths of itself.

        Its view, the cones and its way between two scans are larger by as much as it is longer.
        """
        growth = car.car_length / self.car.car_length
        perception = replace(
            self.perception,
            range_max=self.perception.range_max * growth,
            scale=self.perception.scale / growth,
        )
        faster = car.speed / self.car.speed
        rate = None if self.rate is None else self.rate * faster / growth
        return replace(self, car=car, perception=perception, rate=rate)

    def differences(self, training: Setup) -> list[str]:
        """Return where a policy would see or do something else than in its training.

        Args:
            training: setup of the training, for any car.

        Returns:
            Parts of a sentence, such as "perception.scale=5.0 instead of 7".
        """
        alike = training.for_car(replace(self.car, max_steering=training.car.max_steering))
        texts = []
        for (key, own), trained in zip(self._seen().items(), alike._seen().values(), strict=True):
            numbers = isinstance(own, (int, float)) and isinstance(trained, (int, float))
            same = math.isclose(own, trained, rel_tol=CLOSE) if numbers else own == trained
            if trained is not None and not same:
                number = f"{trained:g}" if numbers else trained
                texts.append(f"{key}={own} instead of {number}")
        return texts

    def _seen(self) -> dict[str, Any]:
        """Return the values on which observations and the effect of actions depend."""
        return {
            "car.max_steering": self.car.max_steering,
            "perception.range_max": self.perception.range_max,
            "perception.bearing_max": self.perception.bearing_max,
            "perception.scale": self.perception.scale,
            "spline": self.spline,
            "smoothing": self.smoothing,
            "rate": self.rate,
        }


def setup_of(plant: object) -> Setup:
    """Return what a policy was trained with; that of the paper's robot where an env has no car.

    The car of the cone world is as long as `Setup().car` in the scale of the perception.

    Args:
        plant: env of the training, such as `Controller.plant`.
    """
    if isinstance(plant, ConeTrackEnv):
        car = Car(max_steering=math.degrees(plant.max_steering))
        scale = plant.car_length / car.car_length
        perception = replace(
            shipped_perception(),
            range_max=plant.sight / scale,
            bearing_max=math.degrees(HALF_FIELD_OF_VIEW),
            scale=scale,
            kept_cones=plant.kept_cones,
        )
        lengths = plant.speed / plant.car_length, car.speed / car.car_length
        rate = plant.rate * lengths[1] / lengths[0]
        return Setup(car, perception, plant.spline, plant.smoothing, rate)
    if isinstance(plant, (SimulatedRobotEnv, McapReplayEnv)):
        car = Car(plant.speed, plant.car_length, math.degrees(plant.max_steering))
        own, memory = plant.perception, plant.memory
        seen = own if isinstance(own, Perception) else shipped_perception()
        known = None if math.isnan(plant.rate) else plant.rate
        return Setup(car, seen, memory.spline, memory.smoothing, known)
    return Setup()
