"""Types and checks of estimator arguments."""

from __future__ import annotations

import math
import warnings

import numpy as np
import torch
from torch import Tensor

from gmmtorch.arrays import as_tensor
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.linalg import inverse_factor
from gmmtorch.mixture.em.exact import type_shape

_LEAST_MEAN_WEIGHT, _LARGEST_MEAN_WEIGHT = 1e-6, 1e12

Array = Tensor | np.ndarray
RandomState = int | np.integer | np.random.RandomState | torch.Generator | None


def as_generator(random_state: RandomState) -> torch.Generator:
    """A CPU generator from a seed, a NumPy RandomState, or None (random seed).

    A generator is returned as it is.
    """
    if isinstance(random_state, torch.Generator):
        return random_state
    generator = torch.Generator()
    if random_state is None:
        generator.seed()
    elif isinstance(random_state, np.random.RandomState):
        generator.manual_seed(int(random_state.randint(2**31 - 1)))
    elif isinstance(random_state, int | np.integer) and 0 <= int(random_state) < 2**63:
        generator.manual_seed(int(random_state))
    else:
        raise InvalidArgumentError(
            f"random_state={random_state!r} must be None, a whole number of at least 0, "
            "a numpy RandomState or a torch Generator."
        )
    return generator


def warn_if_coarse(X: Array, points: Tensor) -> None:
    """Warn if X is float32 and so far from the origin that rounding exceeds 1 % of its spread."""
    if getattr(X, "dtype", None) not in (torch.float32, np.float32):
        return
    largest = torch.maximum(points.amax(0), -points.amin(0))
    rounding = torch.finfo(torch.float32).eps * largest
    spread = points.std(0, correction=0)
    if bool(((rounding > 0.01 * spread) & (spread > 0)).any()):
        warnings.warn(
            f"X is float32 and up to {float(largest.max()):.3g} from the origin, where it is rounded to "
            f"{float(rounding.max()):.1g}; use float64, or subtract an offset before the cast to float32.",
            UserWarning,
            stacklevel=3,
        )


def checked_tensor(X: Tensor) -> Tensor:
    """Returns points X (N, D).

    Raises `InvalidArgumentError` unless N, D ≥ 1 and all values are real and finite.
    """
    if X.is_complex():
        raise InvalidArgumentError("X is complex; Complex data not supported.")
    X = as_tensor(X, "X")
    if X.ndim != 2 or X.shape[0] == 0 or X.shape[1] == 0:
        raise InvalidArgumentError(f"X has shape {tuple(X.shape)}; expected (N, D) with at least one point.")
    if math.isfinite(X.detach().sum(dtype=torch.float64)):
        return X
    finite = torch.isfinite(X).all(1)
    if not bool(finite.all()):
        row = int((~finite).nonzero()[0])
        raise InvalidArgumentError(
            f"X[{row}] = {X[row].tolist()} is not finite; remove such rows: X = X[torch.isfinite(X).all(1)]."
        )
    return X


def checked_parameter(value: Array, shape: tuple[int, ...], name: str, device: torch.device) -> Tensor:
    """`value` as a float64 tensor. Raises `InvalidArgumentError` unless it is finite and has this shape."""
    tensor = as_tensor(value, name, torch.float64, device)
    if tuple(tensor.shape) != shape:
        raise InvalidArgumentError(
            f"The parameter '{name.removesuffix('_init')}' should have the shape of {shape}, but got "
            f"{tuple(tensor.shape)}; change {name}."
        )
    if not bool(torch.isfinite(tensor).all()):
        raise InvalidArgumentError(
            f"{name} has NaN or infinite entries; expected finite numbers of shape {shape}."
        )
    return tensor


def checked_mixing_weights(value: Array, n_components: int, device: torch.device) -> Tensor:
    """`weights_init` (K,) as a float64 tensor.

    Raises `InvalidArgumentError` unless the weights are from 0 to 1 and add up to 1.
    """
    weights = checked_parameter(value, (n_components,), "weights_init", device)
    low, high, total = float(weights.min()), float(weights.max()), float(weights.sum())
    if low < 0 or high > 1:
        raise InvalidArgumentError(
            "The parameter 'weights' should be in the range [0, 1], but got max value "
            f"{high:.5f}, min value {low:.5f} (weights_init)."
        )
    if abs(total - 1) > 1e-6:
        raise InvalidArgumentError(
            "The parameter 'weights' should be normalized, but got sum(weights) = "
            f"{total:.5f} (weights_init)."
        )
    return weights / total


def checked_precisions(value: Array, covariance_type: str, k: int, dim: int, device: torch.device) -> Tensor:
    """The covariances of `precisions_init`, both in the shape of the covariance type.

    Raises `InvalidArgumentError` unless the precisions are symmetric and positive definite.
    """
    name = f"{covariance_type} precision"
    try:
        precisions = checked_parameter(value, type_shape(covariance_type, k, dim), name, device)
    except InvalidArgumentError as error:
        raise InvalidArgumentError(f"precisions_init: {error}") from None
    if covariance_type in ("full", "tied"):
        factors, info = torch.linalg.cholesky_ex(precisions)
        scale = precisions.abs().amax((-2, -1))
        bad = (info != 0) | ((precisions - precisions.mT).abs().amax((-2, -1)) > 1e-6 * scale)
    else:
        bad = (precisions <= 0).view(precisions.shape[0], -1).any(1)
    if bool(bad.any()):
        what = "symmetric, positive-definite" if covariance_type in ("full", "tied") else "positive"
        which = "" if covariance_type == "tied" else f"[{int(bad.nonzero()[0])}]"
        raise InvalidArgumentError(f"'{name}' should be {what}; precisions_init{which} is not.")
    if covariance_type not in ("full", "tied"):
        return 1 / precisions
    whiten = inverse_factor(factors)
    return whiten @ whiten.mT


def checked_weight(sample_weight: Array | None, points: Tensor) -> Tensor:
    """Weights (N,) of the points, float64; ones if not given.

    Raises `InvalidArgumentError` for invalid weights.
    """
    n = points.shape[0]
    if sample_weight is None:
        return points.new_ones(n)
    weight = as_tensor(sample_weight, "sample_weight", torch.float64, points.device).detach()
    if weight.shape != (n,):
        raise InvalidArgumentError(
            f"sample_weight has shape {tuple(weight.shape)}; expected ({n},), one weight for each point."
        )
    if not bool(torch.isfinite(weight).all()) or bool((weight < 0).any()):
        raise InvalidArgumentError("sample_weight has NaN, infinite or negative weights; all must be ≥ 0.")
    if float(weight.max()) == 0:
        raise InvalidArgumentError("sample_weight is all zero; at least one weight must be above zero.")
    return weight


def check_weight_scale(weight: Tensor) -> None:
    """Raise `InvalidArgumentError` for weights (N,) so large or small that their sums lose digits."""
    mean = float((weight / weight.shape[0]).sum())
    if not _LEAST_MEAN_WEIGHT <= mean <= _LARGEST_MEAN_WEIGHT:
        raise InvalidArgumentError(
            f"sample_weight has a mean of {mean:.3g}, at which sums lose digits; scale it to about 1 "
            "(a weight is the number of points that a row stands for)."
        )
