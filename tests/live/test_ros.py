"""Nodes over DDS and over Zenoh: messages on the wire, names, quality of service, discovery and damage."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, arg
from gmmtorch.export.bag import cloud_fields, transform_fields
from gmmtorch.live.ros import Node, zenoh_middleware
from gmmtorch.live.ros.dds import _settings
from gmmtorch.live.ros.node import reading
from gmmtorch.live.ros.topics import Endpoint, MessageTypes, Quality, dds_type, mismatch, ros_type

pytest.importorskip("rosbags", reason="needs the extra [ros]: rosbags")

from rosbags.typesys import Stores, get_typestore

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


CLOUD, STRING, GRID = "sensor_msgs/msg/PointCloud2", "std_msgs/msg/String", "nav_msgs/msg/OccupancyGrid"
MakeNode = Callable[..., Node]


def wait_until(is_done: Callable[[], bool], *nodes: Node, seconds: float = 30.0) -> None:
    """Spins the nodes until the condition holds."""
    end = time.monotonic() + seconds
    while not is_done():
        assert time.monotonic() < end, "nothing arrived"
        for node in nodes:
            node.spin_once(0.02)


@pytest.fixture
def make_node(ros_options) -> Iterator[MakeNode]:
    """Makes nodes that hear each other, and no other process."""
    nodes = []

    def make(name: str = "test", **more: object) -> Node:
        nodes.append(Node(name, **{**ros_options, **more}))
        return nodes[-1]

    yield make
    for node in nodes:
        node.close()


@pytest.fixture
def node(ros_domain) -> Iterator[Node]:
    """A node over DDS, whose messages a test hands in itself."""
    pytest.importorskip("cyclonedds", reason="needs the extra [ros]: cyclonedds")
    with Node("test", domain=ros_domain) as made:
        yield made


def test_a_cloud_arrives_as_it_was_published(make_node):
    talker, listener = make_node("talker"), make_node("listener")
    received = []
    listener.subscribe("/points", CLOUD, received.append)
    publish = talker.publisher("/points", CLOUD)
    table = np.zeros(20_000, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    table["x"] = np.random.default_rng(0).normal(size=len(table))
    sent = time.monotonic()

    def is_received() -> bool:
        nonlocal sent
        # The first ones may come before the nodes know each other.
        if time.monotonic() > sent and not received:
            publish(cloud_fields("lidar", table), stamp=1_500_000_007)
            sent = time.monotonic() + 0.1
        return bool(received)

    wait_until(is_received, listener)
    message = received[0]
    assert message["header"] == {"stamp": {"sec": 1, "nanosec": 500_000_007}, "frame_id": "lidar"}
    assert message["data"].tobytes() == table.tobytes()
    assert [field["name"] for field in message["fields"]] == ["x", "y", "z"]


def test_a_latched_message_reaches_a_late_subscriber(make_node):
    talker = make_node("talker")
    publish = talker.publisher("/map", GRID)
    publish({"info": {"width": 2, "height": 1, "resolution": 0.5}, "data": np.array([0, 100])})
    time.sleep(0.2)
    listener, received = make_node("listener"), []
    listener.subscribe("/map", GRID, received.append, Quality(latched=True, depth=1))
    wait_until(lambda: bool(received), listener)
    assert received[0]["data"].tolist() == [0, 100]
    assert received[0]["info"]["resolution"] == 0.5


def test_topics_names_and_remapping(make_node):
    talker = make_node("talker", namespace="robot1", remap={"points": "/velodyne_points"})
    listener = make_node("listener", namespace="/robot1/")
    talker.publisher("points", CLOUD)
    talker.publisher("~/state", STRING)
    wanted = {"/velodyne_points": [CLOUD], "/robot1/talker/state": [STRING]}
    wait_until(lambda: wanted.items() <= listener.topics().items(), listener)
    subscription = listener.subscribe("points", CLOUD, lambda _: None)
    assert subscription.topic == "/robot1/points"
    text = listener.explain_silence(subscription)
    assert "topic /robot1/points has no publisher" in text
    assert f"/velodyne_points ({CLOUD})" in text


def test_silence_is_explained_by_type_and_quality(make_node):
    talker, listener = make_node("talker"), make_node("listener")
    talker.publisher("/points", STRING)
    talker.publisher("/tf", "tf2_msgs/msg/TFMessage", Quality(reliable=False))
    wait_until(lambda: {"/points", "/tf"} <= listener.topics().keys(), listener)
    cloud = listener.subscribe("/points", CLOUD, lambda _: None)
    assert f"has messages of type {STRING}, not {CLOUD}" in listener.explain_silence(cloud)
    moving, _ = listener.listen_to_transforms()
    assert "publish it reliable" in listener.explain_silence(moving)


def test_transforms_are_collected(make_node):
    talker, listener = make_node("talker"), make_node("listener")
    listener.listen_to_transforms()
    static, moving = (talker.publisher(name, "tf2_msgs/msg/TFMessage") for name in ("/tf_static", "/tf"))
    static(transform_fields({("base", "lidar"): np.eye(4)}), stamp=0)
    sent = time.monotonic()

    def is_complete() -> bool:
        nonlocal sent
        if time.monotonic() > sent:
            moving(transform_fields({("odom", "base"): np.eye(4)}), stamp=time.time_ns())
            sent = time.monotonic() + 0.1
        return listener.transforms.frames == ["base", "lidar", "odom"]

    wait_until(is_complete, listener)
    assert listener.transforms.chain("lidar") == ["lidar", "base", "odom"]


def test_damaged_messages_and_floods_are_counted(node):
    received = []
    subscription = node.subscribe("/text", STRING, received.append, Quality(depth=3))
    whole = node.types.encode(STRING, {"data": "x" * 10})
    for data in (whole[:9], b"", whole):
        node._receive(subscription, data)
    while node.spin_once():
        pass
    assert subscription.n_malformed == 2
    assert [message["data"] for message in received] == ["x" * 10]
    for _ in range(8):
        node._receive(subscription, whole)
    assert (len(subscription.waiting), subscription.n_dropped) == (3, 5)
    assert node.counts["/text"] == {"received": 11, "dropped": 5, "malformed": 2}


def test_messages_that_are_too_large_are_counted(node, monkeypatch, caplog):
    monkeypatch.setattr("gmmtorch.live.ros.node.MAX_MESSAGE_BYTES", 20)
    subscription = node.subscribe("/text", STRING, lambda _: None)
    for text in ("x" * 40, "x"):
        node._receive(subscription, node.types.encode(STRING, {"data": text}))
    assert (subscription.n_malformed, len(subscription.waiting)) == (1, 1)
    assert "49 bytes are more than 20" in caplog.text


def test_warnings_name_the_options_of_a_command(node, caplog):
    node.option_names = {"clock": "sensor.clock"}
    node.warn("clock", f"set {arg('clock')}=received, or {arg('use_sim_time')}=true")
    assert "set sensor.clock=received, or use_sim_time=true" in caplog.text


@pytest.mark.parametrize(
    ("interface", "multicast", "peers"), [("127.0.0.1", "false", ["127.0.0.1"]), ("eth0", "default", [])]
)
def test_only_this_machine_is_spoken_to_unless_an_interface_is_named(interface, multicast, peers):
    settings = ElementTree.fromstring(_settings(interface, []))
    assert settings.findtext(".//AllowMulticast") == multicast
    assert [peer.get("address") for peer in settings.iter("Peer")] == peers
    (found,) = settings.iter("NetworkInterface")
    assert interface in found.attrib.values()


def test_simulated_time_comes_from_the_clock(ros_domain):
    pytest.importorskip("cyclonedds", reason="needs the extra [ros]: cyclonedds")
    with Node("test", domain=ros_domain, use_sim_time=True) as node:
        assert node.now() == 0
        clock = node.subscriptions[0]
        node._receive(clock, node.types.encode(clock.type, {"clock": {"sec": 3, "nanosec": 5}}))
        assert node.now() == 3_000_000_005


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"name": "a b"}, "name='a b'"),
        ({"namespace": "a//b"}, "namespace="),
        ({"remap": {"/a b": "/c"}}, "topic='/a b'"),
        ({"middleware": "tcp"}, "middleware="),
        ({"domain": 233}, "domain=233"),
        ({"domain": 202, "interface": "nowhere0"}, "interface=nowhere0"),
        ({"middleware": "zenoh", "router": "tcp/127.0.0.1:9"}, "does not answer"),
    ],
)
def test_arguments_that_cannot_be_used_are_refused(options, words):
    pytest.importorskip("cyclonedds", reason="needs the extra [ros]: cyclonedds")
    pytest.importorskip("zenoh", reason="needs the extra [ros]: eclipse-zenoh")
    with pytest.raises(InvalidArgumentError, match=words.replace("(", r"\(")):
        Node(**options)


def test_the_domain_of_the_environment_is_used(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "one")
    with pytest.raises(InvalidArgumentError, match="ROS_DOMAIN_ID='one'"):
        Node("test")


def test_unknown_types_and_names_are_refused(make_node):
    node = make_node()
    with pytest.raises(InvalidArgumentError, match="not a message type"):
        node.publisher("/a", "my_msgs/msg/Thing")
    with pytest.raises(InvalidArgumentError, match="not a name of ROS"):
        node.subscribe("/a b", STRING, lambda _: None)
    assert issubclass(DataError, GmmTorchError)


def test_an_error_of_a_callback_is_raised_and_one_of_a_message_is_counted(node):
    wrong = node.subscribe("/text", STRING, lambda message: message["no such field"])
    unusable = node.subscribe("/name", STRING, reading(lambda message: float(message["data"])))
    whole = node.types.encode(STRING, {"data": "x"})
    node._receive(unusable, whole)
    node.spin_once()
    assert unusable.n_malformed == 1
    node._receive(wrong, whole)
    with pytest.raises(KeyError, match="no such field"):
        node.spin_once()
    assert wrong.n_malformed == 0
