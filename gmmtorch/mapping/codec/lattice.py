"""Rounding of means and covariances to a lattice that follows the shape of each component.

Errors are measured in a component's own deviations: a sheet 1 m wide and 5 mm thick keeps its place to a
millimetre across and to decimetres along, in any orientation. With the axes ordered by
falling deviation (pivoting), Σ = L diag(d²) Lᵀ, L unit lower triangular with |L_ij| ≤ 1, d₁ ≥ d₂ ≥ d₃.
Then, with p = `PRECISION`:

- each d_i is a power of 2^(1/`PER_OCTAVE`), and off by half a step at most;
- each L_ij is a multiple of a power of two in (½, 1] 2⁻ᵖ d_i/d_j. A row is rounded given the rounded rows
  above it, so errors do not accumulate;
- the mean on axis i is a multiple of a power of two in (½, 1] 2⁻ᵖ d_i. An axis is rounded given the
  rounded axes before it: a mean that moves along a sheet stays on the sheet.

So, in the rounded component's deviations, a mean is off by at most 2⁻ᵖ⁻¹ along each of D axes
(`MEAN_ERROR`), and an entry of L below the diagonal by as much (`SHEAR_ERROR`; L₃₁ by up to 2⁻²ᵖ⁻² more).
The deviation in any direction changes by −14 to +16 % in 2D, −19 to +24 % in 3D at most, for any shape of
the component. Restored covariances are positive definite by construction. The lattice is fixed in the world
frame: the result depends on the component only, and rounding again changes nothing.

The *coarse lattice* is a part of this one: means and shears have 2^`COARSER` times the step, deviations and
counts twice. So a mean is off by at most half a deviation along each axis, which is a twelfth of its variance
on average, and each d_i by a factor of 2^(1/4) at most.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import LatticeConstants, is_fused, lattice_restoring, lattice_rounding
from gmmtorch.scan import FARTHEST

PER_OCTAVE = 4
"""Steps of deviations, and of counts, in a factor of two."""
PRECISION = 2
"""Means and shears have at least 2^PRECISION steps in a deviation."""

COARSER = 2
"""Bits of the means and shears of the coarse lattice that are zero."""

MEAN_ERROR = SHEAR_ERROR = 2.0 ** (-PRECISION - 1)
"""Largest error of a mean, and of a shear, in deviations."""
DEVIATION_ERROR = 2.0 ** (0.5 / PER_OCTAVE) - 1
"""Largest relative error of a deviation."""

LARGEST_DEVIATION = 20 * PER_OCTAVE
"""Steps: 2²⁰ m. Larger ones are refused."""
LEAST_DEVIATION = -20 * PER_OCTAVE
"""Steps: 2⁻²⁰ m, a micrometre. Smaller ones become this."""
LARGEST_RATIO = 20 * PER_OCTAVE
"""Steps: deviations below 2⁻²⁰ of the component's largest are raised to it; double precision cannot
represent smaller ones."""
LARGEST_VARIANCE = 4.0 ** (LARGEST_DEVIATION / PER_OCTAVE)
"""m², along each axis of the world."""
STEEPEST = 2
"""Largest |L_ij|; 1 up to rounding if the covariance is definite."""

AXIS_ORDERS = {dim: torch.tensor(list(itertools.permutations(range(dim)))) for dim in (2, 3)}

# Literals and exact powers of two: the same bits on every machine.
_ROOTS = torch.tensor([1.0, 1.189207115002721, 1.4142135623730951, 1.6817928305074292], dtype=torch.float64)
_BOUNDS = torch.tensor([0.5946035575013605, 0.8408964152537145], dtype=torch.float64)  # 2^-3/4, 2^-1/4
_COARSE_BOUNDS = torch.tensor([0.7071067811865476] * 2, dtype=torch.float64)
_EXP2 = torch.tensor([2.0**e for e in range(-256, 256)], dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class Lattice:
    """Points of the lattice, int64: axis_order (K,), an index into `AXIS_ORDERS`; then, by falling deviation,
    deviation (K, D), log2 in steps; shear (K, D(D−1)/2): L₂₁, L₃₁, L₃₂; mean (K, D)."""

    axis_order: Tensor
    deviation: Tensor
    shear: Tensor
    mean: Tensor

    @property
    def dim(self) -> int:
        return self.mean.shape[1]

    def axes(self) -> Tensor:
        """World axis (K, D) of each axis."""
        return AXIS_ORDERS[self.dim][self.axis_order]

    def mean_exponents(self) -> Tensor:
        """log2 (K, D) of a step of the mean, m."""
        return floor_divide(self.deviation, PER_OCTAVE) - PRECISION

    def by_world_axis(self, values: Tensor) -> Tensor:
        """Values (K, D) of the axes, in the order of the world axes."""
        return torch.empty_like(values).scatter_(1, self.axes(), values)

    def taken(self, rows: Tensor) -> Lattice:
        """These rows."""
        return Lattice(self.axis_order[rows], self.deviation[rows], self.shear[rows], self.mean[rows])

    def is_valid(self) -> Tensor:
        """Which rows (K,) are within bounds: deviations that do not rise, shears up to `STEEPEST`, and
        means and variances within the largest ones along the world axes."""
        falling = (self.deviation[:, 1:] <= self.deviation[:, :-1]).all(1)
        ratio = self.deviation[:, 0] - self.deviation[:, -1] <= LARGEST_RATIO
        inside = (self.deviation[:, 0] <= LARGEST_DEVIATION) & (self.deviation[:, -1] >= LEAST_DEVIATION)
        gentle = (scaled(self.shear, shear_exponents(self.deviation)).abs() <= STEEPEST).all(1)
        near = (scaled(self.mean, self.mean_exponents()).abs() <= FARTHEST).all(1)
        small = (self.restored()[1].diagonal(dim1=1, dim2=2) <= LARGEST_VARIANCE).all(1)
        return falling & ratio & inside & gentle & near & small

    def restored(self) -> tuple[Tensor, Tensor]:
        """Means (K, D) and covariances (K, D, D)."""
        places = self.axis_order, self.deviation, self.shear, self.mean
        if is_fused(*places):
            return lattice_restoring(*places, _constants(self.dim))
        variance = power(2 * self.deviation)
        shear = scaled(self.shear, shear_exponents(self.deviation))
        mean = scaled(self.mean, self.mean_exponents())
        # Term by term: a matrix product may sum in another order on another machine.
        lower = variance.new_zeros(len(mean), self.dim, self.dim)
        lower[:, 0, 0] = variance[:, 0]
        lower[:, 1, 0] = shear[:, 0] * variance[:, 0]
        lower[:, 1, 1] = shear[:, 0] * lower[:, 1, 0] + variance[:, 1]
        if self.dim == 3:
            lower[:, 2, 0] = shear[:, 1] * variance[:, 0]
            lower[:, 2, 1] = shear[:, 1] * lower[:, 1, 0] + shear[:, 2] * variance[:, 1]
            across = shear[:, 2] * shear[:, 2] * variance[:, 1]
            lower[:, 2, 2] = shear[:, 1] * lower[:, 2, 0] + across + variance[:, 2]
        axes = self.axes()
        covariances = torch.empty_like(lower)
        covariances[_pairs(axes)] = lower + lower.tril(-1).transpose(1, 2)
        return self.by_world_axis(mean), covariances


def nearest(means: Tensor, covariances: Tensor, coarse: bool = False) -> Lattice:
    """The nearest lattice points of means (K, D) and covariances (K, D, D), float64 on the CPU; those of the
    coarse lattice, if `coarse`.

    Covariances that are not positive definite become so. Raises `InvalidArgumentError`
    for values beyond `FARTHEST` and `LARGEST_DEVIATION`, also if only their rounding is: the result
    `is_valid`.
    """
    if is_fused(means, covariances):
        found = lattice_rounding(means, covariances, _constants(means.shape[1], coarse))
        if found is not None:
            return Lattice(*found[:2], *(steps << COARSER * coarse for steps in found[2:]))
    _check(means, covariances)
    exact, rows = _exact(means, covariances, coarse)
    if len(rows) == len(means):
        return exact
    order = _pivots(covariances)
    rounded = _rounded(means, covariances, order, coarse)
    # If several axis orders restore the same component, the first is used, so that rounding a rounded
    # component gives the same bytes.
    earlier = _exact(*rounded.restored(), coarse, before=order)
    return _within_bounds(_replaced(_replaced(rounded, *earlier), exact, rows), means, covariances)


def shear_exponents(deviation: Tensor) -> Tensor:
    """log2 (K, D(D−1)/2) of a step of the shears of components with these deviations (K, D)."""
    rows, cols = torch.tril_indices(deviation.shape[1], deviation.shape[1], -1)
    return floor_divide(deviation[:, rows] - deviation[:, cols], PER_OCTAVE) - PRECISION


def power(steps: Tensor) -> Tensor:
    """2^(steps / PER_OCTAVE)."""
    whole = floor_divide(steps, PER_OCTAVE)
    return _ROOTS[steps - whole * PER_OCTAVE] * _EXP2[whole + 256]


def scaled(values: Tensor, exponents: Tensor) -> Tensor:
    """Whole numbers times powers of two, exactly, float64."""
    return values.double() * _EXP2[exponents + 256]


def floor_divide(values: Tensor, divisor: int) -> Tensor:
    return torch.div(values, divisor, rounding_mode="floor")


def _constants(dim: int, coarse: bool = False) -> LatticeConstants:
    return LatticeConstants(
        orders=AXIS_ORDERS[dim],
        roots=_ROOTS,
        bounds=_COARSE_BOUNDS if coarse else _BOUNDS,
        per_octave=PER_OCTAVE,
        precision=PRECISION - COARSER * coarse,
        least_deviation=LEAST_DEVIATION,
        largest_deviation=LARGEST_DEVIATION,
        largest_ratio=LARGEST_RATIO,
        steepest=STEEPEST,
        farthest=FARTHEST,
        largest_variance=LARGEST_VARIANCE,
    )


def _check(means: Tensor, covariances: Tensor) -> None:
    for name, value, limit in (("means", means, FARTHEST), ("covariances", covariances, LARGEST_VARIANCE)):
        bad = ~(value.abs() <= limit).flatten(1).all(1)  # NaN is bad, too
        if bool(bad.any()):
            first = int(bad.nonzero()[0])
            raise InvalidArgumentError(
                f"{name}[{first}] is {value[first].tolist()}; entries up to {limit:g} can be stored. "
                "Is it in metres?"
            )


def _within_bounds(places: Lattice, means: Tensor, covariances: Tensor) -> Lattice:
    """The lattice points, if they are within bounds; rounding may exceed a bound."""
    bad = ~places.is_valid()
    if bool(bad.any()):
        first = int(bad.nonzero()[0])
        raise InvalidArgumentError(
            f"means[{first}]={means[first].tolist()} with covariances[{first}]="
            f"{covariances[first].tolist()} rounds to a place beyond {FARTHEST:g} m, or a variance beyond "
            f"{LARGEST_VARIANCE:g} m². Is it in metres?"
        )
    return places


def _exact(
    means: Tensor, covariances: Tensor, coarse: bool, before: Tensor | None = None
) -> tuple[Lattice, Tensor]:
    """The components that are exactly on the lattice, in their first possible axis order, and their rows
    (J,) in rising order. `before` (K,): try only axis orders before these."""
    k, dim = means.shape
    # The variance of the first axis must be a lattice value: this excludes most orders.
    variances = covariances.diagonal(dim1=1, dim2=2)
    least, largest = LEAST_DEVIATION, LARGEST_DEVIATION
    steps = _deviation_steps(variances.clamp_min(1e-300), coarse).clamp(least, largest)
    fits = (power(2 * steps) == variances)[:, AXIS_ORDERS[dim][:, 0]]  # (K, orders)
    if before is not None:
        fits &= torch.arange(fits.shape[1]) < before[:, None]
    row, order = fits.nonzero(as_tuple=True)
    if not len(row):
        none = order.new_zeros(0, dim)
        return Lattice(order, none, order.new_zeros(0, dim * (dim - 1) // 2), none), order
    tried = _rounded(means[row], covariances[row], order, coarse)
    mean, covariance = tried.restored()
    same = (mean == means[row]).all(1) & (covariance == covariances[row]).flatten(1).all(1)
    same = (same & tried.is_valid()).nonzero().squeeze(1)
    first = torch.full((k,), len(row)).scatter_reduce_(0, row[same], same, "amin")
    rows = (first < len(row)).nonzero().squeeze(1)
    return tried.taken(first[rows]), rows


def _rounded(means: Tensor, covariances: Tensor, axis_order: Tensor, coarse: bool) -> Lattice:
    """The nearest place with these axis orders (K,)."""
    dim = means.shape[1]
    axes = AXIS_ORDERS[dim][axis_order]
    mean = means.gather(1, axes)
    variances, shears = _factors(covariances[_pairs(axes)])
    steps = _deviation_steps(variances, coarse)
    steps = torch.maximum(steps, steps[:, :1] - LARGEST_RATIO).clamp_min(LEAST_DEVIATION)
    steps = steps.cummin(1).values  # equal deviations may differ by a rounding error
    blank = Lattice(axis_order, steps, steps.new_zeros(len(mean), shears.shape[1]), torch.zeros_like(steps))

    e = shear_exponents(steps)
    shear = _to_shears(shears[:, :1], e[:, :1], coarse)
    if dim == 3:
        # x₃ = L₃₁x₁ + L₃₂(x₂ − L₂₁x₁) + …, written with the rounded L₂₁.
        off = scaled(shear[:, 0], e[:, 0]) - shears[:, 0]
        given = torch.stack([shears[:, 1] + shears[:, 2] * off, shears[:, 2]], 1)
        shear = torch.cat([shear, _to_shears(given, e[:, 1:], coarse)], 1)

    slope = scaled(shear, e)
    step = blank.mean_exponents()
    place = [_to_steps(mean[:, 0], step[:, 0], coarse)]
    error = mean[:, 0] - scaled(place[0], step[:, 0])
    wanted = mean[:, 1] - slope[:, 0] * error
    place.append(_to_steps(wanted, step[:, 1], coarse))
    if dim == 3:
        rest = wanted - scaled(place[1], step[:, 1])
        rest = mean[:, 2] - slope[:, 1] * error - slope[:, 2] * rest
        place.append(_to_steps(rest, step[:, 2], coarse))
    return Lattice(axis_order, steps, shear, torch.stack(place, 1).long())


def _factors(ordered: Tensor) -> tuple[Tensor, Tensor]:
    """d² (K, D) and L₂₁, L₃₁, L₃₂ (K, D(D−1)/2) of covariances; d² is at least the smallest of the
    lattice."""
    least = 4.0 ** (LEAST_DEVIATION / PER_OCTAVE)
    v1 = ordered[:, 0, 0].clamp_min(least)
    floor = (v1 * 4.0 ** (-LARGEST_RATIO / PER_OCTAVE)).clamp_min(least)
    l21 = ordered[:, 1, 0] / v1
    v2 = torch.maximum(ordered[:, 1, 1] - l21 * l21 * v1, floor)
    if ordered.shape[1] == 2:
        return torch.stack([v1, v2], 1), l21[:, None]
    l31 = ordered[:, 2, 0] / v1
    l32 = (ordered[:, 2, 1] - l31 * ordered[:, 1, 0]) / v2
    v3 = torch.maximum(ordered[:, 2, 2] - l31 * l31 * v1 - l32 * l32 * v2, floor)
    return torch.stack([v1, v2, v3], 1), torch.stack([l21, l31, l32], 1)


def _replaced(places: Lattice, others: Lattice, rows: Tensor) -> Lattice:
    """The lattice points with rows (J,) replaced by others."""
    return Lattice(
        *(getattr(places, f.name).index_copy(0, rows, getattr(others, f.name)) for f in fields(Lattice))
    )


def _pivots(covariances: Tensor) -> Tensor:
    """The axis order (K,) of complete pivoting: next is the axis with the largest remaining variance."""
    k, dim = covariances.shape[:2]
    rows = torch.arange(k)
    variances = covariances.diagonal(dim1=1, dim2=2)
    first = variances.argmax(1)
    column = covariances[rows, :, first]
    rest = variances - column * column / column[rows, first][:, None].clamp_min(1e-300)
    rest[rows, first] = -torch.inf
    orders = AXIS_ORDERS[dim]
    chosen = (orders[None, :, 0] == first[:, None]) & (orders[None, :, 1] == rest.argmax(1)[:, None])
    return chosen.long().argmax(1)


def _deviation_steps(variances: Tensor, coarse: bool) -> Tensor:
    """The nearest log2 of deviations in steps; without a logarithm, whose last bit depends on the machine."""
    mantissa, exponent = torch.frexp(variances)
    return (exponent.long() - 1) * (PER_OCTAVE // 2) + torch.bucketize(
        mantissa, _COARSE_BOUNDS if coarse else _BOUNDS, right=True
    )


def _to_steps(values: Tensor, exponents: Tensor, coarse: bool) -> Tensor:
    """Values in whole steps of 2^exponent, still float64; whole steps of the coarse lattice, if `coarse`."""
    return (values * _EXP2[256 - exponents - COARSER * coarse]).round() * 2.0 ** (COARSER * coarse)


def _to_shears(values: Tensor, exponents: Tensor, coarse: bool) -> Tensor:
    """Shears in whole steps, limited to `STEEPEST`; only indefinite covariances exceed it."""
    return _to_steps(values.clamp(-STEEPEST, STEEPEST), exponents, coarse).long()


def _pairs(axes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Index that reorders rows and columns of (K, D, D) by axes (K, D)."""
    return torch.arange(len(axes))[:, None, None], axes[:, :, None], axes[:, None, :]
