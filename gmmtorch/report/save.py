"""Figures to files, never half-written."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SUFFIXES = (".png", ".pdf", ".svg")


def save_figure(figure: Figure, path: str | Path, dpi: float = 150.0) -> Path:
    """Write the figure atomically, as its suffix says; PNG has `dpi` pixels an inch. Returns the path.

    Raises `InvalidArgumentError` for a suffix other than .png, .pdf and .svg.
    """
    path = Path(path)
    if path.suffix.lower() not in _SUFFIXES:
        raise InvalidArgumentError(f"path={path} must end in one of {', '.join(_SUFFIXES)}.")
    return write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=dpi))
