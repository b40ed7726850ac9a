"""The ROS 2 node, against a stub of the part of rclpy that it uses."""

import importlib
import signal
import sys
from types import ModuleType, SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from coil_robot.driver import HALT, Command

MESSAGES = {
    "geometry_msgs.msg": ("Twist", "TwistStamped"),
    "nav_msgs.msg": ("Odometry",),
    "sensor_msgs.msg": ("LaserScan",),
    "std_msgs.msg": ("String",),
    "std_srvs.srv": ("Trigger",),
}


def message(**values):
    """Return a message as rclpy makes them, with all parts there."""

    def vector():
        return SimpleNamespace(x=0.0, y=0.0, z=0.0)

    twist = SimpleNamespace(linear=vector(), angular=vector())
    header = SimpleNamespace(stamp=SimpleNamespace(sec=3, nanosec=500_000_000), frame_id="")
    parts = {"linear": vector(), "angular": vector(), "twist": twist, "header": header}
    return SimpleNamespace(**(parts | values))


class Node:
    """The part of rclpy.node.Node that is used."""

    parameters: ClassVar[dict] = {}

    def __init__(self, name):
        self.name, self.published, self.timers, self.services, self.topics = name, [], [], {}, {}
        self.warned = []

    def declare_parameter(self, name, value):
        return SimpleNamespace(value=self.parameters.get(name, value))

    def create_subscription(self, kind, topic, callback, qos):
        self.topics[topic] = (kind, callback, qos)

    def create_publisher(self, kind, topic, qos):
        self.topics[topic] = (kind, None, qos)
        return SimpleNamespace(publish=lambda each: self.published.append((topic, each)))

    def create_service(self, kind, name, callback):
        self.services[name] = callback

    def create_timer(self, period, callback, clock):
        self.timers.append((period, callback, clock))

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: "now"))

    def get_logger(self):
        return SimpleNamespace(
            info=lambda text: None, warning=lambda text, once: self.warned.append((text, once))
        )

    def destroy_node(self):
        self.destroyed = True


@pytest.fixture
def ros(monkeypatch):
    """Return the module of the node, with a stub of ROS 2."""

    def stub(name, **values):
        module = ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name, module)

    for name, classes in MESSAGES.items():
        stub(name.partition(".")[0])
        kinds = {"__new__": lambda cls, **values: message(**values)}
        stub(name, **{each: type(each, (), kinds) for each in classes})
    stub("rclpy", try_shutdown=lambda: None)
    steady = SimpleNamespace(STEADY_TIME="steady")
    stub("rclpy.clock", Clock=SimpleNamespace, ClockType=steady)
    stub("rclpy.node", Node=Node)
    latched = SimpleNamespace(TRANSIENT_LOCAL="latched")
    reliable = SimpleNamespace(BEST_EFFORT="best effort", RELIABLE="reliable")
    quality = {"DurabilityPolicy": latched, "ReliabilityPolicy": reliable}
    stub("rclpy.qos", QoSProfile=SimpleNamespace, **quality)
    stub("rclpy.signals", SignalHandlerOptions=SimpleNamespace(NO="none"))
    monkeypatch.delitem(sys.modules, "coil_robot.ros_node", raising=False)
    yield importlib.import_module("coil_robot.ros_node")
    sys.modules.pop("coil_robot.ros_node")


class Driver:
    """A driver that notes what it is told."""

    def __init__(self):
        self.state, self.reason, self.command, self.told = "waiting", "no scan yet", HALT, []

    def scan(self, scan, now):
        self.told.append(("scan", scan, now))
        self.state, self.reason, self.command = "driving", "", Command(0.15, 0.2)
        return self.command

    def odometry(self, speed, turn_rate, now):
        self.told.append(("odometry", speed, turn_rate, now))
        return self.command

    def tick(self, now):
        self.told.append(("tick", now))
        return self.command

    def lift(self, now):
        self.told.append(("lift", now))
        self.state, self.reason, self.command = "waiting", "no scan yet", HALT

    def stop(self, reason, now):
        self.state, self.reason, self.command = "stopped", reason, HALT
        return HALT


def commands(node, topic="/cmd_vel"):
    twists = [each for name, each in node.published if name == topic]
    return [(twist.linear.x, twist.angular.z) for twist in twists]


def laser(ranges, first, last, step):
    """Return a LaserScan with the bearings of its first and last range, and the step."""
    angles = {"angle_min": first, "angle_max": last, "angle_increment": step}
    return message(ranges=ranges, range_min=0.1, range_max=9.0, **angles)


