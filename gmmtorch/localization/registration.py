"""Registration: the rigid motion that aligns one mixture with another, without points or correspondences.

The overlap of densities f and g is ∫ f g dx, for mixtures a sum over pairs of components:

    S(R, t) = Σ_ij π_i π_j N(R μ_i + t | μ_j, R Σ_i Rᵀ + Σ_j)

(Jian & Vemuri 2011; distribution-to-distribution NDT, Stoyanov et al. 2012). A motion is perturbed by a
shift v and a turn ω as `Pose.moved` defines it. With d = R μ_i + t − μ_j, A = R Σ_i Rᵀ,
C = A + Σ_j, W = C⁻¹, z = W d and lever l = R μ_i, of each pair

    ∂ log N/∂v = −z,   ∂ log N/∂ω_k = −zᵀ G_k (l − A z) − tr(G_k A W).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError, check_choice, check_number, check_whole
from gmmtorch.kernels import Registered, fused_registration, is_fused
from gmmtorch.linalg import safe_cholesky
from gmmtorch.localization.alignment import chosen_rows, deviations
from gmmtorch.mapping import Surfaces, surface_mixture, touching
from gmmtorch.mixture import Parameters, merge_components
from gmmtorch.pose import Pose, generators

_BEST_KEPT = 4  # poses that go on from one level to the next,
_LEAST_SHARE = 0.7  # of the best one's score at least
_SECOND_CHANCE = 2  # levels below the first: a single initial pose is tried there once more
_COARSELY = 0.05  # blurs: the tolerance of all levels but the last
_THINNEST = 1e-6  # blur, in radii: covariances without any thickness can be inverted, too
_LEAST_OVERLAP = 0.05
_WIDEST = 0.1  # of the smaller mixture's radius
_AMBIGUOUS = 0.9  # share of the best score
_CUTOFF = 4.0  # deviations beyond which a pair is left out: its term is below 4e-4 of its maximum
_SLACK = 0.5  # of the thickness: components may move this far before pairs are listed again
_LEAST_CURVATURE = 0.05  # of the information
_LONGEST = 1.0  # step, as the root mean square of the Mahalanobis distances that pairs move by,
_THICKNESSES = 4  # and in thicknesses of the components
_CHUNK = 1 << 14  # pairs processed at a time, so that they stay in a core's cache


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
    dim = f.means.shape[1]
    for name, value in (("coarsest", coarsest), ("finest", finest), ("tolerance", tolerance)):
        if value is not None:
            check_number(name, value, above=name != "finest")
    check_whole("max_iterations", max_iterations, 1)
    start = _starts(initial, dim, f.means.device)
    by_area, blurs, limits = weighting == "area", (coarsest, finest), (tolerance, max_iterations)
    climb = fused_registration if is_fused(*f, *g, *start.parts) else _climbed
    found = climb(f, g, start.parts, by_area, blurs, limits)
    held = [width <= _WIDEST * found.radius for width in found.widths]
    order = sorted(range(len(held)), key=lambda row: not held[row])  # first those that the surfaces hold
    first = order[0]
    share = [math.exp(min(found.log_scores[row] - found.own / 2, 0.0)) for row in order]
    device, width, converged = f.means.device, found.widths[first], found.converged[first]
    return Registration(
        transform=found.transforms[first].to(device),
        score=math.exp(found.log_scores[first]),
        overlap=share[0],
        hessian=found.hessians[first].to(device),
        width=width,
        n_iterations=found.n_evaluated,
        converged=converged,
        doubts=_doubts(share, width, found.radius, converged),
    )


def _climbed(
    f: Parameters,
    g: Parameters,
    starts: tuple[Tensor, Tensor],
    by_area: bool,
    limits_of_blur: tuple[float | None, float | None],
    limits: tuple[float, int],
) -> Registered:
    """The twin of `kernels.fused_registration`."""
    if by_area:  # what a component covers: √(λ₁λ₂) of its largest eigenvalues in 3D, √λ₁ in 2D
        f, g = (mixture._replace(weights=deviations(mixture)[:, 1:].prod(1)) for mixture in (f, g))
    # Both are centred on their means, so that numbers stay small anywhere in the world.
    (f, here), (g, there) = _centered(f), _centered(g)
    motions = _between(Pose(*starts), here, there)
    radius = min(_radius(f), _radius(g))
    blurs = _blurs(f, g, radius, *limits_of_blur)
    f_levels, g_levels = _levels(f, blurs), _levels(g, blurs)
    n_evaluated, climbed = 0, motions
    for number, blur in enumerate(blurs):
        if limits_of_blur[0] is None and len(motions) == 1 and number == _SECOND_CHANCE:
            climbed = Pose.cat([climbed, motions])  # in case a coarser level climbed a wrong peak
        accuracy = limits[0] if blur == blurs[-1] else max(limits[0], _COARSELY * blur)
        ascent = Ascent(f_levels[number], g_levels[number], radius)
        climbed, found, converged = ascent.run(climbed, limits[1], accuracy)
        n_evaluated += ascent.n_evaluated
        best = _promising(climbed, found.log_score, radius, 0.5 * ascent.thickness)
        climbed, found, converged = climbed[best], found.at(best), converged[best]
    hessian = found.information - found.scatter
    return Registered(
        _world(climbed, here, there).matrix, found.log_score.tolist(), converged.tolist(),
        _widths(hessian, ascent.scale).tolist(), hessian, n_evaluated, radius,
        log_self_overlap(ascent.source) + log_self_overlap(ascent.target),
    )  # fmt: skip


def yaw_starts(source: Surfaces, target: Surfaces, n: int = 12) -> Tensor:
    """Initial poses (n, D+1, D+1) for an unknown one: headings 2πk/n about the vertical, mean on mean.

    Arguments and errors as for `register`; n: how many.
    """
    check_whole("n", n, 1)
    f, g = surface_mixture(source, "source"), surface_mixture(target, "target")
    _check_together(f, g)
    angle = torch.arange(n, device=f.means.device, dtype=torch.float64) * (2 * math.pi / n)
    (_, here), (_, there) = _centered(f), _centered(g)
    turned = Pose.from_yaw(angle, torch.zeros_like(here))
    return Pose(turned.rotation, there - turned.rotation @ here).matrix


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
        merged = mixture
        if blur > size:
            cells, labels = torch.unique((mixture.means / blur).floor(), dim=0, return_inverse=True)
            merged = merge_components(*mixture, labels, len(cells))
        levels.append(merged._replace(covariances=merged.covariances + 0.5 * blur**2 * eye))
    return levels


def _starts(initial: ArrayLike | None, dim: int, device: torch.device) -> Pose:
    """Initial poses (B)."""
    if initial is None:
        return Pose.identity(dim, 1, device=device)
    poses = as_tensor(initial, "initial", torch.float64, device).detach()
    poses = poses[None] if poses.ndim == 2 else poses
    if poses.ndim != 3 or not len(poses):
        raise InvalidArgumentError(
            f"initial has shape {tuple(poses.shape)}; expected ({dim + 1}, {dim + 1}), or several of them."
        )
    return Pose.checked(poses, dim, "initial", n=len(poses))


def _between(poses: Pose, here: Tensor, there: Tensor) -> Pose:
    """Poses (B) of the world as motions of the source about `here` to the target about `there`."""
    return Pose(poses.rotation, poses.apply(here[None])[..., 0, :] - there)


def _world(motions: Pose, here: Tensor, there: Tensor) -> Pose:
    """The inverse of `_between`, rotations orthonormal to rounding."""
    turn = motions.orthonormal().rotation
    return Pose(turn, motions.translation + there - turn @ here)


def _promising(motions: Pose, log_score: Tensor, radius: float, apart: float) -> Tensor:
    """The best motions by falling score, without those within `apart` (m) of a better one or far below
    the best.
    """
    order = log_score.argsort(descending=True, stable=True)
    rotations, translations = motions[order].parts
    turn = torch.linalg.matrix_norm(rotations[:, None] - rotations) / math.sqrt(2)
    distance = (translations[:, None] - translations).norm(dim=2) + radius * turn
    worth = ~(distance < apart).tril(-1).any(1)
    worth &= log_score[order] >= log_score[order[0]] + math.log(_LEAST_SHARE)
    return order[worth][:_BEST_KEPT]


def _widths(hessian: Tensor, scale: Tensor) -> Tensor:
    """Metres (B,) that the source can slide or turn; infinite where the Hessian (B, F, F) is not definite."""
    least = torch.linalg.eigvalsh(hessian * scale[:, None] * scale)[:, 0]
    return torch.where(least > 0, least.clamp_min(1e-300).rsqrt(), torch.inf)


def _doubts(share: list[float], width: float, radius: float, converged: bool) -> tuple[str, ...]:
    """Reasons against a result; shares are the overlaps of the final poses, best first."""
    doubts = []
    if not converged:
        doubts.append("the last step was longer than the tolerance, or no component was near another")
    if not share[0] >= _LEAST_OVERLAP:
        doubts.append(f"the overlap {share[0]:.3f} is below {_LEAST_OVERLAP}: hardly a common surface")
    if not width <= _WIDEST * radius:
        doubts.append(f"the source can slide or turn by {width:.3g} m: the surfaces do not hold it")
    others = max(share[1:], default=0.0)
    if others > _AMBIGUOUS * share[0]:
        doubts.append(f"another pose has an overlap of {others:.3f}, against {share[0]:.3f}")
    return tuple(doubts)


class Overlap(NamedTuple):
    """Of B motions: log S (B,), −∞ where no pair is near; its gradient (B, F) over F = D + D(D−1)/2 degrees
    of freedom (v, ω); the mean information of a pair (B, F, F), JᵀWJ and ½ tr(W ∂C W ∂C); and the
    covariance of the pairs' gradients (B, F, F).

    Pairs are weighted by their share of S. Information less covariance approximates −∇² log S, as the
    missing information of EM does (Louis 1982).
    """

    log_score: Tensor
    gradient: Tensor
    information: Tensor
    scatter: Tensor

    def at(self, rows: Tensor) -> Overlap:
        return Overlap(*(value[rows] for value in self))


def overlap(source: Parameters, target: Parameters, motions: Pose, pairs: Tensor) -> Overlap:
    """Log score, gradient, information and scatter of each motion, over the given pairs only.

    pairs: (3, P), rows of the motion, of the source's and of the target's component.
    """
    n, dim = motions.translation.shape
    n_free = dim + dim * (dim - 1) // 2
    lever = torch.einsum("bij,kj->bki", motions.rotation, source.means)
    moved = torch.einsum("bij,kjl,bml->bkim", motions.rotation, source.covariances, motions.rotation)
    # Σ s, Σ s ∂log N, and s times the information and ∂log N ∂log Nᵀ:
    total, first = lever.new_zeros(n), lever.new_zeros(n, n_free)
    second, squares = (lever.new_zeros(n, n_free, n_free) for _ in range(2))
    for b, i, j in pairs.split(_CHUNK, dim=1):
        shift = motions.translation[b] - target.means[j]
        log_density, slope, information = _pair_terms(lever[b, i], shift, moved[b, i], target.covariances[j])
        share = source.weights[i] * target.weights[j] * torch.exp(log_density)
        total.index_add_(0, b, share)
        weighted = share[:, None] * slope
        first.index_add_(0, b, weighted)
        second.index_add_(0, b, share[:, None, None] * information)
        squares.index_add_(0, b, weighted[:, :, None] * slope[:, None])
    scale = total.clamp_min(1e-300)[:, None]
    gradient = first / scale
    scatter = squares / scale[:, None] - gradient[:, :, None] * gradient[:, None]
    return Overlap(total.log(), gradient, second / scale[:, None], scatter)


class Ascent:
    """Climbs log S from B motions in parallel, with one evaluation of the score for each step.

    Steps are Newton's with the absolute values of the curvatures, cut until the score rises. Except for pairs
    near the cutoff the score never falls. Pairs are listed again after components have moved by a fraction of
    their thickness.

    Args:
        source, target: mixtures near the origin.
        radius: metres that the source moves when it turns by a radian.
    """

    def __init__(self, source: Parameters, target: Parameters, radius: float) -> None:
        self.source, self.target = source, target
        self.reach = tuple(_CUTOFF * deviations(mixture)[:, -1] for mixture in (source, target))
        dim = source.means.shape[1]
        self.scale = source.means.new_ones(dim + dim * (dim - 1) // 2)
        self.scale[dim:] = 1 / radius  # a unit of every degree of freedom moves the source by a metre
        self.thickness = float(deviations(source)[:, 0].median() + deviations(target)[:, 0].median())
        self.slack = _SLACK * self.thickness
        self.n_evaluated = 0

    def run(self, motions: Pose, max_iterations: int, tolerance: float) -> tuple[Pose, Overlap, Tensor]:
        """The final motions (B), their overlap, and which of them converged (B,)."""
        listed, pairs = motions, self.pairs(motions)
        state = self.evaluate(motions, pairs)
        share = torch.ones_like(state.log_score)  # of the proposed step that is taken
        active = torch.isfinite(state.log_score)
        for _ in range(max_iterations):
            if not bool(active.any()):
                break
            steps = torch.where(active[:, None], self._steps(state) * share[:, None], 0.0)
            trial = motions.moved(steps)
            if self._strayed(trial, listed):
                rows = active.nonzero().squeeze(1)
                listed, pairs = trial, self.pairs(trial[rows])
                pairs = torch.cat([rows[pairs[:1]], pairs[1:]])
            tried = self.evaluate(trial, pairs[:, active[pairs[0]]])
            better = active & (tried.log_score > state.log_score)
            active &= (steps / self.scale).norm(dim=1) > tolerance
            motions = Pose(*chosen_rows(better, trial.parts, motions.parts))
            state = Overlap(*chosen_rows(better, tried, state))
            share = torch.where(better, (2 * share).clamp_max(1), share / 4)
        return motions, state, ~active & torch.isfinite(state.log_score)

    def evaluate(self, motions: Pose, pairs: Tensor) -> Overlap:
        self.n_evaluated += 1
        return overlap(self.source, self.target, motions, pairs)

    def _steps(self, state: Overlap) -> Tensor:
        """Ascent steps (B, F).

        In coordinates in which the information is the identity, lengths are the Mahalanobis distances that
        pairs move by, so their limit lets a wall slide far along itself. There each axis of the Hessian takes
        Newton's step with the curvature's absolute value, which climbs where the score is convex, too.
        """
        outer = self.scale[:, None] * self.scale
        fisher = state.information * outer
        ridge = 1e-9 * fisher.diagonal(dim1=1, dim2=2).amax(1).clamp_min(1e-12)
        root = safe_cholesky(fisher + ridge[:, None, None] * torch.eye(len(outer)).to(fisher))
        scatter = torch.linalg.solve_triangular(root, state.scatter * outer, upper=False)
        scatter = torch.linalg.solve_triangular(root, scatter.mT, upper=False)
        missing, axes = torch.linalg.eigh((scatter + scatter.mT) / 2)
        slope = torch.linalg.solve_triangular(root, (state.gradient * self.scale)[:, :, None], upper=False)
        parts = (axes.mT @ slope)[:, :, 0] / (1 - missing).abs().clamp_min(_LEAST_CURVATURE)
        parts = parts * (_LONGEST / parts.norm(dim=1, keepdim=True).clamp_min(_LONGEST))
        steps = torch.linalg.solve_triangular(root.mT, axes @ parts[:, :, None], upper=True)[:, :, 0]
        longest = _THICKNESSES * self.thickness
        length = steps.norm(dim=1, keepdim=True)
        return steps * (longest / length.clamp_min(longest)) * self.scale

    def pairs(self, motions: Pose) -> Tensor:
        """Pairs (3, P) within the cutoff now, or after components have moved by the slack."""
        k, n = len(self.source.weights), len(motions)
        moved = motions.apply(self.source.means)
        shapes = motions.rotation[:, None] @ self.source.covariances @ motions.rotation[:, None].mT
        # This ellipsoid contains the ellipsoid of the cutoff enlarged by the ball of the slack.
        scale, wide = 1.2 * _CUTOFF**2, 6 * self.slack**2
        moved, shapes = moved.flatten(0, 1), shapes.flatten(0, 1)
        reach = (self.reach[0] + self.slack).repeat(n)
        found = [torch.zeros(2, 0, dtype=torch.int64, device=moved.device)]
        for point, center in touching(self.target.means, self.reach[1], moved, reach):
            near = scale * (shapes[point] + self.target.covariances[center])
            near.diagonal(dim1=1, dim2=2).add_(wide)
            offset = (moved[point] - self.target.means[center])[:, :, None]
            inside = (offset.mT @ torch.linalg.solve(near, offset))[:, 0, 0] <= 1
            found.append(torch.stack([point[inside], center[inside]]))
        point, center = torch.cat(found, 1)
        return torch.stack([point // k, point % k, center])

    def _strayed(self, motions: Pose, listed: Pose) -> bool:
        """Whether a component may have moved by more than the slack since pairs were listed."""
        size = float((self.source.means.norm(dim=1) + self.reach[0]).max())
        turn = torch.linalg.matrix_norm(motions.rotation - listed.rotation) / math.sqrt(2)
        shift = (motions.translation - listed.translation).norm(dim=1)
        return bool((shift + turn * size > self.slack).any())


def log_self_overlap(mixture: Parameters) -> float:
    """log ∫ f² dx of a mixture."""
    still = Pose.identity(mixture.means.shape[1], 1, device=mixture.means.device)
    ascent = Ascent(mixture, mixture, 1.0)
    return float(ascent.evaluate(still, ascent.pairs(still)).log_score[0])


def _pair_terms(lever: Tensor, shift: Tensor, moved: Tensor, still: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of P pairs log N (P,), its gradient (P, F) and information (P, F, F).

    Args:
        lever: R μ_i (P, D). shift: t − μ_j (P, D). moved: A (P, D, D). still: Σ_j (P, D, D).
    """
    n, dim = lever.shape
    spins = generators(dim).to(lever)
    root = safe_cholesky(moved + still, "the sums of two covariances")
    precision, half_log_det = torch.cholesky_inverse(root), root.diagonal(dim1=1, dim2=2).log().sum(1)
    offset = lever + shift
    pull = (precision @ offset[:, :, None])[:, :, 0]
    log_density = -0.5 * (offset * pull).sum(1) - half_log_det - 0.5 * dim * math.log(2 * math.pi)

    arm = lever - (moved @ pull[:, :, None])[:, :, 0]
    turn = -torch.einsum("pi,kij,pj->pk", pull, spins, arm)
    turn -= torch.einsum("kij,pji->pk", spins, moved @ precision)

    eye = torch.eye(dim).to(lever).expand(n, dim, dim)
    jacobian = torch.cat([eye, torch.einsum("kij,pj->pik", spins, lever)], 2)
    information = jacobian.mT @ precision @ jacobian
    swept = spins @ moved[:, None]
    change = precision[:, None] @ (swept + swept.mT)
    information[:, dim:, dim:] += 0.5 * torch.einsum("pkij,pmji->pkm", change, change)
    return log_density, torch.cat([-pull, turn], 1), information
