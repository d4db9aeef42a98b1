"""MapBuilder: builds a map from a data set, scan by scan, and continues after a stop. WindowMotions: how
corrected poses of scans move a map.

The scans of a window are learned together, so its components move together: by the correction of the pose of
the window's middle scan. A component states the sensor origins that observed it. It belongs to the window of
the origin that observed most of its points, also after it was merged with components of other windows.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from gmmtorch.datasets import Dataset
from gmmtorch.errors import DAMAGED_CONTENT, DataError, GmmTorchError, InvalidArgumentError
from gmmtorch.files import joined_tensors, pack_tensors, read_tensors, split_tensors, write_bytes
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.tiles.tiled_map import TiledMap
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan

_KIND, _VERSION = "gmmtorch.map_builder", 1
_N_ROWS = 20  # rows of the history of a complete run, at most; each encodes the whole map


@dataclass(frozen=True)
class BuildProgress:
    """The state of a map while it is built.

    n_read: scans read so far. n_total: all scans. n_skipped: scans that were read and could not be used.
    n_points: returns in the map. n_components: final components. metres: length of the first sensor's path.
    seconds: computing time of all runs so far. nbytes: size of the map at the last row of the history, 0
    before the first one. It is not computed more often, because this encodes the map.
    """

    n_read: int
    n_total: int
    n_skipped: int
    n_points: int
    n_components: int
    metres: float
    seconds: float
    nbytes: int


@dataclass
class BuildRecord:
    """The state of a builder, besides its map.

    n_read: scans that were read. indices: of the scans in the map. n_points: their returns. metres: length of
    the path through their origins. skipped: number of scans left out while reading, by the reason. history:
    rows of (n_read, n_components, nbytes, metres, seconds, memory_bytes) at the ends of windows. seconds:
    computing time of all runs.
    """

    n_read: int = 0
    indices: list[int] = field(default_factory=list)
    n_points: int = 0
    metres: float = 0.0
    skipped: dict[str, int] = field(default_factory=dict)
    history: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0


AnyMap = TypeVar("AnyMap", bound=GaussianMap | TiledMap)


class MapBuilder(Generic[AnyMap]):
    """Inserts the scans of a data set into a map.

        builder = MapBuilder(dataset, GaussianMap())
        for progress in builder.insert_all():
            print(progress.n_read, progress.n_components)

    A scan that cannot be read (`DataError`) or has no beam is skipped and counted. The map is a
    function of the scans alone: stops, checkpoints and progress do not change it. A `TiledMap` continues
    from its own files: scans that are in them are read again, but not learned from.

    Attributes:
        poses: (S, D+1, D+1) sensor poses of the scans in the map, world ← sensor, metres. The rotation is the
            identity if the data set states none.
        times: (S,) their times in seconds, float64; their indices if the data set states none.
        skipped: number of scans left out, by the reason.
        record: counts and the history of the run.
        windows: the windows of the map, and how `correct` has moved them.
    """

    def __init__(self, dataset: Dataset, target: AnyMap, device: str | torch.device = "cpu") -> None:
        self.map = target
        self.record = BuildRecord()
        self.windows = WindowMotions()
        self._dataset = dataset
        self._device = device
        self._poses: list[Tensor] = []
        self._left_out = dataset.skipped  # when the data set was opened

    @property
    def poses(self) -> Tensor:
        size = 1 + (self.map.dim or 3)
        return torch.stack(self._poses) if self._poses else torch.zeros(0, size, size, dtype=torch.float64)

    @property
    def times(self) -> Tensor:
        indices, known = self.record.indices, self._dataset.times
        return torch.tensor(indices).double() if known is None else known[indices]

    @property
    def skipped(self) -> dict[str, int]:
        reasons = dict.fromkeys([*self._left_out, *self.record.skipped])
        return {why: self._left_out.get(why, 0) + self.record.skipped.get(why, 0) for why in reasons}

    def insert_all(self) -> Iterator[BuildProgress]:
        """Inserts the remaining scans, and yields the progress after each scan.

        Raises `DataError` if no scan of the data set can be used.
        """
        n_total, record = len(self._dataset), self.record
        before = record.seconds
        begin = time.monotonic()
        for index in range(record.n_read, n_total):
            self._insert(index)
            record.n_read = index + 1
            record.seconds = before + time.monotonic() - begin
            if self.map.n_pending == 0 and record.n_read * _N_ROWS >= n_total * (len(record.history) + 1):
                self._add_row()
            yield self.progress()
            begin, before = time.monotonic(), record.seconds  # the caller's work does not count
        if not record.indices:
            reason = next(iter(self.skipped), "it contains none")
            raise DataError(f"{self._dataset.name}: no scan of {n_total} can be used: {reason}")

    def finish(self) -> None:
        """Learns from the scans of the unfinished window, and completes the history."""
        begin = time.monotonic()
        self.map.finish()
        self.record.seconds += time.monotonic() - begin
        self._add_row()

    def correct(self: MapBuilder[GaussianMap], poses: Tensor, first: int) -> MotionAt | None:
        """Moves the map, window by window, to corrected poses (N, D+1, D+1) of the scans of the data set from
        number `first` on, up to the last one in the map or further.

        Returns the motion of the scans, or None if no window moves; see `WindowMotions.correct`.
        """
        rows = [row for row, index in enumerate(self.record.indices) if index >= first]
        if not rows:
            return None
        corrected = poses[[self.record.indices[row] - first for row in rows]]
        self._poses[rows[0] :] = list(corrected)
        return self.windows.correct(self.map, corrected)

    def progress(self) -> BuildProgress:
        """The present state."""
        record = self.record
        counts = record.n_read, len(self._dataset), sum(self.skipped.values()), record.n_points
        nbytes = record.history[-1]["nbytes"] if record.history else 0
        return BuildProgress(*counts, self.map.n_final, record.metres, record.seconds, nbytes)

    def _insert(self, index: int) -> None:
        record, before = self.record, self._dataset.skipped
        scan, reason = None, "a scan has neither returns nor free beams"
        try:
            scan = self._dataset[index].to(self._device)
        except DataError as error:
            reason = str(error)
        if scan is not None and scan.n_beams > 0:
            if not isinstance(self.map, TiledMap) or len(record.indices) >= self.map.n_scans:
                self.map.insert(scan)
            self._note(index, scan)
            if self.map.n_pending == 0:
                self.windows.end()
        found = {why: n - before.get(why, 0) for why, n in self._dataset.skipped.items()}
        found = {why: n for why, n in found.items() if n}
        if scan is None or (scan.n_beams == 0 and not found):
            found = {reason: 1}
        for why, n in found.items():
            record.skipped[why] = record.skipped.get(why, 0) + n

    def _note(self, index: int, scan: Scan) -> None:
        """Records the pose of a scan that the map has learned from."""
        record, known = self.record, self._dataset.pose(index)
        pose = torch.eye(scan.dim + 1, dtype=torch.float64) if known is None else known.double().cpu()
        pose = pose.clone()
        pose[:-1, -1] = scan.origin.double().cpu()
        sensor, rows = self._dataset.sensor_of, range(len(self._poses) - 1, -1, -1)
        before = next((row for row in rows if sensor(record.indices[row]) == 0), None)
        if before is not None and sensor(index) == 0:
            record.metres += float((pose[:-1, -1] - self._poses[before][:-1, -1]).norm())
        self._poses.append(pose)
        self.windows.add(pose)
        record.indices.append(index)
        record.n_points += scan.points.shape[0]

    def _add_row(self) -> None:
        record, history = self.record, self.record.history
        if history and history[-1]["n_read"] == record.n_read:
            history.pop()
        size = {"n_components": self.map.n_components, "nbytes": self.map.nbytes}
        way = {"metres": record.metres, "seconds": record.seconds}
        history.append({"n_read": record.n_read, **size, **way, "memory_bytes": resident_bytes()})

    def save(self, path: str | Path, run: Mapping[str, Any]) -> None:
        """Writes everything that building continues from, atomically; of a `TiledMap` only at the ends of
        windows, what is not in its files.

        Args:
            path: the file.
            run: the settings of the run, in JSON types; `load` compares them.
        """
        if isinstance(self.map, TiledMap) and self.map.n_pending:
            return  # the last file agrees with the windows in the files
        state = {
            "map": {} if isinstance(self.map, TiledMap) else dict(self.map.state_dict()),
            "poses": self.poses,
            "record": vars(self.record),
            "windows": self.windows.state(),
        }
        tree, tensors = split_tensors(state)
        write_bytes(path, pack_tensors(tensors, _KIND, _VERSION, tree=tree, run=dict(run)))

    def load(self, path: str | Path, run: Mapping[str, Any]) -> None:
        """Continues from a file that `save` wrote.

        Raises `InvalidArgumentError` if the file is of another run, and `DataError` if it is damaged.
        """
        tensors, facts = read_tensors(path, _KIND, _VERSION)
        stored = facts.get("run")
        if not isinstance(stored, dict):
            raise DataError(f"{path} lacks the description of its run; the file is damaged.")
        check_same_run(path, stored, run)
        try:
            state = joined_tensors(facts["tree"], tensors)
            record, poses = BuildRecord(**state["record"]), state["poses"]
            if len(record.indices) != len(poses) or not self._dataset.can_continue(record.n_read):
                raise ValueError("its counts disagree")
            if poses.shape[1:] not in ((3, 3), (4, 4)):
                raise ValueError("its poses are no matrices")
            windows = WindowMotions.restored(state["windows"]) if "windows" in state else WindowMotions()
            windows.end()  # poses of later scans are corrected without those of the earlier run
            if isinstance(self.map, TiledMap):
                if len(record.indices) > self.map.n_scans:
                    raise ValueError(f"{self.map.folder} has fewer scans")
            else:
                self.map.load_state_dict(state["map"])
                self.map.to(self._device)
        except GmmTorchError:
            raise
        except DAMAGED_CONTENT as error:
            raise DataError(f"{path} is damaged: {error!r}; delete it to start again.") from error
        self.record, self._poses, self.windows = record, list(poses.double()), windows


def check_same_run(path: str | Path, stored: Mapping[str, Any], run: Mapping[str, Any]) -> None:
    """Raises `InvalidArgumentError` if a file is of a run with other settings than those of this run."""
    for name in dict.fromkeys([*run, *stored]):
        if stored.get(name) != run.get(name):
            raise InvalidArgumentError(
                f"{path} is of another run: it has {name}={stored.get(name)!r}, this run has "
                f"{name}={run.get(name)!r}. Use the same value, or another folder, or delete the file."
            )


def resident_bytes() -> int:
    """Memory of this process now; the largest so far on systems without /proc; 0 on Windows."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        if sys.platform == "win32":
            return 0
        import resource  # Windows has no such module

        largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return largest if sys.platform == "darwin" else 1024 * largest


