"""Messages of ROS 2: what is written, other libraries read, and what is read quickly is what was written."""

import numpy as np
import pytest
from drives import ODOMETRY, SCAN, TWIST, scan
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from coil_rl.envs.recordings.cdr import decode, definition, encode
from coil_rl.envs.recordings.ros_messages import LaserScan, Odometry, Twist, decoder, header

ROS = get_typestore(Stores.ROS2_HUMBLE)
MARKERS = "visualization_msgs/msg/MarkerArray"
CONE = {
    "header": header(1_500_000_001, "laser"), "ns": "left", "id": 3, "type": 3,
    "pose": {"position": {"x": 1.0, "y": 2.0}, "orientation": {"w": 1.0}},
    "scale": {"x": 0.1, "y": 0.1, "z": 0.2}, "color": {"r": 1.0, "g": 1.0, "a": 1.0}, "frame_locked": True,
    "points": [{"x": 1.0}, {"y": 2.0}], "text": "a cone",
}  # fmt: skip
WHOLE = [scan(1).to_bytes(), Odometry(7, 1.0, 2.0, 0.5).to_bytes(), Twist(0.15, 0.1).to_bytes()]

stamps = st.integers(0, 2**31 * 10**9 - 1)
frames = st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=9)
metres = st.floats(-1e6, 1e6)


@given(stamps, frames, st.lists(st.floats(width=32), max_size=9))
def test_scan_is_read_back(stamp, frame, ranges):
    written = LaserScan(stamp, -3.0, 0.25, 0.125, 12.0, np.array(ranges, np.float32), 0.5, frame)
    data = written.to_bytes()
    again = decoder(SCAN)(data)
    np.testing.assert_array_equal(again.ranges, written.ranges)
    assert again._replace(ranges=None) == written._replace(ranges=None)
    slowly = decode(SCAN, data)
    assert slowly["header"]["frame_id"] == frame
    np.testing.assert_array_equal(slowly["ranges"], written.ranges)


@given(stamps, frames, metres, metres, st.floats(-3.1, 3.1))
def test_odometry_is_read_back(stamp, frame, x, y, heading):
    written = Odometry(stamp, x, y, heading, 0.15, -0.5, frame)
    again = decoder(ODOMETRY)(written.to_bytes())
    assert again.heading == pytest.approx(heading, abs=1e-12)
    assert again._replace(heading=heading) == written


def test_command_is_read_back():
    assert decoder(TWIST)(Twist(0.15, -0.5).to_bytes()) == Twist(0.15, -0.5)


def test_another_library_reads_what_is_written():
    turn = scan(3)
    theirs = ROS.deserialize_cdr(turn.to_bytes(), SCAN)
    np.testing.assert_array_equal(theirs.ranges, turn.ranges)
    assert theirs.header.frame_id == "laser"
    assert theirs.angle_max == pytest.approx(3.1241, abs=1e-6)
    place = ROS.deserialize_cdr(Odometry(7, 1.0, 2.0, 0.5).to_bytes(), ODOMETRY).pose.pose
    assert (place.position.x, place.position.y, place.orientation.z) == (1.0, 2.0, np.sin(0.25))
    assert ROS.deserialize_cdr(Twist(0.15, -0.5).to_bytes(), TWIST).angular.z == -0.5
    [marker, empty] = ROS.deserialize_cdr(encode(MARKERS, {"markers": [CONE, {}]}), MARKERS).markers
    assert (marker.ns, marker.text, marker.frame_locked, marker.points[1].y) == ("left", "a cone", True, 2.0)
    assert (empty.ns, empty.pose.position.x) == ("", 0.0)


def test_markers_are_read_back():
    [marker] = decode(MARKERS, encode(MARKERS, {"markers": [CONE]}))["markers"]
    assert marker["header"]["stamp"] == {"sec": 1, "nanosec": 500_000_001}
    assert marker["points"][1] == {"x": 0.0, "y": 2.0, "z": 0.0}
    assert {key: marker[key] for key in ("ns", "id", "type", "text")} == {
        key: CONE[key] for key in ("ns", "id", "type", "text")
    }


@pytest.mark.parametrize("kind", [SCAN, ODOMETRY, TWIST, MARKERS, "std_msgs/msg/Bool", "std_msgs/msg/Float64"])
def test_definitions_are_those_of_ros(kind):
    theirs, _ = ROS.generate_msgdef(kind, ros_version=2)
    fields = [line for line in theirs.splitlines() if "=" not in line or line.startswith("====")]
    assert definition(kind).decode().splitlines() == [line for line in fields if line]


@pytest.mark.parametrize(("kind", "data"), list(zip([SCAN, ODOMETRY, TWIST], WHOLE, strict=True)))
def test_message_of_another_length_is_refused(kind, data):
    for cut in range(len(data)):
        for read in (decoder(kind), lambda short: decode(kind, short)):
            with pytest.raises(ValueError, match=r"shorter|begins with"):
                read(data[:cut])
    for read in (decoder(kind), lambda long: decode(kind, long)):
        with pytest.raises(ValueError, match="longer"):
            read(data + b"\0\0\0\0")


def test_another_byte_order_is_refused():
    with pytest.raises(ValueError, match="begins with the bytes 00 00 00 00, not 00 01"):
        decoder(TWIST)(b"\0\0\0\0" + bytes(48))


def test_what_does_not_exist_is_refused():
    with pytest.raises(ValueError, match=r"no message type 'std_msgs/msg/Int'.*std_msgs/msg/Bool"):
        encode("std_msgs/msg/Int", {})
    with pytest.raises(ValueError, match=r"no field \['speed'\]; it has linear, angular"):
        encode(TWIST, {"speed": 1.0})
    with pytest.raises(ValueError, match="takes 36 numbers, not 2"):
        encode(ODOMETRY, {"pose": {"covariance": [1.0, 2.0]}})
