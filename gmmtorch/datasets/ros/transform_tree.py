"""TransformTree: the frames of a robot and the transforms between them over time (TF)."""

from __future__ import annotations

import itertools
from array import array
from collections import Counter
from typing import Any

import numpy as np

from gmmtorch.datasets.trajectory import NANOSECONDS, PosesAt, Trajectory
from gmmtorch.errors import DataError
from gmmtorch.pose import MIN_NORM, Pose

_TRAVEL = 0.1  # a frame travels if it moves farther, in metres; noise and the joints of wheels do not


class TransformTree:
    """Transforms parent ← child, each static or over time. Frames are named without a leading slash.

    keep: seconds of transforms that are kept, for live topics; None: all. A stamp that is older starts the
    transforms of its frame again, because the clock was set back.
    """

    def __init__(self, keep: float | None = None) -> None:
        self._keep = None if keep is None else int(keep * NANOSECONDS)
        self._samples: dict[str, tuple[array[int], array[float]]] = {}
        self._static: dict[str, Pose] = {}
        self._parents: dict[str, Counter[str]] = {}
        self._edges: dict[str, Trajectory] = {}

    def add(self, message: dict[str, Any], static: bool) -> None:
        """The transforms of a decoded TFMessage. Those that are not rigid are left out."""
        for entry in message["transforms"]:
            child, parent = frame_name(entry["child_frame_id"]), frame_name(entry["header"]["frame_id"])
            sample = pose_numbers(entry["transform"]["translation"], entry["transform"]["rotation"])
            if static:
                try:
                    self._static[child] = Pose.from_quaternion(sample[:3], sample[3:])
                except ValueError:
                    continue
            else:
                times, numbers = self._samples.setdefault(child, (array("q"), array("d")))
                stamp = stamp_of(entry["header"])
                self._forget(times, numbers, stamp)
                times.append(stamp)
                numbers.extend(sample)
                self._edges.pop(child, None)
            self._parents.setdefault(child, Counter())[parent] += 1

    def _forget(self, times: array[int], numbers: array[float], stamp: int) -> None:
        """Removes samples of a frame that are not kept, from time to time."""
        if self._keep is None or not times:
            return
        if stamp < times[-1] - self._keep:
            n_old = len(times)
        elif times[len(times) // 2] < stamp - self._keep:  # half of them, so that each is moved once
            n_old = len(times) // 2 + 1
        else:
            return
        del times[:n_old], numbers[: 7 * n_old]

    def __len__(self) -> int:
        return len(self._parents)

    @property
    def frames(self) -> list[str]:
        return sorted({*self._parents, *(p for parents in self._parents.values() for p in parents)})

    def is_moving(self, chain: list[str]) -> bool:
        """Whether a transform of the chain is not static."""
        return any(child in self._samples for child in chain[:-1])

    def static_part(self, chain: list[str]) -> list[str]:
        """The frames of a chain up to the first transform that moves."""
        moving = (index for index, child in enumerate(chain[:-1]) if child in self._samples)
        return chain[: next(moving, len(chain)) + 1]

    def chain(self, frame: str, top: str | None = None) -> list[str]:
        """Frames from `frame` up to `top`, or to the root of its tree.

        Raises `DataError` if the tree loops, if a frame has two parents, or if `top` is not above `frame`.
        """
        found = [frame]
        while found[-1] in self._parents and found[-1] != top:
            parents = self._parents[found[-1]]
            if len(parents) > 1:
                counts = ", ".join(f"{parent} ({n} times)" for parent, n in parents.most_common())
                raise DataError(
                    f"TF states several parents of frame {found[-1]}: {counts}; record only one of them, or "
                    "choose other poses: ‹poses›=TOPIC, FILE or standing."
                )
            parent = next(iter(parents))
            if parent in found:
                raise DataError(
                    f"TF loops: {' → '.join([*found, parent])}; record only one of these transforms, or "
                    "choose other poses: ‹poses›=TOPIC, FILE or standing."
                )
            found.append(parent)
        if top is not None and found[-1] != top:
            raise DataError(
                f"TF has no transform between frame {top} and frame {frame}, whose tree is "
                f"{' → '.join(found)}; all frames: {self.describe()}. Choose ‹frame›={found[-1]}, or "
                "other poses: ‹poses›=TOPIC, FILE or standing."
            )
        return found

    def describe(self) -> str:
        """The frames of each tree of TF, for messages."""
        trees: dict[str, list[str]] = {}
        for frame in self.frames:
            at, seen = frame, {frame}
            while at in self._parents and (up := next(iter(self._parents[at]))) not in seen:
                at = up
                seen.add(at)
            trees.setdefault(at, []).append(frame)
        return "; ".join(", ".join(frames) for frames in trees.values()) or "none"

    def lookup(self, chain: list[str], times: np.ndarray, max_gap: float) -> PosesAt:
        """Poses of the first frame of a chain in its last one, at times (M,) in ns."""
        poses, known = Pose.identity(3, len(times)), np.ones(len(times), bool)
        for child in chain[:-1]:
            step = self._step(child, times, max_gap)
            poses, known = step.poses @ poses, known & step.known
        return PosesAt(poses, known)

    def between(self, frame: str, other: str, times: np.ndarray, max_gap: float) -> PosesAt:
        """Poses frame ← other of two frames at times (M,) in ns, from the nearest frame above both.

        Raises `DataError` if there is no such frame.
        """
        ours, others = self.above(frame), self.above(other)
        top = next((name for name in ours if name in others), None)
        if top is None:
            raise DataError(
                f"TF has no transform between frame {frame or '(unnamed)'} and frame {other or '(unnamed)'}; "
                f"all frames: {self.describe()}"
            )
        up = self.lookup(ours[: ours.index(top) + 1], times, max_gap)
        down = self.lookup(others[: others.index(top) + 1], times, max_gap)
        return PosesAt(up.poses.inverse() @ down.poses, up.known & down.known)

    def above(self, frame: str) -> list[str]:
        """A frame and those above it, as far as each has one parent."""
        found = [frame]
        while (
            len(parents := self._parents.get(found[-1], ())) == 1 and (up := next(iter(parents))) not in found
        ):
            found.append(up)
        return found

    def traveller(self, frame: str) -> str | None:
        """The only frame below `frame` that travels in it, farther than `frame` does in the root of the tree.

        If another one travels farther still in that, as base_link does in odom and odom in map, it is that
        one. None if there is none, or if there are several, such as those of a team.
        """
        children: dict[str, list[str]] = {}
        for child, parents in self._parents.items():
            children.setdefault(next(iter(parents)), []).append(child)
        found, seen = None, {frame}
        least = max(_TRAVEL, sum(map(self._extent, self.above(frame)[:-1])))
        while True:
            waiting, travelling = [found or frame], list[str]()
            while waiting:
                below = [child for child in children.get(waiting.pop(), []) if child not in seen]
                seen.update(below)
                for child in below:
                    (travelling if self._extent(child) > least else waiting).append(child)
            if len(travelling) != 1:
                return found
            found = travelling[0]
            least = self._extent(found)

    def _extent(self, child: str) -> float:
        """The diagonal (m) of the box around the positions of a frame in its parent."""
        if child not in self._samples or len(edge := self._edge(child)) == 0:
            return 0.0
        return float(np.linalg.norm(np.ptp(edge.poses.translation.numpy(), axis=0)))

    def latest(self, chain: list[str]) -> int | None:
        """The time (ns) up to which all transforms of a chain are known; None if all are static."""
        edges = [self._edge(child) for child in chain[:-1] if child in self._samples]
        return min((int(edge.times[-1]) if len(edge) else 0 for edge in edges), default=None)

    def unknown_step(self, chain: list[str], time: int, max_gap: float) -> str:
        """The transform of a chain that is not known at a time, with the times at which it is."""
        for child, parent in itertools.pairwise(chain):
            if not self._step(child, np.array([time]), max_gap).known[0]:
                times = self._edge(child).times / NANOSECONDS
                if len(times) == 0:
                    return f"{parent} ← {child} is never a rigid transform"
                return f"{parent} ← {child} is known from {times[0]:.3f} to {times[-1]:.3f} s"
        return "all transforms are known"

    def _step(self, child: str, times: np.ndarray, max_gap: float) -> PosesAt:
        if child not in self._samples:
            return PosesAt(Pose.identity(3, len(times)) @ self._static[child], np.ones(len(times), bool))
        return self._edge(child).at(times, max_gap)

    def _edge(self, child: str) -> Trajectory:
        if child not in self._edges:
            self._edges[child] = trajectory_of(*self._samples[child])
        return self._edges[child]


def trajectory_of(times: array[int], numbers: array[float]) -> Trajectory:
    """The trajectory of samples at times (N,), ns, without those that are not poses.

    numbers: of `pose_numbers`, of one sample after the other.
    """
    stamps, rows = np.array(times, np.int64), np.array(numbers).reshape(-1, 7)
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(rows[:, 3:], axis=1)
    valid = np.isfinite(rows).all(1) & np.isfinite(norm) & (norm > MIN_NORM)
    return Trajectory.from_samples(stamps[valid], Pose.from_quaternion(rows[valid, :3], rows[valid, 3:]))


def frame_name(name: str) -> str:
    """The name of a frame as ROS 2 writes it, without a leading slash."""
    return name.lstrip("/")


def stamp_of(header: dict[str, Any]) -> int:
    """The stamp of a message header in ns."""
    return int(header["stamp"]["sec"]) * NANOSECONDS + int(header["stamp"]["nanosec"])


def pose_numbers(translation: dict[str, float], rotation: dict[str, float]) -> list[float]:
    """x, y, z, qx, qy, qz, qw of a Transform or Pose message."""
    numbers = *(translation[axis] for axis in "xyz"), *(rotation[axis] for axis in "xyzw")
    return [float(number) for number in numbers]
