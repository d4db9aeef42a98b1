"""Datagrams of records other than components, and announcements. See docs/messages.md."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, check_whole
from gmmtorch.mapping import (
    LARGEST_COUNT,
    NO_COUNT,
    BitReader,
    BitWriter,
    count_steps,
    has_channels,
    ids_of_batch,
)
from gmmtorch.occupancy import N_BYTES, Calibration
from gmmtorch.team.sharing.messages.datagrams import (
    FARTHEST,
    MAX_BYTES,
    Kind,
    is_motion,
    make_datagram,
    matrix_of,
    motion_dim,
    parse_datagram,
    read_intervals,
    read_keys,
    read_motion,
    read_number,
    split,
    write_intervals,
    write_keys,
    write_motion,
    write_number,
)
from gmmtorch.team.sharing.replica.record_keys import (
    CHANNELS,
    END,
    LARGEST_INCARNATION,
    LARGEST_ROBOT,
    NUMBER_BITS,
    WORLD,
    Intervals,
    Ints,
    author_of,
    first_key,
    keys_of,
    keys_of_robot,
    robot_of,
)

_OTHER_RECORDS = {Kind.SUPERSESSION, Kind.COUNTERS, Kind.CORRECTION, Kind.FRAME, Kind.CALIBRATION}
RECORD_KINDS = frozenset({Kind.COMPONENTS} | _OTHER_RECORDS)
"""Kinds of datagrams that contain records."""
RECORD_BYTES = 1000
"""Longest record. A datagram of 1200 bytes has room for it and for encryption."""


def check_size(max_bytes: int) -> None:
    """Raise `InvalidArgumentError` unless datagrams of at most `max_bytes` have room for any record."""
    if not RECORD_BYTES <= check_whole("max_bytes", max_bytes, 0) <= MAX_BYTES:
        raise InvalidArgumentError(f"max_bytes={max_bytes} must be from {RECORD_BYTES} to {MAX_BYTES}.")


@dataclass(frozen=True, eq=False)
class SupersessionMessage:
    """Record `key`: where all of `new` is held, `old` no longer counts. All are keys of one robot."""

    key: int
    old: Intervals
    new: Intervals


@dataclass(frozen=True, eq=False)
class CountersMessage:
    """Record `key`: all points that its author has assigned to each of the components with these keys (J,).

    steps (J,): logarithmic, as in `mapping.codec.quantization`. Of two counters of a component the larger is
    the later.
    """

    key: int
    components: Ints
    steps: Ints


@dataclass(frozen=True, eq=False)
class CorrectionMessage:
    """Record `key`: moves the components `moved` (keys) of one scan of the robot by `pose`.

    pose: the rigid motion from the published to the corrected position. 2D: translation and (cos, sin) of the
    yaw (4,); 3D: translation and unit quaternion x, y, z, w (7,). Of two corrections of one scan the one with
    the higher version counts, then the one with the higher key.
    """

    key: int
    scan: int
    version: int
    moved: Intervals
    pose: Tensor

    @property
    def dim(self) -> int:
        return motion_dim(self.pose)

    def transform(self) -> Tensor:
        """The motion (D+1, D+1)."""
        return matrix_of(self.pose)


@dataclass(frozen=True, eq=False)
class FrameMessage:
    """Record `key`: the pose of a frame of the robot in another frame. A frame is named by the author whose
    records are in it, robot · 2²⁴ + incarnation.

    anchor: the frame in which `pose` is; `WORLD`; or `frame` itself while no other is known.
    pose: anchor ← frame, as in `CorrectionMessage`; None if the anchor is the frame itself. Of two records of
    one frame the one with the higher version counts, then the one with the higher key.
    """

    key: int
    frame: int
    version: int
    anchor: int
    pose: Tensor | None

    @property
    def dim(self) -> int | None:
        return None if self.pose is None else motion_dim(self.pose)


@dataclass(frozen=True, eq=False)
class CalibrationMessage:
    """Record `key`: how probabilities follow from the evidence of its robot's map. Of two records of a robot
    the one with more predictions counts, then the one with the higher key."""

    key: int
    calibration: Calibration


RecordMessage = SupersessionMessage | CountersMessage | CorrectionMessage | FrameMessage | CalibrationMessage


def encode_record(record: RecordMessage) -> bytes:
    """The datagram of a record. The caller must check that it has at most `RECORD_BYTES`. Raises
    `InvalidArgumentError` for a record that `decode` would refuse."""
    _check(record)
    writer = BitWriter()
    writer.number(record.key)
    base = first_key(robot_of(record.key))
    if isinstance(record, SupersessionMessage):
        write_intervals(writer, record.old, base)
        write_intervals(writer, record.new, base)
        return make_datagram(Kind.SUPERSESSION, writer.to_bytes())
    if isinstance(record, CountersMessage):
        order = np.argsort(record.components)
        write_keys(writer, record.components[order])
        writer.column(record.steps[order])
        return make_datagram(Kind.COUNTERS, writer.to_bytes())
    if isinstance(record, CalibrationMessage):
        writer.fixed(np.frombuffer(record.calibration.to_bytes(), np.uint8).astype(np.int64), 8)
        return make_datagram(Kind.CALIBRATION, writer.to_bytes())
    if isinstance(record, FrameMessage):
        for value in (record.frame & LARGEST_INCARNATION, record.version, record.anchor + 1):
            write_number(writer, "version", value)
        if record.pose is not None:
            write_motion(writer, record.pose)
        return make_datagram(Kind.FRAME, writer.to_bytes())
    write_number(writer, "scan", record.scan)
    write_number(writer, "version", record.version)
    write_motion(writer, record.pose)
    write_intervals(writer, record.moved, base)
    return make_datagram(Kind.CORRECTION, writer.to_bytes())


def read_record(kind: Kind, body: bytes) -> RecordMessage:
    """The record in the body of a datagram of its kind."""
    reader = BitReader(body)
    key = reader.number()
    if not 0 <= key < END:
        raise DataError(f"Record {key} is out of range: it is damaged.")
    (own,) = keys_of_robot(robot_of(key)).pairs()
    record: RecordMessage
    if kind is Kind.SUPERSESSION:
        record = SupersessionMessage(key, read_intervals(reader, *own), read_intervals(reader, *own))
    elif kind is Kind.COUNTERS:
        components = read_keys(reader)
        record = CountersMessage(key, components, reader.column(len(components)))
    elif kind is Kind.CORRECTION:
        scan, version, pose = read_number(reader), read_number(reader), read_motion(reader)
        record = CorrectionMessage(key, scan, version, read_intervals(reader, *own), pose)
    elif kind is Kind.FRAME:
        incarnation, version, anchor = (read_number(reader) for _ in range(3))
        if incarnation > LARGEST_INCARNATION:
            raise DataError(f"Record {key} is of incarnation {incarnation}: it is damaged.")
        frame = author_of(first_key(robot_of(key), incarnation))
        at = None if anchor - 1 == frame else read_motion(reader)
        record = FrameMessage(key, frame, version, anchor - 1, at)
    else:
        record = CalibrationMessage(key, Calibration.of_bytes(bytes(reader.fixed(N_BYTES, 8).tolist())))
    reader.finish()
    _check(record)
    return record


def _check(record: RecordMessage) -> None:
    """Raise `InvalidArgumentError` if a record is invalid."""
    key = record.key
    if not 0 <= key < END:
        raise InvalidArgumentError(f"key={key} is out of range: keys go from 0 to {END - 1}.")
    mine = keys_of_robot(robot_of(key))
    if isinstance(record, SupersessionMessage):
        old, new = record.old, record.new
        if not old or key in old or key in new or old & new or not mine.covers(old | new):
            raise InvalidArgumentError(
                f"Record {key} supersedes {old!r} by {new!r}: it must supersede at least one record of "
                "its robot by others of that robot; itself in neither set, and no record in both."
            )
    elif isinstance(record, CountersMessage):
        keys, steps = record.components, record.steps
        if len(np.unique(keys)) != len(keys) or len(steps) != len(keys):
            raise InvalidArgumentError(
                f"Record {key} has {len(steps)} counters of {keys.tolist()}; each component needs one."
            )
        if len(keys) and not 0 <= int(keys.min()) <= int(keys.max()) < END:
            raise InvalidArgumentError(
                f"Record {key} counts points of components whose keys are out of range."
            )
        if len(keys) and not NO_COUNT <= int(steps.min()) <= int(steps.max()) <= LARGEST_COUNT:
            raise InvalidArgumentError(f"Record {key} counts from {steps.min()} to {steps.max()} steps.")
    elif isinstance(record, FrameMessage):
        _check_frame(record)
    elif isinstance(record, CalibrationMessage):
        _check_calibration(record)
    elif not (is_motion(record.pose) and mine.covers(record.moved)):
        raise InvalidArgumentError(
            f"Record {key} corrects {record.moved!r} by {record.pose.tolist()}: it must move components "
            f"of its robot, by up to {FARTHEST:g} m on each axis and a rotation of unit length."
        )


def _check_frame(record: FrameMessage) -> None:
    """Raise `InvalidArgumentError` unless the frame is one of the robot, and the pose is in another one."""
    key, pose = record.key, record.pose
    is_own = robot_of(record.frame << NUMBER_BITS) == robot_of(key)
    is_known = WORLD <= record.anchor < END >> NUMBER_BITS
    if not (is_own and is_known and (pose is None) == (record.anchor == record.frame)):
        raise InvalidArgumentError(
            f"Record {key} puts frame {record.frame} into frame {record.anchor}: it must put a frame of its "
            "robot into another one, or have no pose."
        )
    if pose is not None and not is_motion(pose):
        raise InvalidArgumentError(
            f"Record {key} has the pose {pose.tolist()}: it must be up to {FARTHEST:g} m from the origin on "
            "each axis, with a rotation of unit length."
        )


def _check_calibration(record: CalibrationMessage) -> None:
    """Raise `InvalidArgumentError` unless the calibration is the same after encoding."""
    try:
        is_same = Calibration.of_bytes(record.calibration.to_bytes()) == record.calibration
    except (DataError, ValueError, OverflowError):
        is_same = False
    if not is_same:
        raise InvalidArgumentError(
            f"Record {record.key} has the calibration {record.calibration}: its numbers must be in range, "
            "and rounded as those of `Calibrator.calibration`."
        )


def counters_message(key: int, points: dict[int, float]) -> CountersMessage:
    """Record `key` with the points of components by their keys, rounded as counts are."""
    components = np.array(sorted(points), np.int64)
    counts = torch.tensor([points[int(component)] for component in components], dtype=torch.float64)
    return CountersMessage(key, components, count_steps(counts))


@dataclass(frozen=True, eq=False)
class AnnouncementMessage:
    """Of the keys from `begin` to `end` − 1, this incarnation of robot `sender` holds exactly `held`. Keys of
    channels are below zero, others are not."""

    sender: int
    incarnation: int
    begin: int
    end: int
    held: Intervals

    @property
    def scope(self) -> Intervals:
        return Intervals.span(self.begin, self.end)


_TO_THE_LAST = -1  # in place of the length less one, of keys up to the last


def encode_announcements(
    sender: int, incarnation: int, held: Intervals, max_bytes: int = MAX_BYTES, lowest: int = 0
) -> list[bytes]:
    """Datagrams of all keys that are held, at least one; each covers another range, so any may be lost.
    lowest: 0, or `CHANNELS` for keys of channels. Raises `InvalidArgumentError` for values out of range."""
    _check_sender(sender, incarnation)
    if not Intervals.span(lowest, lowest + END).covers(held):
        raise InvalidArgumentError(f"held={held!r} goes beyond the largest key, {lowest + END - 1}.")
    n = len(held)

    def part(begin: int, end: int) -> bytes:
        first = int(held.edges[2 * begin]) if begin else lowest
        last = int(held.edges[2 * end]) - 1 if end < n else lowest + END - 1
        writer = BitWriter()
        for name, value in (("sender", sender), ("incarnation", incarnation)):
            write_number(writer, name, value)
        writer.number(first)
        writer.number(_TO_THE_LAST if end >= n else last - first)
        write_intervals(writer, Intervals(held.edges[2 * begin : 2 * end]), first)
        return make_datagram(Kind.ANNOUNCEMENT, writer.to_bytes())

    return split(n, part, "interval", max_bytes) if n else [part(0, 0)]


def read_announcement(body: bytes) -> AnnouncementMessage:
    reader = BitReader(body)
    sender, incarnation = read_number(reader), read_number(reader)
    _check_sender(sender, incarnation)
    begin, length = reader.number(), reader.number()
    lowest = CHANNELS if begin < 0 else 0
    end = lowest + END if length == _TO_THE_LAST else begin + length + 1
    if not lowest <= begin < end <= lowest + END:
        raise DataError(f"An announcement of the keys from {begin} to {end}: it is damaged.")
    held = read_intervals(reader, begin, end)
    reader.finish()
    return AnnouncementMessage(sender, incarnation, begin, end, held)


def _check_sender(sender: int, incarnation: int) -> None:
    if sender > LARGEST_ROBOT or incarnation > LARGEST_INCARNATION:
        raise InvalidArgumentError(
            f"sender={sender}, incarnation={incarnation}: robots go up to {LARGEST_ROBOT}, incarnations "
            f"up to {LARGEST_INCARNATION}."
        )


def keys_in(datagram: bytes) -> Intervals:
    """The keys of the records in a datagram that a replica has sent or merged.

    Raises `DataError` if it is no datagram of `RECORD_KINDS`.
    """
    kind, body = parse_datagram(datagram)
    if kind is Kind.COMPONENTS:
        keys = Intervals.of(keys_of(ids_of_batch(body)))
        return keys | keys.shifted(CHANNELS) if has_channels(body) else keys
    if kind not in RECORD_KINDS:
        raise DataError(f"A datagram of kind {int(kind)} has no records.")
    key = BitReader(body).number()
    return Intervals.span(key, key + 1)
