"""Registration: the rigid motion that aligns one mixture with another, without points or correspondences."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError, check_choice, check_number, check_whole
from gmmtorch.linalg import check_rigid, nearest_rotations, plane_rotations
from gmmtorch.localization.registration.overlap import Ascent, deviations, log_self_overlap
from gmmtorch.localization.rigid_motions import Motions
from gmmtorch.mapping import Surfaces, surface_mixture
from gmmtorch.mixture import Parameters, merge_components

_BEST_KEPT = 4  # poses that go on from one level to the next,
_LEAST_SHARE = 0.7  # of the best one's score at least
_SECOND_CHANCE = 2  # levels below the first: a single initial pose is tried there once more
_COARSELY = 0.05  # blurs: the tolerance of all levels but the last
_THINNEST = 1e-6  # blur, in radii: covariances without any thickness can be inverted, too
_LEAST_OVERLAP = 0.05
_WIDEST = 0.1  # of the smaller mixture's radius
_AMBIGUOUS = 0.9  # share of the best score


@dataclass(frozen=True, eq=False)
class Registration:
    """The result of `register`.

    transform: (D+1, D+1), target ← source.
    score: S(T) = ∫ f(T⁻¹x) g(x) dx of the mixtures, weights adding up to one, m⁻ᴰ.
    overlap: S over the geometric mean of both mixtures' own, 0 to 1 (Cauchy–Schwarz).
    hessian: (F, F), −∇² log S (approximate, see `Overlap`) in a shift v (m, F = D + D(D−1)/2) and a turn ω
        (rad) of the moved source about its mean. Its inverse is the shape of the peak, not a covariance of
        the error, because it does not depend on how much of both scans is the same surface.
    width: metres that the source can slide, or turn at its radius, in its loosest direction before S falls
        to 61 % (1/√ of the least eigenvalue of the Hessian).
    n_iterations: evaluations of the score, over all levels.
    converged: whether the last step was below the tolerance.
    doubts: reasons against the result; it is `reliable` if there are none.
    """

    transform: Tensor
    score: float
    overlap: float
    hessian: Tensor
    width: float
    n_iterations: int
    converged: bool
    doubts: tuple[str, ...]

    @property
    def reliable(self) -> bool:
        """Whether there are no doubts."""
        return not self.doubts


def register(
    source: Surfaces,
    target: Surfaces,
    initial: ArrayLike | None = None,
    *,
    coarsest: float | None = None,
    finest: float | None = None,
    max_iterations: int = 60,
    tolerance: float = 1e-5,
    weighting: str = "area",
) -> Registration:
    """The rigid motion T (target ← source) that maximises the overlap of two mixtures.

        S(T) = Σ_ij π_i π_j N(R μ_i + t | μ_j, R Σ_i Rᵀ + Σ_j + s² I)

    Coarse to fine: s is halved from `coarsest` to `finest`. While s exceeds the components' size, those in
    one cell of side s are merged first, so coarse levels are small. A level maximises log S by Newton steps
    on SE(3) or SE(2), with the absolute values of the curvatures; each is shortened until the score rises.
    Pairs beyond four standard deviations are left out. Of several maxima, the result is the best one that the
    surfaces constrain in all directions.

    Args:
        source, target: maps, components, or (means, covariances, weights). `max_range` components are left
            out.
        initial: (D+1, D+1), or (B, D+1, D+1) for several starts, of which the best is the result: see
            `yaw_starts`. None: the identity.
        coarsest: first s (m), if the initial pose is known to about that much, as in tracking: coarser levels
            are left out, and a single start is tried once. None: an eighth of the smaller mixture's radius
            (root mean square), and a single start is tried again two levels below.
        finest: last s (m). None: the median of the components' smallest deviations.
        max_iterations: of a level.
        tolerance: metres, also of a turn at the mixture's radius, below which a step ends a level.
        weighting: π by "area", √(λ₁λ₂) of the largest eigenvalues (√λ₁ in 2D), or by "support", the points
            of each. Points are densest near the sensor, so supports would place one sensor at the other.

    Raises:
        InvalidArgumentError: no component with a surface; 2D against 3D; an initial pose that is not
            rigid; NaN. NumericalError: an indefinite covariance. MemoryLimitError: tens of millions of
            pairs at once.
    """
    f, g = surface_mixture(source, "source"), surface_mixture(target, "target")
    _check_together(f, g)
    check_choice("weighting", weighting, ("area", "support"))
    if weighting == "area":
        f, g = _by_area(f), _by_area(g)
    dim = f.means.shape[1]
    for name, value in (("coarsest", coarsest), ("finest", finest), ("tolerance", tolerance)):
        if value is not None:
            check_number(name, value, above=name != "finest")
    check_whole("max_iterations", max_iterations, 1)
    start = _starts(initial, dim).to(f.means.device)
    # Both are centred on their means, so that numbers stay small anywhere in the world.
    (f, here), (g, there) = _centered(f), _centered(g)
    motions = _between(start, here, there)
    radius = min(_radius(f), _radius(g))
    blurs = _blurs(f, g, radius, coarsest, finest)

    f_levels, g_levels = _levels(f, blurs), _levels(g, blurs)
    n_evaluated, climbed = 0, motions
    for number, blur in enumerate(blurs):
        if coarsest is None and len(start) == 1 and number == _SECOND_CHANCE:
            climbed = climbed.joined(motions)  # in case a coarser level climbed a wrong peak
        last = number == len(blurs) - 1
        ascent = Ascent(f_levels[number], g_levels[number], radius)
        accuracy = tolerance if last else max(tolerance, _COARSELY * blur)
        climbed, found, converged = ascent.run(climbed, max_iterations, accuracy)
        n_evaluated += ascent.n_evaluated
        best = _promising(climbed, found.log_score, radius, 0.5 * ascent.thickness)
        climbed, found, converged = climbed.at(best), found.at(best), converged[best]
    hessian = found.information - found.scatter
    width = _widths(hessian, ascent.scale)
    held = (width > _WIDEST * radius).argsort(stable=True)  # first the poses that the surfaces hold
    own = log_self_overlap(ascent.source) + log_self_overlap(ascent.target)
    share = torch.exp((found.log_score[held] - own / 2).clamp_max(0))
    first = int(held[0])
    return Registration(
        transform=_world(climbed.at(held[:1]), here, there)[0],
        score=float(found.log_score[first].exp()),
        overlap=float(share[0]),
        hessian=hessian[first],
        width=float(width[first]),
        n_iterations=n_evaluated,
        converged=bool(converged[first]),
        doubts=_doubts(share, float(width[first]), radius, bool(converged[first])),
    )


def yaw_starts(source: Surfaces, target: Surfaces, n: int = 12) -> Tensor:
    """Initial poses (n, D+1, D+1) for an unknown one: headings 2πk/n about the vertical, mean on mean.

    Arguments and errors as for `register`; n: how many.
    """
    check_whole("n", n, 1)
    f, g = surface_mixture(source, "source"), surface_mixture(target, "target")
    _check_together(f, g)
    dim = f.means.shape[1]
    angle = torch.arange(n, device=f.means.device, dtype=torch.float64) * (2 * math.pi / n)
    starts = torch.eye(dim + 1, device=f.means.device, dtype=torch.float64).repeat(n, 1, 1)
    starts[:, :2, :2] = plane_rotations(angle)
    (_, here), (_, there) = _centered(f), _centered(g)
    starts[:, :dim, dim] = there - starts[:, :dim, :dim] @ here
    return starts


# -- mixtures -------------------------------------------------------------------------------------


def _check_together(source: Parameters, target: Parameters) -> None:
    for name, mixture in (("source", source), ("target", target)):
        if not len(mixture.weights):
            raise InvalidArgumentError(
                f"{name} has no component that is a surface and has weight; there is nothing to register."
            )
    dims = source.means.shape[1], target.means.shape[1]
    if dims[0] != dims[1]:
        raise InvalidArgumentError(
            f"source is {dims[0]}-dimensional, target {dims[1]}-dimensional; give two of one dimension."
        )


def _by_area(mixture: Parameters) -> Parameters:
    """Weighted by what a component covers, √(λ₁λ₂) of its largest eigenvalues in 3D, √λ₁ in 2D."""
    return mixture._replace(weights=deviations(mixture)[:, 1:].prod(1))


def _centered(mixture: Parameters) -> tuple[Parameters, Tensor]:
    """The mixture, weights adding up to one, about its mean; and the mean (D,)."""
    weights = mixture.weights / mixture.weights.sum()
    rough = mixture.means.mean(0)  # first, so that far from the origin the mean keeps its digits
    mean = rough + weights @ (mixture.means - rough)
    return Parameters(weights, mixture.means - mean, mixture.covariances), mean


def _radius(mixture: Parameters) -> float:
    """Root mean square distance from its mean of a mixture about it."""
    spread = mixture.means.square().sum(1) + mixture.covariances.diagonal(dim1=1, dim2=2).sum(1)
    return math.sqrt(float(mixture.weights @ spread))


def _blurs(
    source: Parameters, target: Parameters, radius: float, coarsest: float | None, finest: float | None
) -> list[float]:
    """s (m) of each level."""
    thickness = min(float(deviations(mixture)[:, 0].median()) for mixture in (source, target))
    last = max(thickness if finest is None else float(finest), _THINNEST * radius)
    blur = radius / 8 if coarsest is None else float(coarsest)
    blurs = []
    while blur > math.sqrt(2) * max(last, thickness):
        blurs.append(blur)
        blur /= 2
    return [*blurs, last]


def _levels(mixture: Parameters, blurs: list[float]) -> list[Parameters]:
    """For each blur s, the mixture with ½ s² I added to every covariance.

    Once s exceeds the components' size, those in a cell of side s are merged first.
    """
    size = float(deviations(mixture)[:, -1].median())
    eye = torch.eye(mixture.means.shape[1]).to(mixture.means)
    levels = []
    for blur in blurs:
        merged = _merged_in_cells(mixture, blur) if blur > size else mixture
        levels.append(merged._replace(covariances=merged.covariances + 0.5 * blur**2 * eye))
    return levels


def _merged_in_cells(mixture: Parameters, side: float) -> Parameters:
    cells, labels = torch.unique((mixture.means / side).floor(), dim=0, return_inverse=True)
    return merge_components(*mixture, labels, len(cells))


# -- motions --------------------------------------------------------------------------------------


def _starts(initial: ArrayLike | None, dim: int) -> Tensor:
    """Initial poses (B, D+1, D+1)."""
    if initial is None:
        return torch.eye(dim + 1, dtype=torch.float64)[None]
    poses = as_tensor(initial, "initial", torch.float64).detach()
    poses = poses[None] if poses.ndim == 2 else poses
    if poses.ndim != 3 or not len(poses):
        raise InvalidArgumentError(
            f"initial has shape {tuple(poses.shape)}; expected ({dim + 1}, {dim + 1}), or several of them."
        )
    for pose in poses:
        check_rigid(pose, dim)
    return poses


def _between(poses: Tensor, here: Tensor, there: Tensor) -> Motions:
    """Poses (B, D+1, D+1) of the world as motions of the source about `here` to the target about `there`."""
    dim = len(here)
    rotations = poses[:, :dim, :dim]
    return Motions(rotations, rotations @ here + poses[:, :dim, dim] - there)


def _world(motions: Motions, here: Tensor, there: Tensor) -> Tensor:
    """The inverse of `_between`, (B, D+1, D+1), rotations orthonormal to rounding."""
    dim = len(here)
    rotations = nearest_rotations(motions.rotations)
    poses = torch.eye(dim + 1).to(here).repeat(len(rotations), 1, 1)
    poses[:, :dim, :dim] = rotations
    poses[:, :dim, dim] = motions.translations + there - rotations @ here
    return poses


def _promising(motions: Motions, log_score: Tensor, radius: float, apart: float) -> Tensor:
    """The best motions by falling score, without those within `apart` (m) of a better one or far below
    the best.
    """
    order = log_score.argsort(descending=True, stable=True)
    rotations, translations = motions.at(order)
    turn = torch.linalg.matrix_norm(rotations[:, None] - rotations) / math.sqrt(2)
    distance = (translations[:, None] - translations).norm(dim=2) + radius * turn
    worth = ~(distance < apart).tril(-1).any(1)
    worth &= log_score[order] >= log_score[order[0]] + math.log(_LEAST_SHARE)
    return order[worth][:_BEST_KEPT]


# -- trust ----------------------------------------------------------------------------------------


def _widths(hessian: Tensor, scale: Tensor) -> Tensor:
    """Metres (B,) that the source can slide or turn; infinite where the Hessian (B, F, F) is not definite."""
    least = torch.linalg.eigvalsh(hessian * scale[:, None] * scale)[:, 0]
    return torch.where(least > 0, least.clamp_min(1e-300).rsqrt(), torch.inf)


def _doubts(share: Tensor, width: float, radius: float, converged: bool) -> tuple[str, ...]:
    """Reasons against a result; shares (B,) are the overlaps of the final poses, best first."""
    doubts = []
    if not converged:
        doubts.append("the last step was longer than the tolerance, or no component was near another")
    if not float(share[0]) >= _LEAST_OVERLAP:
        doubts.append(f"the overlap {float(share[0]):.3f} is below {_LEAST_OVERLAP}: hardly a common surface")
    if not width <= _WIDEST * radius:
        doubts.append(f"the source can slide or turn by {width:.3g} m: the surfaces do not hold it")
    others = share[1:].max() if len(share) > 1 else 0.0
    if float(others) > _AMBIGUOUS * float(share[0]):
        doubts.append(f"another pose has an overlap of {float(others):.3f}, against {float(share[0]):.3f}")
    return tuple(doubts)
