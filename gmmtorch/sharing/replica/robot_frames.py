"""Frames: where the frames of robots are, which follows from the records of frames.

Each record says where a frame is in another one, its anchor. The chain of anchors ends at a frame without an
anchor, its root. Frames of one root are placed relative to each other. Records of an author without a frame
are in the frame `WORLD`. A chain that returns to itself, which no sound robot writes, places nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.mapping.components import Components
from gmmtorch.sharing.messages.pose_fields import matrix_of
from gmmtorch.sharing.messages.record_messages import FrameMessage
from gmmtorch.sharing.replica.record_keys import NUMBER_BITS, SEQUENCE_BITS, WORLD, Ints, authors


class Placement(NamedTuple):
    """root: the frame at the end of the chain. transform: (D+1, D+1), root ← frame; None: the identity."""

    root: int
    transform: Tensor | None

    def equals(self, other: Placement) -> bool:
        if self.root != other.root or self.transform is None or other.transform is None:
            return self.root == other.root and self.transform is other.transform
        return torch.equal(self.transform, other.transform)


class Frames:
    """The placement of each author's records, by the latest record of each frame.

    Args:
        records: of frames, in any order. dim: 2 or 3; records of the other dimension are ignored.
    """

    def __init__(self, records: Sequence[FrameMessage], dim: int) -> None:
        self._latest: dict[int, FrameMessage] = {}
        for record in sorted(records, key=lambda r: (r.version, r.key)):
            if record.dim in (None, dim):
                self._latest[record.frame] = record
        self._anchors = {record.anchor for record in self._latest.values()}
        self._placed: dict[int, Placement] = {}

    def __len__(self) -> int:
        return len(self._latest)

    def place(self, frame: int) -> Placement:
        """Where the frame of an author is."""
        if frame not in self._placed:
            self._placed[frame] = self._follow(frame)
        return self._placed[frame]

    def anchor(self, frame: int) -> int | None:
        """The anchor of a frame; None if it has none."""
        record = self._latest.get(frame)
        return None if record is None or record.anchor == frame else record.anchor

    def _follow(self, frame: int) -> Placement:
        if frame not in self._latest and frame not in self._anchors:
            return Placement(WORLD, None)
        at, transform, passed = frame, None, set()
        while (record := self._latest.get(at)) is not None and record.pose is not None:
            if at in passed:
                return Placement(frame, None)
            passed.add(at)
            step = matrix_of(record.pose)
            transform = step if transform is None else step @ transform
            at = record.anchor
        return Placement(at, transform)

    def are_in(self, keys: Ints, root: int) -> NDArray[np.bool_]:
        """Which records (K,) are in frames of a root."""
        if not self._latest:
            return np.full(len(keys), root == WORLD)
        numbers, which = np.unique(authors(keys), return_inverse=True)
        return np.array([self.place(n).root == root for n in numbers.tolist()], np.bool_)[which]

    def placed(self, components: Components, keys: Ints) -> Components:
        """Components (K,) with keys (K,), which are in frames of one root, in the root frame."""
        numbers, which = np.unique(authors(keys), return_inverse=True)
        motions = [self.place(number).transform for number in numbers.tolist()]
        if all(motion is None for motion in motions):
            return components
        identity = torch.eye(components.dim + 1, dtype=torch.float64)
        table = torch.stack([identity if motion is None else motion for motion in motions])
        moves = np.array([motion is not None for motion in motions])[which]
        return moved(components, table[torch.from_numpy(which)], torch.from_numpy(moves))

    def roots(self, keys: Ints) -> set[int]:
        """The roots of the frames of records (K,)."""
        return {self.place(number).root for number in np.unique(authors(keys)).tolist()}


def robot_of_frame(frame: int) -> int:
    """The robot of a frame; −1 for `WORLD`."""
    return frame >> (SEQUENCE_BITS - NUMBER_BITS)


def moved(components: Components, motions: Tensor, moves: Tensor) -> Components:
    """Components (K,) and their origins, moved by rigid motions (K, D+1, D+1); exactly the same where not
    `moves` (K,)."""
    means, seen_at = components.means, components.origins[components.seen_from]
    turn = motions[:, :-1, :-1]
    covariances = turn @ components.covariances @ turn.transpose(1, 2)
    at = _at(motions[components.seen_by], seen_at)
    at = torch.where(moves[components.seen_by, None], at, seen_at)
    origins, seen_from = torch.unique(at, dim=0, return_inverse=True)
    return replace(
        components,
        means=torch.where(moves[:, None], _at(motions, means), means),
        covariances=torch.where(
            moves[:, None, None], (covariances + covariances.transpose(1, 2)) / 2, components.covariances
        ),
        origins=origins,
        seen_from=seen_from,
    )


def _at(motions: Tensor, points: Tensor) -> Tensor:
    """Points (N, D) transformed by motions (N, D+1, D+1)."""
    return (motions[:, :-1, :-1] @ points[:, :, None]).squeeze(2) + motions[:, :-1, -1]
