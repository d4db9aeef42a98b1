"""Batches of small symmetric matrices, packed and factorised, copies between devices, and fast sorting."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, NumericalError
from gmmtorch.kernels import curve_keys, distinct_keys, is_fused

_MANY_KEYS = 1 << 12  # from here on a hash table is faster than sorting
_JITTERS = (1e-12, 1e-10, 1e-8, 1e-6)  # relative to the mean of the diagonal


def triangle_indices(dim: int, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """Row and column indices (i ≤ j) of the D(D+1)/2 distinct entries of a symmetric D×D matrix."""
    rows, cols = torch.triu_indices(dim, dim, device=device)
    return rows, cols


def pack_symmetric(matrices: Tensor) -> Tensor:
    """Distinct entries (…, D(D+1)/2) of symmetric matrices (…, D, D): the upper triangle, row by row."""
    rows, cols = triangle_indices(matrices.shape[-1], matrices.device)
    return matrices[..., rows, cols]


def unpack_symmetric(packed: Tensor, dim: int) -> Tensor:
    """Symmetric matrices (…, D, D) from their packed entries; the inverse of `pack_symmetric`."""
    rows, cols = triangle_indices(dim, packed.device)
    matrices = packed.new_empty((*packed.shape[:-1], dim, dim))
    matrices[..., rows, cols] = packed
    matrices[..., cols, rows] = packed
    return matrices


def safe_cholesky(matrices: Tensor, name: str = "covariances") -> Tensor:
    """Lower Cholesky factors (K, D, D) of symmetric matrices (K, D, D).

    Matrices whose factorisation fails get jitter, which grows from 1e-12 to 1e-6 of the mean of the
    diagonal. All other matrices stay unchanged. Raises `NumericalError`, which names the first bad
    matrix, if jitter does not help or if a matrix has NaN or infinite entries.
    """
    factors, info = torch.linalg.cholesky_ex(matrices)
    if math.isfinite(float(factors.detach().sum().masked_fill_(info.any(), math.nan))):
        return factors
    bad = (info != 0) | ~torch.isfinite(factors).flatten(1).all(1)
    if not bool(bad.any()):  # only their sum overflows
        return factors
    if not bool(torch.isfinite(matrices).all()):
        first = int((~torch.isfinite(matrices).flatten(1).all(1)).nonzero()[0])
        raise NumericalError(f"{name}[{first}] has NaN or infinite entries; check the input points.")
    factors = factors.clone()
    eye = torch.eye(matrices.shape[-1], dtype=matrices.dtype, device=matrices.device)
    for jitter in _JITTERS:
        index = bad.nonzero().squeeze(1)
        scale = matrices[index].diagonal(dim1=-2, dim2=-1).mean(-1).abs()
        repaired, info = torch.linalg.cholesky_ex(matrices[index] + (jitter * scale)[:, None, None] * eye)
        good = info == 0
        factors[index[good]] = repaired[good]
        bad[index[good]] = False
        if not bool(bad.any()):
            return factors
    first = int(bad.nonzero()[0])
    few = matrices.shape[-1] <= 8
    shown = matrices[first].tolist() if few else f"diagonal {matrices[first].diagonal().tolist()[:8]} …"
    raise NumericalError(
        f"{name}[{first}] is not positive definite: {shown}; "
        "raise reg_covar (1e-6 m² is usual), or check that the covariances are symmetric."
    )


def eigen(matrices: Tensor, name: str = "covariances") -> tuple[Tensor, Tensor]:
    """Eigenvalues (…, D), ascending, and eigenvectors (…, D, D), of symmetric matrices (…, D, D).

    Raises `NumericalError` if entries are NaN or infinite.
    """
    try:
        values, vectors = torch.linalg.eigh(matrices)
    except torch.linalg.LinAlgError as error:
        raise NumericalError(
            f"{name} has NaN or infinite entries; check the input points, and scale them if they are large."
        ) from error
    return values, vectors


def inverse_factor(factors: Tensor) -> Tensor:
    """L⁻ᵀ (K, D, D) of lower Cholesky factors L; ‖(x−μ)ᵀ L⁻ᵀ‖² is the squared Mahalanobis distance."""
    eye = torch.eye(factors.shape[-1], dtype=factors.dtype, device=factors.device)
    inverse = torch.linalg.solve_triangular(factors, eye.expand_as(factors), upper=False)
    return inverse.transpose(-2, -1)


def check_symmetric(matrices: Tensor, name: str) -> Tensor:
    """Returns the matrices (K, D, D). Raises `InvalidArgumentError` unless they are symmetric to rounding."""
    difference = (matrices - matrices.transpose(-2, -1)).abs()
    scale = matrices.diagonal(dim1=-2, dim2=-1).abs().amax(-1)[..., None, None] if matrices.numel() else 1.0
    if bool((difference > 1e-6 * scale).any()):
        raise InvalidArgumentError(
            f"{name} are not symmetric; to symmetrise them, use (C + C.transpose(-2, -1)) / 2."
        )
    return matrices


def on_cpu(*tensors: Tensor) -> tuple[Tensor, ...]:
    """The tensors on the CPU, without gradients. Python waits once for their device, not for each tensor."""
    tensors = tuple(tensor.detach() for tensor in tensors)
    if all(tensor.device.type == "cpu" for tensor in tensors):
        return tensors
    sizes = [tensor.numel() * tensor.element_size() for tensor in tensors]
    # Wide types come first: a tensor must begin at a multiple of the size of its entries.
    order = sorted(range(len(tensors)), key=lambda i: -tensors[i].element_size())
    data = torch.cat([tensors[i].contiguous().view(-1).view(torch.uint8) for i in order]).cpu()
    parts = dict(zip(order, data.split([sizes[i] for i in order]), strict=True))
    return tuple(parts[i].view(tensor.dtype).view(tensor.shape) for i, tensor in enumerate(tensors))


def as_tensors(*arrays: NDArray[Any]) -> list[Tensor]:
    """Arrays of one type as tensors, which share one memory."""
    whole = torch.from_numpy(np.concatenate([array.reshape(-1) for array in arrays]))
    parts = whole.split([array.size for array in arrays])
    return [part.view(array.shape) for part, array in zip(parts, arrays, strict=True)]


def all_equal(pairs: Iterable[tuple[Tensor, Tensor]]) -> bool:
    """Whether the tensors of every pair are equal; waits once for another device."""
    pairs = list(pairs)
    if any(one.shape != other.shape for one, other in pairs):
        return False
    return bool(torch.stack([(one == other).all() for one, other in pairs]).all())


def order_along_curve(places: Tensor, levels: int = 1) -> Tensor:
    """An order (N,) of finite points (N, D), D ≤ 3, at least one, in which neighbours follow each other.

    It is that of a Morton curve through 32^levels cells along each axis of their box; levels: 4 at most.
    """
    low, high = places.aminmax(dim=0)
    if levels == 1 and places.dtype == torch.float64 and is_fused(places):
        return curve_keys(places, low, high).argsort(stable=True)
    dim, side = places.shape[1], 1 << 5 * levels
    cell = (places - low) * ((side - 0.01) / (high - low).max().clamp_min(1e-300))
    cell = cell.long().clamp_(0, side - 1)
    spread = [[sum((n >> b & 1) << (b * dim + a) for b in range(5)) for a in range(dim)] for n in range(32)]
    bits, keys = torch.tensor(spread, device=places.device), torch.zeros_like(cell[:, 0])
    for level in reversed(range(levels)):
        keys = keys << 5 * dim | torch.gather(bits, 0, cell >> 5 * level & 31).sum(1)
    return (keys.short() if levels == 1 else keys).argsort(stable=True)


def argsort(keys: Tensor) -> Tensor:
    """Indices (N,) that sort keys (N,). The sort is stable."""
    if keys.device.type != "cpu":
        return keys.argsort(stable=True)
    array = keys.numpy()
    if array.dtype == np.int64 and array.size and array.min() >= 0:
        if array.max() < 1 << 16:
            array = array.astype(np.uint16)  # radix sort
        elif array.max() < 1 << 32 and (array[1:] < array[:-1]).any():  # two of them
            order = np.argsort(array.astype(np.uint16), kind="stable")
            high = (array >> 16).astype(np.uint16)
            return torch.from_numpy(order[np.argsort(high[order], kind="stable")])
    return torch.from_numpy(np.argsort(array, kind="stable"))


def largest_indices(scores: Tensor, k: int) -> Tensor:
    """Rising column indices (N, k) of the k largest values in each row of scores (N, M), without NaN.

    Of equal values the first are taken, on any device.
    """
    least = scores.topk(k, 1, sorted=False).values.amin(1, keepdim=True)
    above, equal = scores > least, scores == least
    taken = above | (equal & (equal.cumsum(1) <= k - above.sum(1, keepdim=True)))
    return taken.nonzero()[:, 1].view(-1, k)


def dense_ranks(keys: Tensor) -> tuple[Tensor, int]:
    """Rank of each key (N,) among the distinct keys, from 0, and the number of distinct keys."""
    if keys.device.type != "cpu":
        unique, number = torch.unique(keys, return_inverse=True)
        return number, unique.numel()
    if keys.dtype == torch.int64 and len(keys) >= _MANY_KEYS and is_fused(keys):
        distinct, place = distinct_keys(keys)
        rank = torch.empty_like(distinct)
        rank[argsort(distinct)] = torch.arange(len(distinct))
        return rank[place], len(distinct)
    unique, number = np.unique(keys.numpy(), return_inverse=True)
    return torch.from_numpy(number.reshape(-1)), len(unique)


def ragged_index(lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Row (P,) of each entry of a ragged list whose rows have these lengths (R,), and its place in its row.

    Both int64: rows 0, 0, …, 1, 1, …, and places 0, 1, …, 0, 1, … .
    """
    row = torch.repeat_interleave(lengths)
    return row, torch.arange(len(row), device=row.device) - (lengths.cumsum(0) - lengths)[row]
