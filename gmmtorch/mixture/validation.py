"""Types and checks of estimator arguments."""

from __future__ import annotations

import warnings

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError

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


def check_component_count(n_components: int, n_points: int | None) -> None:
    """Raise `InvalidArgumentError` if there are more components than points, if that number is known."""
    if n_points is not None and n_points < n_components:
        raise InvalidArgumentError(
            f"n_components={n_components} is more than the n_samples={n_points} points of "
            "non-zero weight; use fewer components or more points."
        )


def warn_if_coarse(X: Array, points: Tensor) -> None:
    """Warn if X is float32 and so far from the origin that rounding exceeds 1 % of its spread."""
    if getattr(X, "dtype", None) not in (torch.float32, np.float32):
        return
    rounding = torch.finfo(torch.float32).eps * points.abs().amax(0)
    spread = points.std(0, correction=0)
    if bool(((rounding > 0.01 * spread) & (spread > 0)).any()):
        warnings.warn(
            f"X is float32 and up to {float(points.abs().max()):.3g} from the origin, where it is rounded to "
            f"{float(rounding.max()):.1g}; use float64, or subtract an offset before the cast to float32.",
            UserWarning,
            stacklevel=3,
        )


def checked_tensor(X: Tensor) -> Tensor:
    """Returns points X (N, D).

    Raises `InvalidArgumentError` unless N, D ≥ 1 and all values are real and finite.
    """
    if X.ndim != 2 or X.shape[0] == 0 or X.shape[1] == 0:
        raise InvalidArgumentError(f"X has shape {tuple(X.shape)}; expected (N, D) with at least one point.")
    if X.is_complex():
        raise InvalidArgumentError("X is complex; Complex data not supported.")
    finite = torch.isfinite(X).all(1)
    if not bool(finite.all()):
        row = int((~finite).nonzero()[0])
        raise InvalidArgumentError(
            f"X[{row}] = {X[row].tolist()} is not finite; remove such rows: X = X[torch.isfinite(X).all(1)]."
        )
    return X


def checked_parameter(value: Array, shape: tuple[int, ...], name: str, device: torch.device) -> Tensor:
    """`value` as a float64 tensor. Raises `InvalidArgumentError` unless it is finite and has this shape."""
    tensor = torch.as_tensor(value, dtype=torch.float64, device=device)
    if tuple(tensor.shape) != shape or not bool(torch.isfinite(tensor).all()):
        raise InvalidArgumentError(
            f"{name} has shape {tuple(tensor.shape)}; expected finite numbers of shape {shape}."
        )
    if name == "weights_init" and (bool((tensor < 0).any()) or float(tensor.sum()) <= 0):
        raise InvalidArgumentError(f"weights_init={tensor.tolist()} must be at least zero, and not all zero.")
    return tensor


def checked_weight(sample_weight: Array | None, points: Tensor) -> Tensor:
    """Weights (N,) of the points, float64; ones if not given.

    Raises `InvalidArgumentError` for invalid weights.
    """
    n = points.shape[0]
    if sample_weight is None:
        return points.new_ones(n)
    if not isinstance(sample_weight, Tensor):
        sample_weight = torch.from_numpy(np.array(sample_weight, dtype=np.float64))
    weight = sample_weight.detach().to(points.device, torch.float64)
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
