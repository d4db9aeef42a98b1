"""Mixtures in others' formats: GIRA's CSV, and plain arrays as NPZ."""

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
"""Of a file that is read, and of what a compressed one unpacks to."""


class PlainMixture(NamedTuple):
    """weights (K,) that add up to one, means (K, D), covariances (K, D, D): float64, metres.

    support (K,): points that each component stands for; None if nobody says.
    """

    weights: Tensor
    means: Tensor
    covariances: Tensor
    support: Tensor | None = None

    @classmethod
    def of_support(cls, means: Tensor, covariances: Tensor, support: Tensor) -> PlainMixture:
        """The mixture of components with these supports, of which one at least is above zero."""
        total = float(support.sum())
        if not total > 0:
            raise InvalidArgumentError("support adds up to nothing; there is no mixture to write.")
        return cls(support / total, means, covariances, support)


def checked(mixture: PlainMixture) -> PlainMixture:
    """The mixture in float64 on the CPU, its weights divided by their sum and its covariances made
    exactly symmetric; raises `InvalidArgumentError` or `NumericalError` if it is none."""
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
        raise InvalidArgumentError("weights must be at least zero, one of them above, and finite.")
    if support is not None and bool((support < 0).any()):
        raise InvalidArgumentError("support must not be negative.")
    covariances = (check_symmetric(covariances, "covariances") + covariances.mT) / 2
    safe_cholesky(covariances)
    return PlainMixture(weights / total, means, covariances, support)


# -- GIRA's CSV -----------------------------------------------------------------------------------


def write_gira_csv(path: str | Path, mixture: PlainMixture) -> Path:
    """Write the mixture, atomically, as GIRA's `gmm_utils` does: a row for each component, no heading.

    Columns: mean (D), covariance (D², column by column, which symmetry makes row by row), weight. The
    number of points is not part of it. Written with 17 digits, as GIRA's own six make the covariances
    of thin components indefinite.
    """
    sound = checked(mixture)
    rows = torch.cat([sound.means, sound.covariances.flatten(1), sound.weights[:, None]], 1)
    text = io.StringIO()
    np.savetxt(text, rows.numpy(), fmt="%.17g", delimiter=", ")
    return write_bytes(path, text.getvalue().encode("ascii"))


def read_gira_csv(path: str | Path, n_points: float | None = None) -> PlainMixture:
    """Read a mixture that GIRA, or `write_gira_csv`, wrote; D follows from the number of columns.

    `n_points`: how many points it was learned from, which the file does not say; `support` is None
    without. Weights are divided by their sum. Raises `MissingDataError` if it is not there, and
    `DataError` if it is not such a file, or its covariances are not definite.
    """
    path = _readable(path, "a GIRA mixture (CSV)")
    if n_points is not None and not 0 < n_points < math.inf:
        raise InvalidArgumentError(f"n_points={n_points} must be a number above zero, or None.")
    try:
        # Opened here, as numpy would unpack what is called .gz; and an empty file is told of below.
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


# -- NPZ ------------------------------------------------------------------------------------------


def write_npz(path: str | Path, mixture: PlainMixture) -> Path:
    """Write the mixture, atomically, as NPZ: weights, means, covariances and, if known, support; float64."""
    sound = checked(mixture)
    buffer = io.BytesIO()
    np.savez(buffer, **{k: v.numpy() for k, v in sound._asdict().items() if v is not None})
    return write_bytes(path, buffer.getvalue())


def read_npz(path: str | Path) -> PlainMixture:
    """Read a mixture from an NPZ file with arrays weights, means, covariances and, if there, support.

    Nothing is unpickled. Raises `MissingDataError` if it is not there, and `DataError` if it is no such
    file, or unpacks to more than `MAX_BYTES`.
    """
    path = _readable(path, "a mixture (NPZ)")
    names = ("weights", "means", "covariances")
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > MAX_BYTES:
            raise DataError(f"{path} unpacks to {size:,} bytes, more than the {MAX_BYTES:,} that are read.")
        with np.load(path, allow_pickle=False) as stored:
            missing = [name for name in names if name not in stored]
            if missing:
                raise DataError(f"{path} lacks {', '.join(missing)}; it is no mixture.")
            wanted = (*names, "support") if "support" in stored else names
            arrays = {name: torch.from_numpy(np.asarray(stored[name], dtype=np.float64)) for name in wanted}
    except GmmTorchError:
        raise
    except (OSError, ValueError, TypeError, KeyError, MemoryError, RuntimeError, zipfile.BadZipFile) as error:
        raise DataError(f"{path} is damaged, or no NPZ file of numbers: {error}") from error
    return _sound(path, PlainMixture(**arrays))


# -- what both need -------------------------------------------------------------------------------


def _readable(path: str | Path, what: str) -> Path:
    path = Path(path)
    if not path.is_file():
        raise MissingDataError(f"{path} does not exist; expected {what}.")
    if path.stat().st_size > MAX_BYTES:
        raise DataError(
            f"{path} has {path.stat().st_size:,} bytes, more than the {MAX_BYTES:,} that are read."
        )
    return path


def _sound(path: Path, mixture: PlainMixture) -> PlainMixture:
    try:
        return checked(mixture)
    except GmmTorchError as error:
        raise DataError(f"{path} does not hold a mixture: {error}") from error
