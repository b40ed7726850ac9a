"""A simulated robot with a LiDAR, and the perception of cones in its scans."""

from typing import TYPE_CHECKING

from coil_rl.lazy import lazy_names

if TYPE_CHECKING:
    from coil_rl.envs.robot import clusters as clusters
    from coil_rl.envs.robot.clusters import FEATURES as FEATURES
    from coil_rl.envs.robot.clusters import points_of as points_of
    from coil_rl.envs.robot.course import THICK as THICK
    from coil_rl.envs.robot.course import THIN as THIN
    from coil_rl.envs.robot.course import RobotCourse as RobotCourse
    from coil_rl.envs.robot.course import laps as laps
    from coil_rl.envs.robot.course import middle_line as middle_line
    from coil_rl.envs.robot.course import track_notes as track_notes
    from coil_rl.envs.robot.drives import SPEED as SPEED
    from coil_rl.envs.robot.drives import SimulatedDrive as SimulatedDrive
    from coil_rl.envs.robot.drives import labelled_drive as labelled_drive
    from coil_rl.envs.robot.drives import record_labelling_drives as record_labelling_drives
    from coil_rl.envs.robot.drives import track_of as track_of
    from coil_rl.envs.robot.lidar import RANGE_MAX as RANGE_MAX
    from coil_rl.envs.robot.lidar import RANGE_MIN as RANGE_MIN
    from coil_rl.envs.robot.perception import BoundaryMemory as BoundaryMemory
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