_LEAST = 0.02, math.radians(0.2)  # metres and radians: smaller corrections wait
_SAME = 1e-6  # metres between an origin of the map and the position of its scan

MotionAt = Callable[[Tensor], Tensor]
"""The rigid motions (N, D+1, D+1), after ← before, of scans with sensor origins (N, D)."""


class WindowMotions:
    """The windows of a map: the poses with which their scans were inserted, and how each moved since.

    Attributes:
        motions: (D+1, D+1) of each complete window, now ← as inserted; the identity to the bit if it never
            moved.
    """

    def __init__(self) -> None:
        self.motions: list[Tensor] = []
        self._poses: list[Tensor] = []  # of all scans, as inserted
        self._windows: list[int] = []  # of all scans

    def add(self, pose: Tensor) -> None:
        """Adds a scan with its pose (D+1, D+1), world ← sensor, to the unfinished window."""
        self._poses.append(pose)
        self._windows.append(len(self.motions))

    def end(self) -> None:
        """Ends the unfinished window, if it has a scan."""
        if self._windows and self._windows[-1] == len(self.motions):
            self.motions.append(torch.eye(len(self._poses[0]), dtype=torch.float64))

    @property
    def moved(self) -> list[int]:
        """The windows that were moved."""
        return [number for number, motion in enumerate(self.motions) if not _is_identity(motion)]

    def correct(self, target: GaussianMap, poses: Tensor) -> MotionAt | None:
        """Moves the components of a map to corrected poses (N, D+1, D+1) of its last N scans.

        A window of which an earlier scan is not among them stays, and so does one whose correction is below
        2 cm and 0.2°. If a window moves, the unfinished window of the map is learned. Returns the motion of
        the scans, or None if no window moves.
        """
        first = len(self._poses) - len(poses)
        rows: dict[int, list[int]] = {}
        for row, window in enumerate(self._windows):
            rows.setdefault(window, []).append(row)
        identity = torch.eye(poses.shape[1], dtype=torch.float64)
        before = [*self.motions, identity][: len(rows)]
        after = list(before)
        for window, members in rows.items():
            middle = members[len(members) // 2]
            place = before[window] @ self._poses[middle]
            if members[0] >= first and _is_apart(place, poses[middle - first]):
                after[window] = _motion(self._poses[middle], poses[middle - first])
        if all(one is other for one, other in zip(before, after, strict=True)):
            return None
        self.end()
        steps = [
            identity if one is other else _motion(one, other)
            for one, other in zip(before, after, strict=True)
        ]
        motions, find = torch.stack([*steps, identity]), self._finder()
        target.revise(lambda components: _moved(components, motions, *_members(components, find)))
        self.motions = after
        return lambda origins: motions[find(origins)]

    def as_inserted(self, target: GaussianMap) -> tuple[Components, Tensor]:
        """The components of a map, not rounded, where they would be if no window had moved, and the window
        (K,) of each; −1 for those that no scan here has seen."""
        components = target.unrounded()
        identity = torch.eye(components.dim + 1, dtype=torch.float64)
        back = [one if _is_identity(one) else _motion(one, identity) for one in self.motions]
        windows, of_origins = _members(components, self._finder())
        return _moved(components, torch.stack([*back, identity]), windows, of_origins), windows

    def _finder(self) -> Callable[[Tensor], Tensor]:
        """A function that finds the windows (N,) of sensor origins (N, D) of the map as it is; −1: none."""
        from scipy.spatial import cKDTree

        if not self._poses:
            return lambda origins: torch.full((len(origins),), -1)
        windows = torch.tensor(self._windows)
        identity = torch.eye(len(self._poses[0]), dtype=torch.float64)
        now = torch.stack([*self.motions, identity])[windows] @ torch.stack(self._poses)
        tree = cKDTree(now[:, :-1, -1].numpy())

        def found(origins: Tensor) -> Tensor:
            distance, row = tree.query(origins.detach().cpu().numpy(), distance_upper_bound=_SAME)
            known = torch.from_numpy(distance) <= _SAME
            return torch.where(known, windows[torch.from_numpy(row).clamp_max(len(windows) - 1)], -1)

        return found

    def state(self) -> dict[str, Any]:
        """Everything, as tensors."""
        poses = torch.stack(self._poses) if self._poses else torch.zeros(0)
        motions = torch.stack(self.motions) if self.motions else torch.zeros(0)
        return {"poses": poses, "windows": torch.tensor(self._windows), "motions": motions}

    @classmethod
    def restored(cls, state: Mapping[str, Any]) -> WindowMotions:
        """What `state` returned. Raises an error of any kind if it is damaged."""
        made = cls()
        made._poses, made.motions = list(state["poses"].double()), list(state["motions"].double())
        made._windows = [int(window) for window in state["windows"]]
        if len(made._poses) != len(made._windows) or max(made._windows, default=0) > len(made.motions):
            raise ValueError("the windows of the map disagree with their scans")
        return made


def _is_identity(motion: Tensor) -> bool:
    return torch.equal(motion, torch.eye(len(motion), dtype=motion.dtype))


def _motion(before: Tensor, after: Tensor) -> Tensor:
    """after ← before (D+1, D+1) of a pose or motion that was replaced by another one."""
    return (Pose.from_matrix(after) @ Pose.from_matrix(before).inverse()).matrix


def _is_apart(place: Tensor, corrected: Tensor) -> bool:
    off = Pose.from_matrix(place).inverse() @ Pose.from_matrix(corrected)
    return bool(off.translation.norm() > _LEAST[0]) or bool(off.chord() > _LEAST[1])


def _members(components: Components, find: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    """The windows of components (K,) and of their origins (S,), on the CPU; −1: none."""
    of_origins = find(components.origins)
    by, count = components.seen_by.cpu(), components.seen_count.cpu()
    most = count.new_full((len(components),), -1.0).scatter_reduce_(0, by, count, "amax")
    rows = torch.arange(len(by))
    is_most = count == most[by]
    first = rows.new_full((len(components),), len(rows))
    first = first.scatter_reduce_(0, by[is_most], rows[is_most], "amin")
    seen_from = torch.cat([components.seen_from.cpu(), rows.new_full((1,), len(of_origins))])
    return torch.cat([of_origins, rows.new_full((1,), -1)])[seen_from[first]], of_origins


def _moved(components: Components, motions: Tensor, windows: Tensor, of_origins: Tensor) -> Components:
    """Components and origins moved by the motions of their windows, to the bit the same for the identity.

    motions: (W+1, D+1, D+1); the last one is the identity, for the window −1.
    """
    stay = torch.tensor([_is_identity(motion) for motion in motions])
    device = components.means.device
    motion, turn = motions[windows].to(device), motions[windows, :-1, :-1].to(device)
    stays = stay[windows].to(device)
    covariances = turn @ components.covariances @ turn.mT
    origins = _at(motions[of_origins].to(device), components.origins)
    return replace(
        components,
        means=torch.where(stays[:, None], components.means, _at(motion, components.means)),
        covariances=torch.where(
            stays[:, None, None], components.covariances, (covariances + covariances.mT) / 2
        ),
        origins=torch.where(stay[of_origins].to(device)[:, None], components.origins, origins),
        attributes=components.attributes.turned(turn),
    )


def _at(motions: Tensor, points: Tensor) -> Tensor:
    """Points (N, D) moved by motions (N, D+1, D+1)."""
    return Pose.from_matrix(motions).apply(points[:, None])[:, 0]
