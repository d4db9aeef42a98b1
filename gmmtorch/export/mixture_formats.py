"""Gaussian mixtures as GIRA's CSV files and as NPZ archives of plain arrays."""

from __future__ import annotations

import io
import math
import warnings
import zipfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, MissingDataError
from gmmtorch.files import write_bytes
from gmmtorch.linalg import check_symmetric, safe_cholesky

MAX_BYTES = 1 << 30
"""Largest size of a file to read, compressed and decompressed."""


class PlainMixture(NamedTuple):
    """A mixture of K Gaussians in D dimensions as float64 tensors, metres.

    weights: (K,), sum 1. means: (K, D). covariances: (K, D, D).
    support: (K,) number of points that each component represents; None if unknown.
    """

    weights: Tensor
    means: Tensor
    covariances: Tensor
    support: Tensor | None = None

    @classmethod
    def of_support(cls, means: Tensor, covariances: Tensor, support: Tensor) -> PlainMixture:
        """The mixture of components with these supports, at least one of them above zero."""
        total = float(support.sum())
        if not total > 0:
            raise InvalidArgumentError("support adds up to zero; there is no mixture to write.")
        return cls(support / total, means, covariances, support)


def checked(mixture: PlainMixture) -> PlainMixture:
    """The mixture in float64 on the CPU, with normalized weights and exactly symmetric covariances.

    Raises `InvalidArgumentError` or `NumericalError` if it is not a valid mixture.
    """
    weights, means, covariances = (t.detach().cpu().double() for t in mixture[:3])
    support = None if mixture.support is None else mixture.support.detach().cpu().double()
    if means.ndim != 2 or 0 in means.shape:
        raise InvalidArgumentError(f"means has shape {tuple(means.shape)}; expected (K, D).")
    k, dim = means.shape
    for name, value, shape in (
        ("weights", weights, (k,)),
        ("covariances", covariances, (k, dim, dim)),
        ("support", support, (k,)),
    ):
        if value is not None and tuple(value.shape) != shape:
            raise InvalidArgumentError(f"{name} has shape {tuple(value.shape)}; expected {shape}.")
    for name, value in (("means", means), ("weights", weights), ("support", support)):
        if value is not None and not bool(torch.isfinite(value).all()):
            raise InvalidArgumentError(f"{name} holds NaN or infinite values.")
    total = float(weights.sum())
    if bool((weights < 0).any()) or not 0 < total < math.inf:
        raise InvalidArgumentError("weights must be finite and at least zero, and one of them above zero.")
    if support is not None and bool((support < 0).any()):
        raise InvalidArgumentError("support must not be negative.")
    covariances = (check_symmetric(covariances, "covariances") + covariances.mT) / 2
    safe_cholesky(covariances)
    return PlainMixture(weights / total, means, covariances, support)


def write_gira_csv(path: str | Path, mixture: PlainMixture) -> Path:
    """Writes the mixture, atomically, in the format of GIRA's `gmm_utils`: one row per component, no header.

    Columns: mean (D), covariance (D²), weight. The file does not contain the number of points. Numbers
        have 17 digits; with GIRA's six digits the covariances of thin components become indefinite.
    """
    sound = checked(mixture)
    rows = torch.cat([sound.means, sound.covariances.flatten(1), sound.weights[:, None]], 1)
    text = io.StringIO()
    np.savetxt(text, rows.numpy(), fmt="%.17g", delimiter=", ")
    return write_bytes(path, text.getvalue().encode("ascii"))


def read_gira_csv(path: str | Path, n_points: float | None = None) -> PlainMixture:
    """Reads a mixture that GIRA or `write_gira_csv` wrote; D follows from the number of columns.

    `n_points` is the number of points the mixture was learned from, which the file does not contain;
    without it `support` is None. Weights are normalized. Raises `MissingDataError` if the file does not
    exist, and `DataError` for another content or a covariance that is not positive definite.
    """
    path = _readable(path, "a GIRA mixture (CSV)")
    if n_points is not None and not 0 < n_points < math.inf:
        raise InvalidArgumentError(f"n_points={n_points} must be a number above zero, or None.")
    try:
        # Opened here because numpy would decompress a .gz file. The check below reports an empty file.
        with path.open(encoding="ascii") as lines, warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            rows = np.loadtxt(lines, delimiter=",", ndmin=2, comments=None, dtype=np.float64)
    except (ValueError, UnicodeDecodeError, MemoryError) as error:
        raise DataError(f"{path} is not a table of comma-separated numbers: {error}") from error
    n_columns = rows.shape[1]
    dim = (math.isqrt(max(0, 4 * n_columns - 3)) - 1) // 2
    if rows.shape[0] == 0 or dim < 1 or 1 + dim + dim * dim != n_columns:
        raise DataError(
            f"{path} has {rows.shape[0]} rows of {n_columns} numbers; a GIRA mixture has 1 + D + D² in a "
            "row: 13 in 3D."
        )
    table = torch.from_numpy(rows)
    weights, covariances = table[:, -1], table[:, dim:-1].reshape(-1, dim, dim)
    found = _sound(path, PlainMixture(weights, table[:, :dim], covariances))
    return found if n_points is None else found._replace(support=found.weights * n_points)


def write_npz(path: str | Path, mixture: PlainMixture) -> Path:
    """Writes the mixture, atomically, as NPZ: weights, means, covariances and, if known, support; float64."""
    sound = checked(mixture)
    buffer = io.BytesIO()
    np.savez(buffer, **{k: v.numpy() for k, v in sound._asdict().items() if v is not None})
    return write_bytes(path, buffer.getvalue())


def read_npz(path: str | Path) -> PlainMixture:
    """Reads a mixture from an NPZ file with the arrays weights, means, covariances and, optionally, support.

    Pickled data are rejected. Raises `MissingDataError` if the file does not exist, and `DataError` for
    another content or a decompressed size above `MAX_BYTES`.
    """
    path = _readable(path, "a mixture (NPZ)")
    names = ("weights", "means", "covariances")
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > MAX_BYTES:
            raise DataError(f"{path} decompresses to {size:,} bytes, above the limit of {MAX_BYTES:,}.")
        with np.load(path, allow_pickle=False) as stored:
            missing = [name for name in names if name not in stored]
            if missing:
                raise DataError(f"{path} lacks {', '.join(missing)}; it is not a mixture.")
            wanted = (*names, "support") if "support" in stored else names
            found = {name: stored[name] for name in wanted}  # bytes if it is not in NumPy's format
        for name, array in found.items():
            if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
                raise DataError(f"{path} is damaged, or not an NPZ file of numbers: {name} has none.")
        arrays = {name: torch.from_numpy(array.astype(np.float64)) for name, array in found.items()}
    except GmmTorchError:
        raise
    except Exception as error:  # also SyntaxError and TokenError of a header, and errors of zlib and zipfile
        raise DataError(f"{path} is damaged, or not an NPZ file of numbers: {error}") from error
    return _sound(path, PlainMixture(**arrays))


def _readable(path: str | Path, what: str) -> Path:
    path = Path(path)
    if not path.is_file():
        raise MissingDataError(f"{path} does not exist; expected {what}.")
    if path.stat().st_size > MAX_BYTES:
        raise DataError(f"{path} has {path.stat().st_size:,} bytes, above the limit of {MAX_BYTES:,}.")
    return path


def _sound(path: Path, mixture: PlainMixture) -> PlainMixture:
    try:
        return checked(mixture)
    except GmmTorchError as error:
        raise DataError(f"{path} does not contain a valid mixture: {error}") from error