def test_scans_become_commands_and_states_are_published_once(ros):
    driver = Driver()
    node = ros.DriveNode(driver, now=lambda: 7.0)
    assert commands(node) == [(0.0, 0.0)]
    node.topics["/scan"][1](laser([0.5, np.inf, 0.6], -1.0, -0.8, 0.1))
    ((_, given, now),) = driver.told
    assert (given.stamp, given.range_min, given.range_max, now) == (3.5, 0.1, 9.0, 7.0)
    assert np.allclose(given.angles, [-1.0, -0.9, -0.8])
    assert commands(node)[-1] == (0.15, 0.2)
    node.timers[0][1]()
    states = [each.data for name, each in node.published if name == "/coil/state"]
    assert states == ["waiting: no scan yet", "driving"]


@pytest.mark.parametrize(
    "given",
    [
        (-np.pi, np.pi - 2 * np.pi / 360, 2 * np.pi / 361),  # a step for one range too many
        (np.pi - 2 * np.pi / 360, -np.pi, 2 * np.pi / 360),  # exchanged
    ],
)
def test_bearings_are_those_that_are_taken_of_a_recording(ros, given):
    driver = Driver()
    node = ros.DriveNode(driver)
    node.topics["/scan"][1](laser(np.ones(360), *given))
    angles = driver.told[0][1].angles
    np.testing.assert_allclose(angles, np.radians(np.arange(-180, 180)), atol=1e-6)
    ((text, once),) = node.warned
    assert text.startswith("the scanner has an")
    assert once


@pytest.mark.parametrize(("first", "step"), [(np.inf, 0.1), (np.nan, 0.1), (0.0, 0.0)])
def test_bearings_that_mean_nothing_are_left_to_the_driver(ros, first, step):
    driver = Driver()
    ros.DriveNode(driver).topics["/scan"][1](laser(np.ones(3), first, first, step))
    np.testing.assert_array_equal(driver.told[0][1].angles, first + step * np.arange(3))


def test_the_watchdog_has_a_steady_timer_and_topics_their_quality_of_service(ros):
    node = ros.DriveNode(Driver())
    ((period, _, clock),) = node.timers
    assert period <= 0.1
    assert clock.clock_type == "steady"
    assert node.topics["/scan"][2].reliability == "best effort"
    assert node.topics["/scan"][2].depth == 1
    assert node.topics["/cmd_vel"][2].reliability == "reliable"
    assert node.topics["/coil/state"][2].durability == "latched"


def test_parameters_of_ros_override_topics_and_the_type_of_commands(ros, monkeypatch):
    changed = {"scan": "/front/scan", "command": "/drive", "stamped": True}
    monkeypatch.setattr(Node, "parameters", changed)
    node = ros.DriveNode(Driver())
    assert node.topics["/front/scan"][0].__name__ == "LaserScan"
    ((_, first),) = [each for each in node.published if each[0] == "/drive"]
    assert first.header.stamp == "now"
    assert first.twist.linear.x == 0.0


def test_services_lift_and_stop_and_odometry_is_compared(ros):
    driver = Driver()
    node = ros.DriveNode(driver, now=lambda: 1.0)
    motion = message()
    motion.twist.linear.x, motion.twist.angular.z = 0.1, 0.3
    node.topics["/odom"][1](message(twist=motion))
    assert driver.told == [("odometry", 0.1, 0.3, 1.0)]
    answer = node.services["/coil/stop"](None, SimpleNamespace())
    assert (answer.success, answer.message) == (True, "stopped: asked to stop")
    assert node.services["/coil/lift"](None, SimpleNamespace()).message == "waiting: no scan yet"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_last_command_stops_the_car(ros, monkeypatch, number):
    driver, nodes, options = Driver(), [], []

    def spin(node):
        nodes.append(node)
        node.publish(driver.scan(None, 0.0))
        signal.raise_signal(number)

    monkeypatch.setattr(sys.modules["rclpy"], "spin", spin, raising=False)
    monkeypatch.setattr(
        sys.modules["rclpy"], "init", lambda **given: options.append(given), raising=False
    )
    before = signal.getsignal(signal.SIGTERM)
    ros.run_node(driver)
    signal.signal(signal.SIGTERM, before)
    # The handlers of rclpy invalidate the context: nothing can be published after them.
    assert options == [{"signal_handler_options": "none"}]
    assert commands(nodes[0])[-2:] == [(0.15, 0.2), (0.0, 0.0)]
    assert nodes[0].destroyed
