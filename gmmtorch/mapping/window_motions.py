"""WindowMotions: how corrected poses of scans move a map.

The scans of a window are learned together, so its components move together: by the correction of the pose of
the window's middle scan. A component states the sensor origins that observed it. It belongs to the window of
the origin that observed most of its points, also after it was merged with components of other windows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.pose import Pose

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
        components = Components(**{field.name: getattr(target, field.name) for field in fields(Components)})
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

    # -- checkpoints ----------------------------------------------------------------------------------

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
    )


def _at(motions: Tensor, points: Tensor) -> Tensor:
    """Points (N, D) moved by motions (N, D+1, D+1)."""
    return Pose.from_matrix(motions).apply(points[:, None])[:, 0]
