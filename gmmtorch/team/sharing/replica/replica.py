"""Replica: one robot's copy of a map that a team shares over networks that lose datagrams."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, check_whole
from gmmtorch.mapping import Components, GaussianMap, has_channels
from gmmtorch.occupancy import Calibration
from gmmtorch.pose import Pose
from gmmtorch.scan import ArrayLike
from gmmtorch.team.sharing.messages.component_messages import ComponentsMessage
from gmmtorch.team.sharing.messages.datagrams import MAX_BYTES
from gmmtorch.team.sharing.messages.message_registry import Message, decode
from gmmtorch.team.sharing.messages.record_messages import (
    AnnouncementMessage,
    CalibrationMessage,
    CorrectionMessage,
    FrameMessage,
    RecordMessage,
    SupersessionMessage,
    check_size,
    encode_announcements,
)
from gmmtorch.team.sharing.replica.anti_entropy import ABOUT_A_DATAGRAM, FEW, Backlog, packets
from gmmtorch.team.sharing.replica.authorship import Author, MovedMap, Published
from gmmtorch.team.sharing.replica.materialized_view import Changes, Placement, robot_of_frame
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
    authors,
    drawn_incarnation,
    first_key,
    ids_of,
    keys_of,
    robot_of,
)
from gmmtorch.team.sharing.replica.records import MOST_COMPONENTS, Records, RefusedError


class Replica:
    """A set of records that merges with those of other robots in any order, until all are equal.

        replica.add(map)                                      # when the map has learned
        for datagram in replica.datagrams(): broadcast(datagram)        # often
        for datagram in replica.announcements(): broadcast(datagram)    # every second or so
        for datagram in received: replica.receive(datagram)
        replica.map()

    A lost record is sent again, by any robot that holds it, when an announcement shows that it is missing.
    See docs/replica.md.

    Attributes:
        refused: number of datagrams that were not merged, by reason: "damaged", "other" (valid, but of no
            kind that a replica merges), "duplicate_id", "full", "unfit" (another dimension, or too large to
            be sent again), "own" (an announcement of this robot).
        duplicates: by robot id, how often a datagram showed that two robots use it.
    """

    def __init__(
        self,
        robot: int,
        *,
        dim: int | None = None,
        incarnation: int | None = None,
        most_components: int = MOST_COMPONENTS,
        own_frame: bool = False,
        channels: Collection[str] | None = None,
    ) -> None:
        """Args:
        robot: id of the robot, up to 1023; unique in the team.
        dim: 2 or 3; None: that of the first components.
        incarnation: number of this start of the robot, up to 2²⁴ − 1, which must not be used twice. None:
            drawn.
        most_components: limit on the components; this robot's own are always added.
        own_frame: whether positions are in a frame of this robot, which `join` places, and not in `WORLD`.
        channels: names of the channels of attributes that this robot shares; None: all of its map.
        """
        self.robot = check_whole("robot", robot, 0, LARGEST_ROBOT)
        number = drawn_incarnation() if incarnation is None else incarnation
        self.incarnation = check_whole("incarnation", number, 0, LARGEST_INCARNATION)
        if dim not in (None, 2, 3):
            raise InvalidArgumentError(f"dim={dim} must be 2 or 3, or None.")
        self._own = author_of(first_key(self.robot, self.incarnation))
        self._records = Records(dim, check_whole("most_components", most_components, 1), self._own)
        self._author = Author(self._records, self.robot, self.incarnation)
        self._backlog = Backlog(self.robot)
        self._channels = channels
        self.refused: Counter[str] = Counter()
        self.duplicates: Counter[int] = Counter()
        if own_frame:
            self._backlog.add(self._author.place_frame(self._own, self._own, None))

    def add(self, new: GaussianMap | Components, supersedes: ArrayLike | None = None) -> Tensor:
        """Write new records of this robot; returns their ids (K, 2).

        Of a map: what is new or has changed since the last call; what it no longer has is superseded, as by
        `publish`. Of components: all, with new ids; they supersede this robot's components `supersedes`
        (J, 2) where all of the new ones are held. Raises `InvalidArgumentError` for components that cannot be
        stored, and for other robots' records.
        """
        if isinstance(new, GaussianMap):
            if supersedes is not None:
                raise InvalidArgumentError("supersedes is for components: a map shows what it no longer has.")
            components = Components.empty(self._records.dim or 3) if new.dim is None else new.components()
            if bool((components.ids[:, 0] != self.robot).any()):
                robots = sorted({int(robot) for robot in components.ids[:, 0]})
                raise InvalidArgumentError(
                    f"The map has components of robots {robots}, this is robot={self.robot}: make the map "
                    f"with robot={self.robot}, or give components."
                )
            if new.query_options.calibration is not None:
                self.calibrate(new.query_options.calibration)
            return self.publish(components, whole=False)
        old = Intervals.empty() if supersedes is None else Intervals.of(_keys("supersedes", supersedes))
        return self._due(self._author.publish(self._checked(new), old))

    def publish(self, components: Components, *, whole: bool, moved: MovedMap | None = None) -> Tensor:
        """Make this robot's records those of its own map; returns the ids (K, 2) of new ones.

        Components are compared by content: those published already, also before a restart, are not written
        again; those published by this replica and no longer in the map are superseded. Components given to
        `add` directly are not affected.

        whole: also supersede what was published before a restart and is not in the map. moved: how corrected
        poses have moved the map. A component published where it was before is corrected, as by `correct`.
        """
        if not len(components) and not self.n_components:
            return ids_of(np.zeros(0, np.int64))
        if moved is not None:
            moved = moved._replace(before=self._checked(moved.before))
        return self._due(self._author.publish_map(self._checked(components), whole, moved))

    def count(self, gains: Mapping[tuple[int, int], float]) -> None:
        """Add points that components (robot, sequence), of any robot, have gained since the last call."""
        keys = _keys("gains", torch.tensor(list(gains), dtype=torch.int64).reshape(-1, 2))
        self._backlog.add(self._author.count(dict(zip(keys.tolist(), gains.values(), strict=True))))

    def correct(self, scan: int, transform: ArrayLike, ids: ArrayLike) -> None:
        """Correct the pose of a scan of this robot, which moves the scan's components `ids` (J, 2) from where
        they were added by `transform` (D+1, D+1), rigid. The last correction of a scan counts, no product."""
        check_whole("scan", scan, 0)
        matrix = torch.as_tensor(transform, dtype=torch.float64)
        if self._records.dim not in (None, len(matrix) - 1):
            raise InvalidArgumentError(
                f"transform has shape {tuple(matrix.shape)}; the map is {self._records.dim}-dimensional."
            )
        self._backlog.add(self._author.correct(scan, matrix, Intervals.of(_keys("ids", ids))))

    def calibrate(self, calibration: Calibration) -> None:
        """Say how probabilities follow from the evidence of this robot's map, if it has learned much since it
        said so last."""
        self._backlog.add(self._author.calibrate(calibration))

    def join(self, frame: int, transform: ArrayLike) -> None:
        """Place the frame of this robot in another frame; its components, also later ones, move with it.

        Of several calls the last one counts. A robot joins frames of robots with a lower id, `WORLD`, or its
        own of an earlier start, so that chains of frames end. Raises `InvalidArgumentError` for others.

        frame: one of `other_frames`, or the one joined before. transform: (D+1, D+1), rigid, frame ← the
        frame in which this robot adds components.
        """
        frames, base = self._records.frames, self._own
        while (anchor := frames.anchor(base)) is not None and robot_of_frame(anchor) == self.robot:
            base = anchor  # an earlier start of this robot, whose records move, too
        is_earlier = robot_of_frame(frame) == self.robot and frame != base
        if not (frame >= WORLD and (robot_of_frame(frame) < self.robot or is_earlier)):
            raise InvalidArgumentError(
                f"frame={frame} is of robot {robot_of_frame(frame)}; robot {self.robot} joins frames of "
                "robots with a lower id only, so that two robots never join each other."
            )
        matrix = torch.as_tensor(transform, dtype=torch.float64)
        back = Pose.from_matrix(self._chain(base, len(matrix))).inverse()
        self._backlog.add(self._author.place_frame(base, frame, matrix @ back.matrix))

    def _chain(self, base: int, size: int) -> Tensor:
        """The motion (size, size), base ← this robot's frame."""
        if base == self._own:
            return torch.eye(size, dtype=torch.float64)
        whole, rest = (self._records.frames.place(frame).transform for frame in (self._own, base))
        assert whole is not None  # its frame has an anchor
        return whole if rest is None else Pose.from_matrix(rest).inverse().matrix @ whole

    def _due(self, made: Published) -> Tensor:
        keys, written = made
        self._backlog.add(written)
        return ids_of(keys)

    def datagrams(self, max_bytes: int = MAX_BYTES, budget: int | None = None) -> list[bytes]:
        """Datagrams of the records that are due: new ones, and those that other robots lack.

        max_bytes: largest size of a datagram, from 1000 to 1200. budget: largest size of all together; None:
        no limit. Other records stay due: supersessions and corrections are sent first, then components by
        their information, then counters.
        """
        check_size(max_bytes)
        left = np.inf if budget is None else check_whole("budget", budget, 0)
        sent: list[bytes] = []
        sent_keys = Intervals.empty()
        self._backlog.due -= self._records.known_dead
        for datagram, keys in packets(self._records, self._backlog.due, max_bytes, budget is not None):
            left -= len(datagram)
            if left < 0:
                break
            sent.append(datagram)
            sent_keys |= keys
        self._backlog.sent(sent_keys)
        return sent

    def announcements(self, max_bytes: int = MAX_BYTES) -> list[bytes]:
        """Datagrams that list the records of this robot. Others answer with those that it lacks."""
        check_size(max_bytes)
        self._backlog.announcing()
        records = self._records
        found = encode_announcements(self.robot, self.incarnation, records.held, max_bytes)
        if records.hears_channels:  # first, so that components are sent once, with their channels
            channels = records.known & Intervals.span(CHANNELS, CHANNELS + END)
            found = encode_announcements(self.robot, self.incarnation, channels, max_bytes, CHANNELS) + found
        return found

    def receive(self, datagram: bytes, message: Message | None = None) -> bool:
        """Merge a datagram; returns whether it was valid and merged. Never raises.

        message: the result of `decode(datagram)`, if the caller has it.
        """
        return self._try(lambda: self._merge(datagram, message))

    def _try(self, merge: Callable[[], None]) -> bool:
        """Whether `merge` succeeds; if not, the reason is counted."""
        try:
            merge()
        except RefusedError as refusal:
            self.refused[refusal.reason] += 1
            if refusal.reason == "duplicate_id":
                self.duplicates[refusal.robot] += 1
            return False
        except GmmTorchError:
            self.refused["damaged"] += 1
            return False
        return True

    def _merge(self, datagram: bytes, message: Message | None) -> None:
        if not isinstance(datagram, bytes):
            raise RefusedError("damaged", -1, f"A datagram is {type(datagram).__name__}, not bytes.")
        message = decode(datagram) if message is None else message
        if isinstance(message, AnnouncementMessage):
            self._check_sender(message)
            self._records.hears_channels |= message.begin < 0
            self._backlog.announced(message, self._records.known, self._records.known_dead)
        elif isinstance(message, ComponentsMessage) and datagram[:1] == _QUANTIZED:
            self._check_keys(keys_of(message.components.ids))
            complete = has_channels(datagram[1:2])
            self._backlog.received(self._records.add_components(message.components, complete=complete))
        elif isinstance(message, RecordMessage):
            self._check_keys(np.array([message.key]))
            if isinstance(message, SupersessionMessage) and message.key not in self._author.written:
                # An earlier incarnation cannot know the records of this one.
                self._check_id((message.old | message.new) & self._author.keys)
            self._backlog.received(self._records.add_record(message))
        else:
            raise RefusedError("other", -1, f"{type(message).__name__} is no record.")

    def _check_sender(self, message: AnnouncementMessage) -> None:
        """Refuse an announcement with this robot's id. It is an echo, or from an earlier incarnation; or from
        a second robot with this id, if another incarnation holds records of this one."""
        if message.sender == self.robot:
            self._check_id(message.incarnation != self.incarnation and message.held & self._author.written)
            raise RefusedError("own", self.robot, "An announcement of this robot.")

    def _check_keys(self, keys: Ints) -> None:
        """Only this robot gives keys of its incarnation."""
        self._check_id((self._author.keys - self._author.written).contains(keys).any())

    def _check_id(self, is_duplicate: object) -> None:
        if is_duplicate:
            raise RefusedError("duplicate_id", self.robot, f"Another robot uses the id {self.robot}.")

    def digest(self) -> bytes:
        """16 bytes, equal for equal contents in any order of arrival."""
        return self._records.digest()

    def components(self, frame: int | None = None) -> Components:
        """The components that count, by id, with the points of all counters, moved by the corrections: those
        placed in `frame`, one of `other_frames`; None: relative to this robot's, in `placement.root`."""
        return self._records.components(frame)

    @property
    def placement(self) -> Placement:
        """Where the frame is in which this robot adds components."""
        return self._records.frames.place(self._own)

    @property
    def is_corrected(self) -> bool:
        """Whether this robot has corrected a scan, also before a restart."""
        return any(robot_of(record.key) == self.robot for record in self._records.of(CorrectionMessage))

    @property
    def earlier_frames(self) -> list[int]:
        """Frames of earlier starts of this robot. A robot that continues in one of them joins it."""
        frames = (record.frame for record in self._records.of(FrameMessage))
        return sorted({f for f in frames if robot_of_frame(f) == self.robot} - {self._own})

    @property
    def other_frames(self) -> list[int]:
        """Frames with components that this robot may join; first the one that all robots prefer. Authors
        whose first record is missing are left out: it says whether they have a frame of their own."""
        records = self._records
        keys = records.table.keys()
        keys = keys[records.held.contains(authors(keys) << NUMBER_BITS)]
        mine = robot_of_frame(records.root)
        limit = mine + (records.root != WORLD and mine == self.robot)
        roots = records.frames.roots(keys) - {records.root}
        return sorted(root for root in roots if robot_of_frame(root) < limit)

    def changes(self) -> Changes:
        """What was added since the last call, by this robot or others, in time proportional to it. All
        `added` and `gained` together are `components()`; where `rebuilt` is True, read these again."""
        return self._records.changes()

    @property
    def calibration(self) -> Calibration | None:
        """How probabilities follow from the evidence of the team: of each robot's calibration that rests on
        the most predictions, the mean. None if no robot has written one."""
        best: dict[int, CalibrationMessage] = {}
        for record in self._records.of(CalibrationMessage):  # by key
            known = best.get(robot_of(record.key))
            if known is None or record.calibration.n_predicted >= known.calibration.n_predicted:
                best[robot_of(record.key)] = record
        return Calibration.merged([record.calibration for record in best.values()]) if best else None

    def map(self, **options: Any) -> GaussianMap:
        """The components as a new map, with the calibration of the team; `options` as for `GaussianMap`."""
        if options.get("prior") is None:
            options.setdefault("calibration", self.calibration)
        if not len(self._records.table):
            return GaussianMap(robot=self.robot, **options)
        return GaussianMap.of(self.components(), robot=self.robot, **options)

    @property
    def held(self) -> Intervals:
        """Keys of all records that this robot holds or that were superseded. Announcements list them."""
        return self._records.held

    @property
    def known(self) -> Intervals:
        """`held`, with the keys of channels, which are below zero, if a robot of the team knows channels."""
        return self._records.known

    @property
    def missing(self) -> Intervals:
        """Keys of records that other robots have announced and that this robot lacks. Robots without a recent
        announcement are left out: see `anti_entropy.PATIENCE`. Keys of channels are below zero."""
        return self._backlog.missing(self._records.known)

    @property
    def is_complete(self) -> bool:
        """Whether this robot holds all records that their authors gave before others that it holds."""
        begins = self.held.edges[::2]
        return bool((begins == authors(begins) << NUMBER_BITS).all())

    @property
    def waits(self) -> bool:
        """Whether what is due fills less than a datagram, so that it takes fewer bytes together with more."""
        return self._backlog.due.size < ABOUT_A_DATAGRAM

    @property
    def is_little(self) -> bool:
        """Whether what is due is so little that a datagram of it would take a quarter of its bytes for what
        the records of a datagram share; and nobody waits for it."""
        return 0 < self._backlog.due.size < FEW and not self._backlog.is_asked

    @property
    def version(self) -> int:
        """Rises with every change of `held`."""
        return self._records.version

    @property
    def n_components(self) -> int:
        """Number of components that are held."""
        return len(self._records.table)

    def stored(self) -> tuple[list[bytes], list[bytes]]:
        """All records that count, for a `Store`: codec batches of components, and datagrams of the others."""
        return self._records.stored()

    def load(self, batches: Iterable[bytes], datagrams: Iterable[bytes]) -> int:
        """Add records that `stored` returned before a restart, and datagrams that were sent or merged since;
        returns how many were refused, as damaged or without room. Loaded records are not due, but are sent to
        robots that lack them."""
        refused, duplicates = self.refused.copy(), self.duplicates.copy()
        merges = [partial(self._records.load_batch, data, self.robot) for data in batches]
        merges += [partial(self._load_datagram, data) for data in datagrams]
        n_refused = sum(not self._try(merge) for merge in merges)
        self.refused, self.duplicates = refused, duplicates  # which count received datagrams only
        return n_refused

    def _load_datagram(self, datagram: bytes) -> None:
        if datagram[:1] == _QUANTIZED:
            self._records.load_batch(datagram[1:], self.robot)
            return
        message = decode(datagram)
        if not isinstance(message, RecordMessage):
            raise DataError(f"{type(message).__name__} is no record.")
        self._records.add_record(message, bounded=robot_of(message.key) != self.robot)

    def _checked(self, components: Components) -> Components:
        components = components.checked()
        if self._records.dim not in (None, components.dim):
            raise InvalidArgumentError(
                f"The components are {components.dim}-dimensional; this map is in {self._records.dim}D."
            )
        if self._channels is not None:
            components = replace(components, attributes=components.attributes.only(self._channels))
        return components.on_cpu()


_QUANTIZED = b"\x11"  # first byte of a datagram of components that every robot encodes equally


def _keys(name: str, ids: ArrayLike) -> Ints:
    rows = torch.as_tensor(ids)
    rows = rows if rows.numel() else rows.reshape(0, 2)
    if rows.ndim != 2 or rows.shape[1] != 2 or rows.is_floating_point():
        raise InvalidArgumentError(f"{name} has shape {tuple(rows.shape)}; expected (J, 2) whole numbers.")
    try:
        return keys_of(rows.long())
    except DataError as error:
        raise InvalidArgumentError(f"{name}: {error}") from error
