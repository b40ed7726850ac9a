"""The planner of a Formula Student team as a guide."""

import importlib.util
import math

import pytest
import torch
from tensordict import TensorDict

from coil_rl.cones.cone_planner import ConePlannerGuide
from coil_rl.envs import SimulatedRobotEnv
from coil_rl.testing import check_guide

INSTALLED = importlib.util.find_spec("fsd_path_planning") is not None
needs_planner = pytest.mark.skipif(not INSTALLED, reason="needs ft-fsd-path-planning")


def straight(offset=0.0):
    """Cones of a straight track, 3 m wide, shifted to the left."""
    x = torch.arange(0.0, 12.0, 2.0)
    sides = [torch.stack([x, torch.full_like(x, y + offset)], -1) for y in (1.5, -1.5)]
    cones = torch.stack(sides).unsqueeze(0)
    count = torch.full((1, 2), len(x))
    return TensorDict({"cones": cones, "cone_count": count, "steering": torch.zeros(1, 1)}, [1])


@pytest.mark.skipif(INSTALLED, reason="the planner is installed")
def test_missing_package_is_named_with_its_installation():
    with pytest.raises(ImportError, match="pip install git"):
        ConePlannerGuide()


@needs_planner
def test_guide_steers_for_the_middle():
    guide = ConePlannerGuide()
    assert abs(float(guide(straight())["action"])) < 0.02
    assert float(guide(straight(0.5))["action"]) > 0.02
    assert float(guide(straight(-0.5))["action"]) < -0.02


@needs_planner
def test_steering_stays_where_there_is_no_cone():
    data = straight()
    data["cone_count"] = torch.zeros(1, 2, dtype=torch.int64)
    data["steering"] = torch.full((1, 1), 0.25)
    action = float(ConePlannerGuide()(data)["action"])
    assert math.isfinite(action)


@needs_planner
def test_guide_acts_like_any_other():
    check_guide(ConePlannerGuide(), SimulatedRobotEnv(num_envs=2))
