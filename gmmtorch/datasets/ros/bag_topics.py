"""What is in a bag: the topics with their rates, gaps and clocks, and what each of them is good for."""

from __future__ import annotations

import struct
from array import array
from typing import NamedTuple

import numpy as np

from gmmtorch.datasets.ros.bag_reader import (
    IMU_TYPE,
    INFO_TYPE,
    NAME,
    POSE_TYPES,
    TF_TYPES,
    BagReader,
    Topic,
    sensors,
)
from gmmtorch.datasets.trajectory import NANOSECONDS

_HEADER_STAMP, _TF_STAMP = 4, 8  # bytes before the stamp of a header, and of the first transform


class TopicFacts(NamedTuple):
    """A topic of a bag.

    topic: its name, type and number of messages. use: what gmmtorch can do with it; "" if nothing.
    rate: messages per second; None with fewer than two. gap: the longest time (s) between two messages.
    offset: seconds from the stamp of a message to its recording, the median; None without stamps.
    """

    topic: Topic
    use: str
    rate: float | None
    gap: float | None
    offset: float | None


class BagFacts(NamedTuple):
    """The topics of a bag by name, times (ns) of its first and last message, and what damage has taken."""

    topics: list[TopicFacts]
    first: int
    last: int
    damage: str


def bag_facts(reader: BagReader) -> BagFacts:
    """The facts of a bag, from one pass over all of its messages. Raises `DataError` if it is damaged."""
    keys = [(topic.name, topic.type) for topic in reader.topics]
    places = {(name, kind): _stamp_place(reader, name, kind) for name, kind in keys}
    times = {key: array("q") for key in keys}
    offsets = {key: array("q") for key in keys}
    for message in reader.messages({name for name, _ in keys}):
        key = message.topic, message.type
        times[key].append(message.time)
        place, data = places[key], message.data
        if place is not None and len(data) >= place + 8:
            order = ">" if not reader.is_ros1 and data[1] == 0 else "<"
            seconds, nanoseconds = struct.unpack_from(f"{order}II", data, place)
            offsets[key].append(message.time - seconds * NANOSECONDS - nanoseconds)
    uses = _uses(reader)
    found = [
        _facts(topic, uses.get(topic, ""), times[key], offsets[key])
        for topic, key in zip(reader.topics, keys, strict=True)
    ]
    ends = [(min(one), max(one)) for one in times.values() if one]
    first, last = (min(end[0] for end in ends), max(end[1] for end in ends)) if ends else (0, 0)
    return BagFacts(found, first, last, reader.damage)


def _facts(topic: Topic, use: str, times: array[int], offsets: array[int]) -> TopicFacts:
    steps = np.diff(np.sort(np.array(times, np.int64))) / NANOSECONDS
    total = float(steps.sum())
    rate = len(steps) / total if total > 0 else None
    offset = float(np.median(np.array(offsets, np.int64))) / NANOSECONDS if offsets else None
    return TopicFacts(topic, use, rate, float(steps.max()) if rate else None, offset)


def _stamp_place(reader: BagReader, topic: str, message_type: str) -> int | None:
    """The byte at which messages have the stamp of a measurement; None if they have none."""
    if topic.endswith("static"):
        return None
    if message_type in TF_TYPES:
        return _TF_STAMP
    fields = reader.fields(message_type)
    return _HEADER_STAMP if fields and fields[0][1] == (NAME, "std_msgs/msg/Header") else None


def _uses(reader: BagReader) -> dict[Topic, str]:
    found = {sensor.topic: f"scans ({sensor.kind})" for sensor in sensors(reader)}
    for topic in reader.topics:
        if not topic.n_messages:
            found[topic] = ""
        elif topic.type in TF_TYPES:
            found[topic] = "poses (TF)"
        elif topic.type in POSE_TYPES:
            found[topic] = f"poses, if ‹poses›={topic.name}"
        elif topic.type == IMU_TYPE:
            found[topic] = "turns, if ‹motion›=imu"
        elif topic.type == INFO_TYPE:
            found[topic] = "camera of depth images"
    return found
