"""The path planner of a Formula Student team as a guide.

ft-fsd-path-planning (FaSTTUBe, MIT) finds a path between coloured cones, also where one side is
hidden. A pure pursuit follows its path: the car steers along the arc through a point ahead.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from coil_rl.ranges import Degrees, Positive, checked

INSTALL = "pip install git+https://github.com/papalotis/ft-fsd-path-planning.git"


@checked
class ConePlannerGuide(TensorDictModuleBase):
    """Pure pursuit of the path that ft-fsd-path-planning finds through the visible cones.

    The planner knows only the cones that are visible now. Where it finds no path, the steering
    stays as it is. It plans for one car after the other, some milliseconds each.

    Args:
        look_ahead: m, distance of the point of the path that the car steers for.
        car_length: m, between the axles.
        max_steering: degrees of an action of 1, at most 90.

    Raises:
        ImportError: without the package.
        ValueError: for a value outside its range.
    """

    in_keys, out_keys = ["cones", "cone_count", "steering"], ["action"]

    def __init__(
        self,
        look_ahead: Positive = 2.0,
        car_length: Positive = 2.0,
        max_steering: Degrees = 80.0,
    ) -> None:
        super().__init__()
        self.look_ahead, self.car_length = look_ahead, car_length
        self.max_steering = math.radians(max_steering)
        try:
            import fsd_path_planning  # type: ignore[import-not-found, unused-ignore]
        except ImportError as error:
            raise ImportError(f"fsd_path_planning is missing: {INSTALL}") from error
        self.package: Any = fsd_path_planning

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action`: [*batch, 1], fraction of the maximal steering."""
        batch = tensordict.batch_size
        flat = tensordict.select(*self.in_keys).reshape(-1)
        cones, count = flat["cones"].double().cpu().numpy(), flat["cone_count"].cpu().numpy()
        action = flat["steering"].clone()
        for row, (own, numbers) in enumerate(zip(cones, count, strict=True)):
            angle = self._angle(own[0, : numbers[0]], own[1, : numbers[1]])
            if angle is not None:
                action[row] = min(max(angle / self.max_steering, -1.0), 1.0)
        return tensordict.set("action", action.reshape(*batch, 1))

    def _angle(self, left: NDArray[np.float64], right: NDArray[np.float64]) -> float | None:
        """Return the steering angle in radians, None without a path.

        Args:
            left: [N, 2] m, cones in the car's frame.
            right: [M, 2] m.
        """
        kinds = self.package.ConeTypes
        cones = [np.zeros((0, 2)) for _ in kinds]
        cones[kinds.LEFT], cones[kinds.RIGHT] = left, right
        # A new planner each time: an old one returns its last path where it finds none.
        planner = self.package.PathPlanner(self.package.MissionTypes.trackdrive)
        try:
            path = planner.calculate_path_in_global_frame(cones, np.zeros(2), np.array([1.0, 0.0]))
        except Exception:  # the planner raises almost anything for cones it cannot sort
            return None
        points = path[np.isfinite(path).all(axis=1) & (path[:, 1] > 0), 1:3]
        if not len(points):
            return None
        distance = np.hypot(*points.T)
        x, y = points[np.abs(distance - self.look_ahead).argmin()]
        curvature = 2 * y / (x * x + y * y)
        return math.asin(min(max(curvature * self.car_length, -1.0), 1.0))
