"""Loop closures: pairs of keyframes that saw one place at different times, with the motion between them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gmmtorch.localization.location import Location
from gmmtorch.localization.odometry.local_map import Expectation, Keyframe, LocalMap
from gmmtorch.localization.odometry.pose_graph import Edges, optimised
from gmmtorch.mapping.learning.rules import WindowedRule

_ROUNDS = 3  # of closing and correcting: corrected poses bring more places together
_APART = 15  # keyframes between two visits of a place
_REACH = 3.0  # metres between the places of a closure, and
_DRIFT = 0.02  # metres for each metre of path between both, up to
_FARTHEST = 10.0  # metres
_NEIGHBOURS = 3  # keyframes before and after an old one, in the map of its place
_SPACING = 3  # every third keyframe looks for closures
_MOST_EXPLAINED = 0.8  # share of the points that a closure explains at least
_SYSTEMATIC = {  # deviations (m, rad) of errors that the points do not show, such as thick surfaces
    2: torch.tensor([0.01, 0.01, 0.002]).double(),
    3: torch.tensor([0.01, 0.01, 0.01, 0.001, 0.001, 0.001]).double(),
}
_ANGLE = math.radians(10)  # of the heading of a closure


def closed(
    poses: Tensor,
    edges: Edges,
    places: Sequence[tuple[int, Keyframe]],
    least_explained: float,
    rule: WindowedRule,
) -> Edges:
    """The edges of a pose graph, with those of the loop closures that can be found.

    Args:
        poses: (N, D+1, D+1), world ← sensor. edges: of odometry.
        places: number of the pose, and keyframe, in order.
    """
    tried: set[tuple[int, int]] = set()
    for _ in range(_ROUNDS):
        pairs = [pair for pair in _candidates(poses, [at for at, _ in places]) if pair not in tried]
        found = [edge for pair in pairs if (edge := _closure(poses, places, *pair, least_explained, rule))]
        tried.update(pairs)
        if not found:
            break
        source, target, motions, information = zip(*found, strict=True)
        edges = edges.joined(
            Edges(
                torch.tensor(source),
                torch.tensor(target),
                torch.stack(motions),
                torch.stack(information),
                torch.ones(len(found), dtype=torch.bool),
            )
        )
        poses = optimised(poses, edges).poses
    return edges


def _candidates(poses: Tensor, numbers: list[int]) -> list[tuple[int, int]]:
    """Pairs (old, new) of rows of keyframes that may be at one place: for each new one, the nearest."""
    at = poses[numbers][:, :-1, -1]
    path = torch.cat([torch.zeros(1), (at[1:] - at[:-1]).norm(dim=1)]).cumsum(0)
    gap = torch.cdist(at, at)
    reach = (_REACH + _DRIFT * (path[:, None] - path)).clamp_max(_FARTHEST)
    order = torch.arange(len(at))
    allowed = (order[:, None] - order >= _APART) & (gap <= reach)
    nearest = torch.where(allowed, gap, torch.inf).argmin(1)
    return [
        (int(nearest[new]), new) for new in range(0, len(at), _SPACING) if bool(allowed[new, nearest[new]])
    ]


def _closure(
    poses: Tensor,
    places: Sequence[tuple[int, Keyframe]],
    old: int,
    new: int,
    least_explained: float,
    rule: WindowedRule,
) -> tuple[int, int, Tensor, Tensor] | None:
    """Pose numbers, motion and information of the edge between two keyframes, if they see one place."""
    around = range(max(old - _NEIGHBOURS, 0), min(old + _NEIGHBOURS + 1, len(places)))
    order = [row for row in around if row != old] + [old]  # the last one is the centre of a local map
    local = LocalMap(
        [places[row][1]._replace(pose=poses[places[row][0]]) for row in order], least_explained, rule
    )
    source, target = places[old][0], places[new][0]
    expected = Expectation(poses[target][None], _REACH / 2, _ANGLE, _MOST_EXPLAINED)
    location = local.locate(places[new][1], expected)
    if not location.found or location.explained < _MOST_EXPLAINED:
        return None
    motion = torch.linalg.solve(poses[source], location.pose)
    return source, target, motion, information_of(location)


def information_of(location: Location) -> Tensor:
    """The inverse covariance (F, F) of a location in the frame of the sensor."""
    dim = len(location.pose) - 1
    turn = torch.eye(len(location.covariance)).double()
    turn[:dim, :dim] = location.pose[:dim, :dim]
    if dim == 3:
        turn[3:, 3:] = location.pose[:dim, :dim]
    covariance = location.covariance + torch.diag(_SYSTEMATIC[dim].square())
    return torch.linalg.inv(turn.T @ covariance @ turn)
