"""The covariance types of scikit-learn: which covariances a mixture may have.

All computation uses covariances (K, D, D). `constrain` projects them onto a type: the M-step of a type is
the projection of the full M-step, because the likelihood depends on the scatter only through its product
with precisions of the type. `compact` and `expand` convert from and to the shape of scikit-learn's
attributes: full (K, D, D), tied (D, D), diag (K, D), spherical (K,).
"""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError

COVARIANCE_TYPES = ("full", "tied", "diag", "spherical")


def constrain(matrices: Tensor, covariance_type: str, weights: Tensor | None = None) -> Tensor:
    """The nearest matrices (K, D, D) of the type; tied: their mean, weighted by `weights` (K,)."""
    if covariance_type == "full":
        return matrices
    if covariance_type == "tied":
        share = torch.ones_like(matrices[:, 0, 0]) if weights is None else weights
        mean = (matrices * (share / share.sum())[:, None, None]).sum(0)
        return mean.expand_as(matrices).clone()
    diagonal = matrices.diagonal(dim1=-2, dim2=-1)
    if covariance_type == "spherical":
        diagonal = diagonal.mean(-1, keepdim=True).expand_as(diagonal)
    return torch.diag_embed(diagonal)


def compact(matrices: Tensor, covariance_type: str) -> Tensor:
    """The distinct entries of matrices (K, D, D) of the type, in the shape of `type_shape`."""
    if covariance_type == "full":
        return matrices
    if covariance_type == "tied":
        return matrices[0]
    diagonal = matrices.diagonal(dim1=-2, dim2=-1)
    return (diagonal if covariance_type == "diag" else diagonal[:, 0]).clone()


def expand(values: Tensor, covariance_type: str, n_components: int, dim: int) -> Tensor:
    """Matrices (K, D, D) from their distinct entries: the inverse of `compact`."""
    if covariance_type == "full":
        return values
    if covariance_type == "tied":
        return values.expand(n_components, dim, dim).clone()
    columns = values if covariance_type == "diag" else values[:, None]
    return torch.diag_embed(columns.expand(n_components, dim))


def type_shape(covariance_type: str, n_components: int, dim: int) -> tuple[int, ...]:
    """The shape of `compact`."""
    return {
        "full": (n_components, dim, dim),
        "tied": (dim, dim),
        "diag": (n_components, dim),
        "spherical": (n_components,),
    }[covariance_type]


def count_free_entries(covariance_type: str, n_components: int, dim: int) -> int:
    """Number of free parameters of the covariances."""
    symmetric = dim * (dim + 1) // 2
    return {
        "full": n_components * symmetric,
        "tied": symmetric,
        "diag": n_components * dim,
        "spherical": n_components,
    }[covariance_type]


def check_type(covariances: Tensor, covariance_type: str) -> Tensor:
    """Returns covariances (K, D, D). Raises `InvalidArgumentError` unless they are of the type."""
    difference = (constrain(covariances, covariance_type) - covariances).abs()
    if bool((difference > 1e-9 * covariances.abs().amax()).any()):
        raise InvalidArgumentError(
            f"covariance_type={covariance_type!r}, but the covariances are not {covariance_type}; "
            "set covariance_type='full'."
        )
    return covariances
