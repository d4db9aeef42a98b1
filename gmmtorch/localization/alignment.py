"""Alignment of a scan's points with the surfaces of a map, from a rough pose.

The log-likelihood of N points p_n under the pose T = (R, t), with each component as a kernel of height one
and a uniform density ε of outliers, is

    ℓ(T) = Σ_n log(1 + q_n / ε),   q_n = Σ_k exp(−½ d_nkᵀ (Σ_k + s² I)⁻¹ d_nk),   d_nk = R p_n + t − μ_k

(point-to-distribution NDT, Magnusson 2009, with an annealed blur s). Newton's steps climb it on SE(3) or
SE(2); where −∇²ℓ is not positive definite, EM's steps do. Each point adds at most log(1 + q_n/ε), so people
and other changes have little weight. A flat component that was seen from one side only is left out while the
sensor is behind it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels import (
    AlignmentSums,
    AlignmentTable,
    Lists,
    NearLists,
    alignment_scores,
    alignment_sums,
    fused_alignment,
    fused_box_lists,
    is_fused,
    surface_rows,
)
from gmmtorch.mapping import Components
from gmmtorch.mixture import Parameters, merge_components
from gmmtorch.occupancy import cells_in_chunks, row_major
from gmmtorch.pose import Pose

CUTOFF = 3.5
"""Deviations beyond which a component is left out of a point."""

_OUTLIERS = 0.05  # ε, relative to the peak of a component
_EXPLAINED = 0.1  # q above which components explain a point
_INSIDE = 5.0  # nats of a point on a surface, however many components it touches
_SETTLED = 0.05  # of the blur: steps below this end a climb
_SADDLE = 0.05  # of EM's information: with less curvature Newton's step is too long
_SIDE = 2.0  # blurs of a cell of the lists
_MOST_CELLS = 1 << 20  # of the lists, and entries
_RIDGE = 1e-9
_TURNED = math.radians(10)  # between the headings of neighbouring starts, for each metre between their places
_FLAT = 0.25  # of the next deviation: thinner components have a face
_THIN = 0.1  # metres of deviation of a surface that tells a direction
_PARALLEL, _ANOTHER = math.radians(6), math.radians(30)  # between normals of one direction, and of two


class Alignment(NamedTuple):
    """Of B motions, world ← sensor: ℓ/N (B,), the share of explained points (B,), −∇²ℓ (B, F, F) in a shift v
    (m) and a turn ω (rad) about the sensor, F = D + D(D−1)/2, and whether the last step was small (B,)."""

    motions: Pose
    score: Tensor
    explained: Tensor
    information: Tensor
    converged: Tensor

    @property
    def evidence(self) -> Tensor:
        """Nats of a point (B,) for a pose: ℓ/N, in which a point that touches many components counts more
        than its surface tells, and as much for each explained point."""
        return self.score + _INSIDE * self.explained

    def at(self, rows: Tensor) -> Alignment:
        return Alignment(self.motions[rows], *(value[rows] for value in self[1:]))


class AlignmentTarget:
    """The surfaces of a map at one blur, listed by place.

    Args:
        surfaces: near the origin; their weights are not used.
        blur: s (m), above zero.
        normals: (K, D), towards the side from which a surface is seen; zero: from all sides. A sensor behind
            a surface by more than the blur does not see it, so the two faces of a wall are not confused.
        lists: of a target with the same surfaces and a larger blur. None: they are made.
    """

    def __init__(
        self, surfaces: Parameters, blur: float, normals: Tensor | None = None, lists: NearLists | None = None
    ) -> None:
        means, dim = surfaces.means, surfaces.means.shape[1]
        covariances = surfaces.covariances + blur**2 * torch.eye(dim).to(means)
        normals = torch.zeros_like(means) if normals is None else normals.to(means)
        self.blur = blur
        lists = _near_lists(means, covariances, blur) if lists is None else lists
        parts = means, torch.linalg.inv(covariances), normals
        self.table = AlignmentTable(
            lists, *parts, surface_rows(*parts), blur, CUTOFF**2, _OUTLIERS, _OUTLIERS + _EXPLAINED
        )

    def sums(self, points: Tensor, motions: Pose) -> AlignmentSums:
        """ℓ of points (N, D) under each motion, and its derivatives."""
        return alignment_sums(points, motions.parts, self.table)

    def scores(self, points: Tensor, motions: Pose) -> Tensor:
        """ℓ (B,) of points (N, D) under each of many motions."""
        return alignment_scores(points, motions.parts, self.table)


def _near_lists(means: Tensor, covariances: Tensor, blur: float) -> NearLists:
    """For each cell of a lattice, the components whose box of `CUTOFF` deviations meets it."""
    half = CUTOFF * covariances.diagonal(dim1=1, dim2=2).sqrt()
    low = (means - half).amin(0)
    side = _SIDE * blur
    while True:
        first, last = (((means + way * half - low) / side).floor().clamp_min(0).long() for way in (-1, 1))
        shape = last.amax(0) + 1
        sizes = shape.tolist()
        n_entries = int((last - first + 1).prod(1).sum())
        if math.prod(sizes) <= _MOST_CELLS and n_entries <= _MOST_CELLS:
            break
        side *= 1.5
    if is_fused(means):
        return NearLists(low, side, shape, *fused_box_lists(first, last, sizes, n_entries))
    component, cells = next(cells_in_chunks(first, last - first + 1, _MOST_CELLS))  # in one chunk
    cell = row_major(cells.unbind(), tuple(sizes))
    lengths = torch.bincount(cell, minlength=math.prod(sizes))
    lists = Lists.of(lengths, component[cell.argsort(stable=True)].int())
    return NearLists(low, side, shape, *lists)


def seen_normals(surfaces: Components) -> Tensor:
    """Unit normals (K, D), towards the sensor, of the surfaces that are flat and seen from one side; zero for
    the others. In the order of `surface_mixture`."""
    solid = ~surfaces.max_range & (surfaces.support > 0)
    variances, axes = torch.linalg.eigh(surfaces.covariances.double())
    normals = axes[:, :, 0]
    views = surfaces.origins.double()[surfaces.seen_from] - surfaces.means.double()[surfaces.seen_by]
    heights = (views * normals[surfaces.seen_by]).sum(1)
    sides = [torch.zeros(len(normals)).to(normals).index_add(0, surfaces.seen_by, side.to(normals))
             for side in (heights > 0, heights < 0)]  # fmt: skip
    sign = (sides[0] > 0).to(normals) - (sides[1] > 0).to(normals)  # 0 if seen from both sides
    is_flat = variances[:, 0] < _FLAT**2 * variances[:, 1]
    return (normals * (sign * is_flat)[:, None])[solid]


def deviations(mixture: Parameters) -> Tensor:
    """Standard deviations (K, D) along the principal axes, in rising order."""
    return torch.linalg.eigvalsh(mixture.covariances).clamp_min(0).sqrt()


def merged_below(surfaces: Parameters, normals: Tensor, blur: float) -> tuple[Parameters, Tensor]:
    """The surfaces with those merged that a blur hides: smaller ones of one side in a cell of that size."""
    small = deviations(surfaces)[:, -1] < blur
    alone = torch.where(small, -1, torch.arange(len(small)).to(small.device))
    keys = torch.cat([(surfaces.means / blur).floor(), normals.round(), alone[:, None]], 1)
    cells, labels = torch.unique(keys, dim=0, return_inverse=True)
    summed = torch.zeros(len(cells), normals.shape[1]).to(normals).index_add(0, labels, normals)
    return merge_components(*surfaces, labels, len(cells)), torch.nn.functional.normalize(summed)


def align(points: Tensor, target: AlignmentTarget, motions: Pose, max_steps: int) -> Alignment:
    """Climbs ℓ from B motions in parallel. A step that lowers ℓ is taken back, and the next one is shorter.

    Args:
        points: (N, D), N at least 1, sensor frame, metres, float64.
        motions: world ← sensor. max_steps: evaluations of ℓ after the first one.
    """
    n, dim = points.shape
    if is_fused(points, *motions.parts, target.table.means):
        limits = _SETTLED * target.blur, max_steps
        # Neighbours take as long: lanes of a vector do not wait for each other.
        points = points[torch.atan2(points[:, 1], points[:, 0]).argsort()]
        parts, sums, settled = fused_alignment(points, motions.parts, target.table, *limits)
        return Alignment(Pose(*parts), sums.score / n, sums.n_explained / n, sums.observed, settled)
    scale = points.new_ones(dim + dim * (dim - 1) // 2)
    scale[dim:] = 1 / points.norm(dim=1).amax().clamp_min(1e-9)  # a unit moves the farthest point by a metre
    sums = target.sums(points, motions)
    share = torch.ones_like(sums.score)
    settled = torch.zeros_like(sums.score, dtype=torch.bool)
    for _ in range(max_steps):
        step = _steps(sums, scale, target.blur) * share[:, None]
        trial = motions.moved(step)
        tried = target.sums(points, trial)
        better = tried.score >= sums.score
        motions = Pose(*chosen_rows(better, trial.parts, motions.parts))
        sums = AlignmentSums(*chosen_rows(better, tried, sums))
        share = torch.where(better, (2 * share).clamp_max(1), share / 4)
        settled = (step / scale).norm(dim=1) < _SETTLED * target.blur
        if bool(settled.all()):
            break
    return Alignment(motions, sums.score / n, sums.n_explained / n, sums.observed, settled)


def chosen_rows(better: Tensor, new: tuple[Tensor, ...], old: tuple[Tensor, ...]) -> list[Tensor]:
    """Rows of `new` where `better` (B,), else of `old`."""
    return [torch.where(better.view(-1, *[1] * (n.ndim - 1)), n, o) for n, o in zip(new, old, strict=True)]


def _steps(sums: AlignmentSums, scale: Tensor, longest: float) -> Tensor:
    """Steps (B, F), Newton's or EM's, which move no point by more than about `longest` metres."""
    outer = scale[:, None] * scale
    complete = sums.complete * outer
    ridge = _RIDGE * complete.diagonal(dim1=1, dim2=2).amax(1).clamp_min(1e-12)
    complete = complete + ridge[:, None, None] * torch.eye(len(scale)).to(scale)
    observed = sums.observed * outer
    _, flawed = torch.linalg.cholesky_ex(observed - _SADDLE * complete)
    curvature = torch.where((flawed == 0)[:, None, None], observed, complete)
    step = torch.linalg.solve(curvature, sums.gradient * scale)
    length = step.norm(dim=1, keepdim=True)
    return step * (longest / length.clamp_min(longest)) * scale


def differences(some: Pose, others: Pose, distance: float, angle: float) -> Tensor:
    """How different motions are (A, B): the larger of the shift in `distance` and the turn in `angle`."""
    shift = torch.cdist(some.translation, others.translation)
    mode = "donot_use_mm_for_euclid_dist"  # which is exact
    chord = torch.cdist(some.rotation.flatten(1), others.rotation.flatten(1), compute_mode=mode)
    turn = chord / math.sqrt(2)
    return torch.maximum(shift / distance, turn / angle)


def distinct(motions: Pose, distance: float, angle: float) -> Tensor:
    """Rows of motions, best first, without those within both (m, rad) of a better one."""
    is_near = differences(motions, motions, distance, angle) < 1
    return (~is_near.tril(-1).any(1)).nonzero().squeeze(1)


def best_distinct(motions: Pose, score: Tensor, distance: float) -> Tensor:
    """Rows of motions by falling score, without those close to a better one: by less than `distance` (m) and
    the turn that belongs to it."""
    order = score.argsort(descending=True, stable=True)
    return order[distinct(motions[order], distance, _TURNED * distance)]


def around(start: Pose, distance: float, angle: float, blur: float) -> Pose:
    """Starts on a lattice of places, `blur` metres apart, up to `distance` metres from one along the ground,
    and of headings up to `angle` radians; the start itself among them."""
    like = start.translation
    n, m = math.ceil(distance / blur), math.ceil(angle / (_TURNED * blur))
    side = torch.linspace(-distance, distance, 2 * n + 1).to(like)
    places = torch.cartesian_prod(side, side)
    places = places[places.norm(dim=1) <= distance * (1 + 1e-9)]
    places = torch.nn.functional.pad(places, (0, start.dim - 2))
    turned = Pose.from_yaw(torch.linspace(-angle, angle, 2 * m + 1).to(like), torch.zeros_like(like[0]))
    return _crossed(turned.rotation @ start.rotation, like + places)


def everywhere(places: Tensor, blur: float, axes: Tensor, targets: Tensor) -> Pose:
    """Starts in space at places (S, 3), with all headings about each of some axes (A, 3) of the map, to which
    they turn the axes (A, 3) of the sensor."""
    n = math.ceil(math.pi / (_TURNED * blur))
    angles = torch.arange(n).to(places) * (2 * math.pi / n)
    headings = Pose.from_yaw(angles, torch.zeros_like(places[0])).rotation
    turned = _frames(targets)[:, None] @ headings @ _frames(axes).mT[:, None]
    return _crossed(turned.flatten(0, 1), places)


def main_normals(surfaces: Parameters, most: int = 3) -> Tensor:
    """Unit vectors (A, 3), A at most `most`, of either sign: the normal of most of the flat area, then of
    most of what is left when the surfaces about parallel to it are taken away. Indoors these are up and the
    directions of two walls."""
    variances, axes = torch.linalg.eigh(surfaces.covariances)
    normals = axes[:, :, 0]
    is_flat = (variances[:, 0] < _THIN**2) & (variances[:, 0] < _FLAT**2 * variances[:, 1])
    area = torch.where(is_flat, (variances[:, 1] * variances[:, 2]).clamp_min(0).sqrt(), 0.0)
    found = normals[:0]
    while len(found) < most and bool((area > 0).any()):
        alike = torch.where((normals[area > 0] @ normals.mT).abs() > math.cos(_PARALLEL), area, 0.0)
        alike = alike[alike.sum(1).argmax()]
        main = torch.linalg.eigh((normals * alike[:, None]).mT @ normals).eigenvectors[:, -1]
        found = torch.cat([found, main[None]])
        area = torch.where((normals @ main).abs() > math.cos(_ANOTHER), 0.0, area)
    return found


def _frames(axes: Tensor) -> Tensor:
    """Rotations (A, 3, 3) that turn z to the unit vectors (A, 3)."""
    other = torch.nn.functional.one_hot(axes.abs().argmin(1), 3).to(axes)
    x = torch.nn.functional.normalize(torch.linalg.cross(other, axes))
    return torch.stack([x, torch.linalg.cross(axes, x), axes], 2)


def _crossed(rotations: Tensor, translations: Tensor) -> Pose:
    """Every pair of a rotation and a translation."""
    n = len(rotations)
    return Pose(rotations.repeat(len(translations), 1, 1), translations.repeat_interleave(n, 0))
