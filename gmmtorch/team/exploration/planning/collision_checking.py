"""Collision checking: where a robot's body fits in the known free space, which paths are safe there, and
clear of other robots.

The robot is a sphere. A cell is passable if a robot with its centre anywhere in the cell touches only
cells that are known to be free, with a margin of half a cell. A path is therefore safe between checked
points if points one cell apart are in passable cells.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_number
from gmmtorch.kernels import FreeSpace, motions_are_clear
from gmmtorch.occupancy import Box
from gmmtorch.team.exploration.planning.primitives import Primitives
from gmmtorch.team.sharing import PlanMessage

_FINE_SPACING = 0.25
"""Cells between the checked points of a path on which a robot leaves a place where it does not fit; half of
this is the margin around the body. On other paths it is one cell."""
_STRUCK_RAYS, _STRUCK_SHARE = 1.0, 0.05
"""A cell with at least this many hits and this share of hits among its rays is an obstacle. A rail of a
twentieth of a cell's width is hit by no larger share."""
_ROUNDING = 1e-9
_CHUNK_PAIRS = 1 << 22


@dataclass(frozen=True, eq=False)
class LocalMap:
    """A dense snapshot (nx, ny, nz) of the cells of the sliding map.

    low: (3,) int64, index of the lowest cell; cell c is [c, c + 1) · resolution, world frame.
    resolution: side (m) of the cells.
    occupancy: (nx, ny, nz) float32, with the planner's prior where nothing was observed.
    observed: bool, cells with any evidence.
    free: bool, known to be free.
    passable: bool, where the centre of the robot may be: all cells that its body touches are free.
    """

    low: Tensor
    resolution: float
    occupancy: Tensor
    observed: Tensor
    free: Tensor
    passable: Tensor

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.free.shape)

    @property
    def box(self) -> Box:
        return Box(self.low, self.low + torch.tensor(self.shape))

    @cached_property
    def _size(self) -> Tensor:
        return torch.tensor(self.shape)

    def cells_of(self, points: Tensor) -> Tensor:
        """Indices (..., 3) int64, relative to `low`, of the cells that contain points (..., 3), metres."""
        return (points / self.resolution).floor().long() - self.low

    def flat_index(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Flat row-major indices (...,) of points (..., 3), 0 where outside; and whether each is inside."""
        cell = self.cells_of(points)
        inside = ((cell >= 0) & (cell < self._size)).all(-1)
        _, ny, nz = self.shape
        flat = (cell[..., 0] * ny + cell[..., 1]) * nz + cell[..., 2]
        return torch.where(inside, flat, 0), inside

    def is_passable(self, points: Tensor) -> Tensor:
        """Whether the centre of the robot may be at points (..., 3), metres; False outside the map."""
        flat, inside = self.flat_index(points)
        return self.passable.view(-1)[flat] & inside

    def centers(self, cells: Tensor) -> Tensor:
        """Centres (..., 3), metres, of cells (..., 3) relative to `low`."""
        return (cells + self.low + 0.5).double() * self.resolution


def widened(blocked: Tensor, axis: int, cells: int) -> Tensor:
    """Return cells with a blocked cell within `cells` along an axis; invalid that close to the ends."""
    size, done = blocked.shape[axis], 0
    while done < cells:
        shift = min(2 * done + 1, cells - done)  # 2 · done + 1 cells are covered so far
        wider = blocked.clone()
        wider.narrow(axis, shift, size - shift).logical_or_(blocked.narrow(axis, 0, size - shift))
        wider.narrow(axis, 0, size - shift).logical_or_(blocked.narrow(axis, shift, size - shift))
        blocked, done = wider, done + shift
    return blocked


def inflated(blocked: Tensor, radius: float, resolution: float) -> Tensor:
    """Return cells (nx, ny, nz), bool, in which the centre of a sphere of `radius` metres may not be, as it
    could reach into a blocked cell. Cells outside the array are blocked.

    A cell at offset (i, j, k) from a blocked cell is included if Σ max(|i| − 1, 0)² < (radius / resolution)².
    That set is a union of boxes; each box is computed one axis after the other.
    """
    boxes = _covering_boxes((radius / resolution) ** 2 * (1 - _ROUNDING))
    reach = max(max(box) for box in boxes)
    padded = torch.nn.functional.pad(blocked, (reach,) * 6, value=True)
    found = torch.zeros_like(padded)
    for i, same in itertools.groupby(boxes, key=lambda box: box[0]):
        slab = widened(padded, 0, i)
        for _, j, k in same:
            found |= widened(widened(slab, 1, j), 2, k)
    inside = slice(reach, -reach)
    return found[inside, inside, inside].contiguous()


def passable_cells(free: Tensor, radius: float, resolution: float) -> Tensor:
    """Return cells (nx, ny, nz), bool, in which the centre of a robot may be, given the free cells."""
    return ~inflated(~free, radius + resolution / 2, resolution)


def cells_in_sphere(center: Tensor, radius: float, resolution: float) -> Tensor:
    """Return lattice cells (K, 3) int64 that lie entirely in a sphere; centre (3,) and radius in metres."""
    axes, squares = [], []
    for x in center.tolist():
        index = torch.arange(math.floor((x - radius) / resolution), math.floor((x + radius) / resolution) + 1)
        near = index.double() * resolution - x
        far = torch.maximum(near.abs(), (near + resolution).abs())  # of the cell's two faces
        axes.append(index[far <= radius])
        squares.append(far[far <= radius].square())
    x, y, z = squares
    within = (x[:, None, None] + y[:, None] + z <= radius**2).flatten()
    return torch.cartesian_prod(*axes)[within]


def local_map_of(
    low: Tensor,
    resolution: float,
    hits: Tensor,
    misses: Tensor,
    *,
    prior: float,
    planning_prior: float,
    free_below: float,
    radius: float,
    known_free: Tensor | None = None,
    obstacles: Tensor | None = None,
) -> LocalMap:
    """Build the planner's local map from the hits H and misses M of dense cells (nx, ny, nz).

    The map's occupancy is θ = (H + N_p)/(H + M + 2N_p); the planner's is (H + 2N_p π)/(H + M + 2N_p). A
    cell is free if it is observed, θ is below `free_below`, and few of its rays are hits; or if it is in
    `known_free`.

    Args:
        low: (3,) int64, lattice index of the lowest cell. resolution: side of a cell (m).
        prior: N_p, rays. planning_prior: π, the planner's occupancy of unobserved cells.
        radius: of the robot (m). known_free: (K, 3) int64, lattice cells known to be free; a sphere of them
            with radius √3 (radius + 5/2 resolution) or more makes the cell of its centre passable.
        obstacles: (C, 3) int64, lattice cells that are never free.
    """
    total = hits + misses
    observed = total > 0
    struck = (hits >= _STRUCK_RAYS) & (hits >= _STRUCK_SHARE * total)
    total += 2 * prior
    free = observed & ~struck & (hits + prior < free_below * total)
    for cells, value in ((known_free, True), (obstacles, False)):
        if cells is not None:
            inside = ((cells >= low) & (cells < low + torch.tensor(free.shape))).all(1)
            free[(cells[inside] - low).unbind(1)] = value
    return LocalMap(
        low=low,
        resolution=resolution,
        occupancy=((hits + 2 * prior * planning_prior) / total).float(),
        observed=observed,
        free=free,
        passable=passable_cells(free, radius, resolution),
    )


def feasible(
    rollout: Tensor,
    braking: Tensor,
    local_map: LocalMap,
    peers: PeerTrajectories | None = None,
    *,
    start: Tensor,
    radius: float | None = None,
) -> Tensor:
    """Flag (...,) the safe paths: states (..., S, 7), followed by braking states (..., B, 7) until rest.

    Every point of a safe path is in a passable cell and clear of the peers (see `clear_of`). A path that
    does not move, such as a turn in place or a wait, is always safe.

    The map may change so that the robot's own cell is no longer passable. The robot may leave that cell if
    `radius` is given. Its body may then touch only free cells and those that it touches at the start, and it
    must move away from every point q of those: (x − x₀)·(q − x₀) ≤ 0. So no known obstacle comes closer than
    it is at the start, or than the radius.

    start: (..., 7) or broadcastable: the states before the first step. radius: of the robot (m).
    """
    begin = start.to(rollout).expand(*rollout.shape[:-2], 7)
    origin = begin[..., :3]
    states = torch.cat([begin[..., None, :], rollout, braking], -2)
    safe = local_map.is_passable(_points_along(states, local_map.resolution)).all(-1)
    stuck = ~local_map.is_passable(origin)
    safe &= ~stuck
    if radius is not None:
        for here in torch.unique(origin[stuck], dim=0):
            rows = stuck & (origin == here).all(-1)
            safe[rows] = _leaves(here, states[rows], local_map, radius)
    if peers is not None:
        places = torch.cat([rollout[..., :3], braking[..., :3]], -2)
        safe &= clear_of(places, peers, origin)
    still = (states[..., :3] == states[..., :1, :3]).flatten(-2).all(-1)
    return safe | still


def feasible_motions(
    primitives: Primitives,
    follows: Tensor,
    states: Tensor,
    ends: Tensor,
    local_map: LocalMap,
    peers: PeerTrajectories,
    after: int,
) -> Tensor:
    """`feasible` of all primitives, (N, P), from states (N, 7) to ends (N, P, 7) by the fused kernel.

    follows: (N,), the primitive that ends with the velocities of each state. after: steps of the peers before
    the motions begin.
    """
    longest, turn = primitives.longest[follows].amax(0).tolist()
    return motions_are_clear(
        primitives.library,
        free_space(local_map, peers),
        follows,
        states,
        ends,
        _points_of_a_step(longest, turn, local_map.resolution),
        min(after, peers.paths.shape[1] - 1),
    )


def free_space(local_map: LocalMap, peers: PeerTrajectories) -> FreeSpace:
    """What the fused kernels check motions against."""
    passable, paths = local_map.passable.contiguous(), peers.paths.contiguous()
    (nx, ny, nz), (n_peers, n_times, _) = passable.shape, paths.shape
    side = local_map.resolution
    return FreeSpace(passable, local_map.low, nx, ny, nz, side, paths, n_peers, n_times, peers.separation)


def check_steps(primitives: Primitives, local_map: LocalMap) -> None:
    """Raises `InvalidArgumentError` if steps of primitives are too long to be checked in a map's cells."""
    longest, turn = primitives.longest.amax(0).tolist()
    _points_of_a_step(longest, turn, local_map.resolution)


def _covering_boxes(square: float) -> list[tuple[int, int, int]]:
    """Return boxes of offsets up to (i, j, k), by rising i, whose union is Σ max(|·| − 1, 0)² < square."""

    def largest(rest: float) -> int:
        return math.ceil(math.sqrt(rest)) - 1

    n = largest(square) + 1
    depth = {
        (i, j): largest(square - i * i - j * j) for i in range(n) for j in range(n) if i * i + j * j < square
    }
    return [
        (i + 1, j + 1, k + 1)
        for (i, j), k in depth.items()
        if depth.get((i + 1, j), -1) < k and depth.get((i, j + 1), -1) < k
    ]


def _points_along(states: Tensor, spacing: float) -> Tensor:
    """Sample points (..., n, 3) of paths (..., L, 7), at most `spacing` apart along each path. The first
    state is left out. Steps are treated as straight; an arc of chord c that turns by φ deviates from its
    chord by c φ/8."""
    place, yaw = states[..., :3], states[..., 3]
    step = place[..., 1:, :] - place[..., :-1, :]
    chord = step.square().sum(-1)
    longest = math.sqrt(float(chord.max())) if chord.numel() else 0.0
    turn = float((yaw[..., 1:] - yaw[..., :-1]).abs().max()) if chord.numel() else 0.0
    n = _points_of_a_step(longest, turn, spacing)
    return torch.cat([place[..., :-1, :] + step * (i / n) for i in range(1, n)] + [place[..., 1:, :]], -2)


def _points_of_a_step(longest: float, turn: float, spacing: float) -> int:
    """Number of points on each step; no step is longer than `longest` m or turns by more than `turn` rad."""
    room = spacing - longest * turn / 4
    if room <= 0:
        raise InvalidArgumentError(
            f"Steps of {longest:.3g} m and {turn:.3g} rad are too long to be checked in cells of "
            f"{spacing:.3g} m; use a shorter step or coarser cells."
        )
    return max(1, math.ceil(longest / room))


def _leaves(here: Tensor, states: Tensor, local_map: LocalMap, radius: float) -> Tensor:
    """Flag (P,) the paths (P, L, 7) from a point (3,) that lead away from all cells touched there."""
    resolution = local_map.resolution
    if not bool(local_map.flat_index(here)[1]):
        return torch.zeros(len(states), dtype=torch.bool)
    points = _points_along(states, _FINE_SPACING * resolution)
    radius = radius + _FINE_SPACING / 2 * resolution
    reach = math.ceil(radius / resolution)
    blocked = torch.nn.functional.pad(~local_map.free, (reach,) * 6, value=True)
    low = local_map.low - reach
    touched = _touched(here[None], blocked, low, resolution, radius)
    cells = touched[1]
    corners = torch.cartesian_prod(*[torch.tensor([0, 1])] * 3)
    away = ((cells[:, None] + corners + low).double() * resolution - here).flatten(0, 1)
    ok = ((points - here) @ away.T <= _ROUNDING).all(-1)
    blocked[cells.unbind(1)] = False
    flat = points.reshape(-1, 3)
    inside = local_map.flat_index(flat)[1]
    rows = inside.nonzero().squeeze(1)
    for part in rows.split(max(1, _CHUNK_PAIRS // (2 * reach + 1) ** 3)):
        inside[part[_touched(flat[part], blocked, low, resolution, radius)[0]]] = False
    return (ok & inside.view(ok.shape)).all(-1)


def _touched(
    points: Tensor, blocked: Tensor, low: Tensor, resolution: float, radius: float
) -> tuple[Tensor, Tensor]:
    """Return the blocked cells (T, 3), relative to `low`, in spheres around points (N, 3); with rows (T,)."""
    reach = math.ceil(radius / resolution)
    offset = torch.arange(-reach, reach + 1)
    cell = (points / resolution).floor().long()
    near = (cell[..., None] + offset).double() * resolution - points[..., None]
    gap = torch.maximum(near, -near - resolution).clamp_min(0).square()  # (N, 3, O), to the faces of each
    x, y, z = gap.unbind(1)
    within = x[:, :, None, None] + y[:, None, :, None] + z[:, None, None, :] < radius**2
    row, *index = within.nonzero().unbind(1)
    found = cell[row] - low + torch.stack([offset[i] for i in index], 1)
    hit = blocked[found.unbind(1)]
    return row[hit], found[hit]


_MOST_STEPS = 1000  # largest number of steps of a received plan that are used


@dataclass(frozen=True, eq=False)
class PeerTrajectories:
    """Committed paths of other robots.

    paths: (M, T, 3) float64, metres, world frame: each robot's position after 1, 2, …, T ≥ 1 planner
    steps. Each robot rests at its last position afterwards.
    separation: least distance (m) between the centres of two robots: two radii and a margin.
    """

    paths: Tensor
    separation: float = 0.7

    def __post_init__(self) -> None:
        shape = tuple(self.paths.shape)
        if len(shape) != 3 or shape[1] < 1 or shape[2] != 3 or not bool(torch.isfinite(self.paths).all()):
            raise InvalidArgumentError(
                f"paths has shape {shape}; expected finite metres (M, T, 3), T of 1 or more."
            )
        check_number("separation", self.separation, above=True)

    @classmethod
    def of(cls, paths: Sequence[Tensor], separation: float = 0.7) -> PeerTrajectories:
        """Build from paths (T_i, 3) of any lengths, at least one position each."""
        longest = max((len(path) for path in paths), default=1)
        padded = [path[torch.arange(longest).clamp_max(len(path) - 1)] for path in paths]
        return cls(torch.stack(padded) if padded else torch.zeros(0, 1, 3, dtype=torch.float64), separation)

    def __len__(self) -> int:
        return len(self.paths)

    def later(self, steps: int) -> PeerTrajectories:
        """Return the peers as seen by a path that begins that many steps from now."""
        return PeerTrajectories(self.paths[:, min(steps, self.paths.shape[1] - 1) :], self.separation)


def clear_of(path: Tensor, peers: PeerTrajectories, start: Tensor | None = None) -> Tensor:
    """Flag (...,) the paths (..., L, 3), positions after 1, 2, …, L steps, that keep clear of the peers.

    After step L the robot stays. At step k its distance from another robot must be at least the
    separation, plus the longer step of that robot before or after step k, plus half of its own longer
    step. The robots are then also clear between steps, and if the other robot is up to half a step early
    or late. With `start` (..., 3), the position before the first step, a robot that is already too close
    may move if it is never closer than it would be by staying.
    """
    if len(peers) == 0:
        return torch.ones(path.shape[:-2], dtype=torch.bool, device=path.device)
    n_path, n_traffic = path.shape[-2], peers.paths.shape[1]
    # One robot rests after the shorter path ends.
    n = max(n_path, n_traffic)
    there = peers.paths[:, torch.arange(n).clamp_max(n_traffic - 1)]
    least = peers.separation + _longer_step(there)
    own = path if start is None else torch.cat([start[..., None, :], path], -2)
    sway = _longer_step(own)[..., own.shape[-2] - n_path :] / 2
    clear = torch.ones(path.shape[:-2], dtype=torch.bool, device=path.device)
    for other, needed in zip(there, least, strict=True):
        ahead, after = other[:n_path], other[n_path:]
        required = needed[:n_path] + sway
        if start is not None:
            required = torch.minimum(required, _distance(start[..., None, :], ahead))
        clear &= (_distance(path, ahead) >= required).all(-1)
        if len(after):
            required = needed[n_path:]
            if start is not None:
                required = torch.minimum(required, _distance(start[..., None, :], after))
            clear &= (_distance(path[..., -1:, :], after) >= required).all(-1)
    return clear


def predicted_path(plan: PlanMessage, age: float, step: float) -> Tensor:
    """Positions (S, 3), metres, of a teammate after 1, 2, …, S steps of `step` seconds from now, by a plan
    that was heard `age` seconds ago: on straight lines between the plan's poses, and on the first of these
    before its first pose."""
    n = len(plan.path)
    left = n * plan.step - age
    ahead = step * torch.arange(1, min(max(math.ceil(left / step - 1e-9), 1), _MOST_STEPS) + 1)
    at = ((age + ahead.double()) / plan.step - 1).clamp(-1, n - 1)
    before = at.floor().clamp(0, max(n - 2, 0)).long()
    path = plan.path[:, :3].double()
    return torch.lerp(path[before], path[(before + 1).clamp_max(n - 1)], (at - before)[:, None])


def _longer_step(path: Tensor) -> Tensor:
    """Return the longer step, metres (..., L), before or after each position of paths (..., L, 3)."""
    step = (path[..., 1:, :] - path[..., :-1, :]).norm(dim=-1)
    pad = torch.nn.functional.pad
    return torch.maximum(pad(step, (0, 1)), pad(step, (1, 0)))


def _distance(a: Tensor, b: Tensor) -> Tensor:
    return (a - b).norm(dim=-1)
