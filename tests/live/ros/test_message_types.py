"""Messages of ROS 2: CDR against the serializer of rosbags, names on the wire, and hashes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("rosbags", reason="needs the extra [ros]: rosbags")

from rosbags.typesys import Stores, get_typestore

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.live.ros import zenoh_middleware
from gmmtorch.live.ros.topics import Endpoint, MessageTypes, Quality, dds_type, mismatch, ros_type

TYPES = MessageTypes()
STORE = get_typestore(Stores.ROS2_JAZZY)
LASER = "sensor_msgs/msg/LaserScan"


@settings(max_examples=30, deadline=None)
@given(
    st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9),
    st.lists(st.floats(width=32, allow_nan=False), max_size=7),
)
def test_cdr_equals_the_serializer_of_rosbags(frame, ranges):
    cdr = TYPES.encode(LASER, {"header": {"frame_id": frame}, "ranges": ranges, "range_max": 5.0}, stamp=7)
    message = STORE.deserialize_cdr(cdr, LASER)
    assert bytes(STORE.serialize_cdr(message, LASER)) == cdr
    assert (message.header.frame_id, message.header.stamp.nanosec) == (frame, 7)
    decoded = TYPES.decode(cdr, LASER)
    assert np.array_equal(decoded["ranges"], message.ranges)
    assert (decoded["range_max"], decoded["header"]["frame_id"]) == (5.0, frame)


def test_cut_messages_are_refused():
    cdr = TYPES.encode(LASER, {"ranges": np.arange(9.0)})
    for length in range(0, len(cdr), 3):
        with pytest.raises(DataError):
            TYPES.decode(cdr[:length] if length < len(cdr) - 4 else b"", LASER)


def test_every_type_becomes_a_dds_type():
    pytest.importorskip("cyclonedds", reason="needs the extra [ros]: cyclonedds")
    from gmmtorch.live.ros.dds import IdlTypes

    idl = IdlTypes(TYPES.definitions)
    for name in (
        "sensor_msgs/msg/PointCloud2",
        "visualization_msgs/msg/MarkerArray",
        "nav_msgs/msg/Odometry",
    ):
        made = idl.type(name)
        made.__idl__.populate()
        made.__idl__.fill_type_data()
        cdr = TYPES.encode(name, {})
        assert made.__idl__.deserialize(cdr) is not None  # the structure is that of the message
        assert made.__idl_typename__ == dds_type(name)


def test_names_on_the_wire():
    assert dds_type("sensor_msgs/msg/Image") == "sensor_msgs::msg::dds_::Image_"
    assert ros_type("sensor_msgs::msg::dds_::Image_") == "sensor_msgs/msg/Image"
    assert ros_type("other::Image") is None
    with pytest.raises(InvalidArgumentError):
        dds_type("Image")


def test_the_hash_of_a_type_is_that_of_ros():
    assert TYPES.type_hash("std_msgs/msg/String") == (
        "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    )


def test_keys_of_rmw_zenoh():
    """The keys that the documentation of rmw_zenoh gives for a talker."""
    key = zenoh_middleware.message_key(0, "/chatter", "std_msgs/msg/String", "RIHS01_ab")
    assert key == "0/chatter/std_msgs::msg::dds_::String_/RIHS01_ab"
    endpoint = Endpoint("/chatter", "std_msgs/msg/String", Quality(depth=7), True)
    token = zenoh_middleware.endpoint_token(2, "8b20", 10, "/", "talker", endpoint, "RIHS01_ab")
    assert token == (
        "@ros2_lv/2/8b20/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/RIHS01_ab/::,7:,:,:,,"
    )
    assert zenoh_middleware.parsed_token(token) == endpoint
    for quality in (Quality(False, False, 5), Quality(True, True, 1), Quality(depth=42)):
        assert zenoh_middleware.parsed_quality(zenoh_middleware.quality_text(quality)) == quality
    for damaged in ("", "a/b", token.replace("MP", "SS"), token.replace("dds_", "")):
        assert zenoh_middleware.parsed_token(damaged) is None
    assert zenoh_middleware.attachment(5, 6, bytes(16)) == b"\5" + bytes(7) + b"\6" + bytes(
        7
    ) + b"\x10" + bytes(16)


def test_qualities_match_by_the_rules_of_dds():
    best_effort, reliable = Quality(reliable=False), Quality()
    assert mismatch(reliable, best_effort) is None
    assert "publish it reliable" in mismatch(best_effort, reliable)
    assert "publish it transient local" in mismatch(reliable, Quality(latched=True))
