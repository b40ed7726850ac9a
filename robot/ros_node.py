"""A `LiveDriver` as a ROS 2 node: the only file that imports rclpy and its messages.

ROS 2 brings them (`source /opt/ros/DISTRO/setup.bash`); they are not on PyPI.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String
from std_srvs.srv import Trigger

from coil_rl.envs.recordings.bearings import Angles, bearings
from coil_robot.driver import HALT, Command, LiveDriver
from coil_robot.watchdog import Scan

TICK = 0.05  # s, of the watchdog and of the commands


class DriveNode(Node):
    """Subscribes to the scans and the odometry, and publishes commands and the driver's state.

    All callbacks run in one thread. The watchdog has a timer of a steady clock, so neither
    `use_sim_time` nor a change of the system's time stops it.

    Args:
        driver: of the car.
        scan: topic of the LiDAR; a parameter of the node, as the others.
        odometry: topic of the odometry.
        command: topic of the commands.
        stamped: whether commands are TwistStamped messages.
        now: returns the s of a steady clock.
    """

    def __init__(
        self,
        driver: LiveDriver,
        *,
        scan: str = "/scan",
        odometry: str = "/odom",
        command: str = "/cmd_vel",
        stamped: bool = False,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__("coil_drive")
        self.driver, self.now = driver, now
        given = {"scan": scan, "odometry": odometry, "command": command, "stamped": stamped}
        values = {name: self.declare_parameter(name, each).value for name, each in given.items()}
        self.stamped = bool(values["stamped"])
        # The newest message only: an old scan is worse than none. A driver of a LiDAR publishes
        # best effort or reliable; a best-effort subscription gets both.
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        reliable = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
        latched = QoSProfile(
            depth=1,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
        self.create_subscription(LaserScan, values["scan"], self.on_scan, newest)
        self.create_subscription(Odometry, values["odometry"], self.on_odometry, newest)
        kind = TwistStamped if self.stamped else Twist
        self.commands = self.create_publisher(kind, values["command"], reliable)
        self.states = self.create_publisher(String, "/coil/state", latched)
        self.create_service(Trigger, "/coil/lift", self.on_lift)
        self.create_service(Trigger, "/coil/stop", self.on_stop)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(TICK, self.on_tick, clock=steady)
        self.said = ""
        self.publish(HALT)

    def on_scan(self, message: Any) -> None:
        """Drive by a scan."""
        stamp = message.header.stamp
        ranges = np.asarray(message.ranges, np.float32)
        angles = self._bearings(message, ranges.size)
        seconds = stamp.sec + stamp.nanosec * 1e-9
        scan = Scan(seconds, ranges, angles, message.range_min, message.range_max)
        self.publish(self.driver.scan(scan, self.now()))

    def _bearings(self, message: Any, points: int) -> NDArray[np.float64]:
        """Return the bearings of a scan, [P] radians, by the rules for recordings.

        The first doubt about what a scanner says of its bearings is logged. Those that mean nothing
        are returned as it says them, and the driver refuses the scan.
        """
        given = Angles(message.angle_min, message.angle_max, message.angle_increment)
        first, step = given.first, given.step
        try:
            ((first, step),), doubts = bearings([given], np.array([points]))
        except ValueError as error:
            doubts = [f"has bearings that mean nothing: {error}"]
        if doubts:
            self.get_logger().warning(f"the scanner {doubts[0]}", once=True)
        return np.asarray(first + step * np.arange(points), np.float64)

    def on_odometry(self, message: Any) -> None:
        """Compare the measured motion with the commands."""
        motion = message.twist.twist
        self.publish(self.driver.odometry(motion.linear.x, motion.angular.z, self.now()))

    def on_tick(self) -> None:
        """Let the watchdog look between the scans, and repeat the command."""
        self.publish(self.driver.tick(self.now()))

    def on_lift(self, request: Any, response: Any) -> Any:
        """Lift a stop: the car waits for a first valid scan again."""
        self.driver.lift(self.now())
        return self._answered(response)

    def on_stop(self, request: Any, response: Any) -> Any:
        """Stop the car until it is lifted."""
        self.publish(self.driver.stop("asked to stop", self.now()))
        return self._answered(response)

    def _answered(self, response: Any) -> Any:
        response.success, response.message = True, self._state()
        self.publish(self.driver.command)
        return response

    def _state(self) -> str:
        driver = self.driver
        return f"{driver.state}: {driver.reason}" if driver.reason else driver.state

    def publish(self, command: Command) -> None:
        """Publish a command, and the state if it is a new one."""
        message = TwistStamped() if self.stamped else Twist()
        twist = message.twist if self.stamped else message
        if self.stamped:
            message.header.stamp = self.get_clock().now().to_msg()
        twist.linear.x, twist.angular.z = command
        self.commands.publish(message)
        state = self._state()
        if state != self.said:
            self.said = state
            self.states.publish(String(data=state))
            self.get_logger().info(state)


def run_node(driver: LiveDriver, **options: Any) -> None:
    """Drive until Ctrl-C or SIGTERM, then publish a stop.

    The handlers of rclpy would invalidate the context first, after which nothing can be published.

    Args:
        options: those of `DriveNode`.
    """
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    node = DriveNode(driver, **options)
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.publish(driver.stop("the node ends", node.now()))
        node.destroy_node()
        rclpy.try_shutdown()
