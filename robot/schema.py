"""Typed root configurations of `coil-replay` and `coil-drive`."""

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING
from pydantic import Field

from coil_rl import NodeConfig
from coil_rl.for_guests import PolicyConfig, WhichPolicy, one_of, typed_as


@dataclass
class ReplayConfig(PolicyConfig):
    """Configuration of `coil-replay`."""

    recording: Any = MISSING
    runs: list[str] = field(default_factory=list)
    policy: WhichPolicy = "handed_over"
    frame: str | None = None
    strict: bool = False
    preset: dict[str, Any] = MISSING
    env: dict[str, Any] = MISSING
    guide: dict[str, Any] = field(default_factory=dict)


@dataclass
class SimulationConfig(NodeConfig):
    """Length of a drive of `coil-drive` on the simulated robot, in seconds and laps."""

    seconds: Annotated[float, Field(gt=0, le=10**6)] = 140.0
    laps: Annotated[int, Field(ge=1, le=10**6)] = 3


@dataclass
class RosConfig(NodeConfig):
    """Parameters of the node of ROS 2, see `coil_robot.ros_node.DriveNode`."""

    scan: str = "/scan"
    odometry: str = "/odom"
    command: str = "/cmd_vel"
    stamped: bool = False


@dataclass
class DriveConfig(PolicyConfig):
    """Configuration of `coil-drive`."""

    run: str | None = None
    controller: dict[str, Any] = field(default_factory=dict)
    policy: WhichPolicy = "handed_over"
    where: Annotated[str, one_of("simulation", "recording", "ros")] = "simulation"
    recording: str | None = None
    scan: str = "/scan"
    frame: str | None = None
    strict: bool = False
    rate: Annotated[float | None, Field(gt=0)] = None
    car: dict[str, Any] = MISSING
    perception: dict[str, Any] = MISSING
    spline: Annotated[str | None, typed_as(Literal["cubic", "quadratic"] | None)] = None
    smoothing: Annotated[float | None, Field(ge=0)] = None
    limits: dict[str, Any] = field(default_factory=dict)
    simulation: SimulationConfig = field(default_factory=SimulationConfig)
    ros: RosConfig = field(default_factory=RosConfig)
    lift_after: Annotated[float | None, Field(ge=0)] = None


_store = ConfigStore.instance().store
_store(name="replay_schema", node=ReplayConfig)
_store(name="drive_schema", node=DriveConfig)
