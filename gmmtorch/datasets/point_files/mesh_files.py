"""Triangle meshes from PLY, OBJ and STL files. Polygons become fans of triangles.

Sizes that a header announces are compared with the data before anything is allocated.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.point_files.headers import AXES, damaged
from gmmtorch.datasets.point_files.ply_files import ply_elements
from gmmtorch.errors import DataError

_INDICES = ("vertex_indices", "vertex_index")
_STL_HEADER_BYTES = 80
_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)")


def read_triangles(path: Path) -> Tensor:
    """Triangles (T, 3, 3), float64, of a PLY, OBJ or STL file.

    Raises `DataError` if the file is unreadable or truncated, has no triangle, or has a corner that is not
    finite.
    """
    readers: dict[str, Callable[[Path], np.ndarray]] = {".ply": _ply, ".obj": _obj, ".stl": _stl}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise DataError(f"{path} is not a PLY, OBJ or STL file; convert the mesh to one of these formats.")
    with damaged(path, "contains no readable triangles"):
        triangles = reader(path)
    if len(triangles) == 0:
        raise DataError(f"{path} contains no readable triangles; give a PLY, OBJ or STL file with faces.")
    if not np.isfinite(triangles).all():
        raise DataError(f"{path}: a corner is NaN or infinite; the file is damaged.")
    return torch.from_numpy(triangles)


def _fans(corners: np.ndarray, polygons: list[np.ndarray]) -> np.ndarray:
    """Triangles (T, 3, 3) of polygons: arrays (F, k) of rows of `corners` (V, 3)."""
    indices = [p[:, [0, i, i + 1]] for p in polygons for i in range(1, p.shape[1] - 1)]
    faces = np.concatenate(indices) if indices else np.empty((0, 3), np.int64)
    with np.errstate(invalid="ignore"):  # NaN
        whole = faces.astype(np.int64)
    if faces.size and not (whole.min() >= 0 and whole.max() < len(corners) and (whole == faces).all()):
        raise ValueError("a face refers to a missing corner")
    return corners[whole]


def _by_size(polygons: list[list[int]]) -> list[np.ndarray]:
    """Polygons as one array (F, k) for each number k of corners."""
    found: dict[int, list[list[int]]] = {}
    for polygon in polygons:
        found.setdefault(len(polygon), []).append(polygon)
    return [np.array(same, np.int64).reshape(len(same), size) for size, same in found.items()]


def _ply(path: Path) -> np.ndarray:
    elements = ply_elements(path)
    vertices, faces = elements["vertex"], elements.get("face", {})
    corners = np.stack([vertices[axis] for axis in AXES], 1).astype(np.float64)
    return _fans(corners, next((faces[key] for key in _INDICES if key in faces), []))


def _obj(path: Path) -> np.ndarray:
    corners: list[list[bytes]] = []
    polygons: list[list[int]] = []
    with path.open("rb") as file:
        for line in file:
            words = line.split()
            if words[:1] == [b"v"]:
                corners.append(words[1:4])
            elif words[:1] == [b"f"]:
                numbers = [int(word.split(b"/")[0]) for word in words[1:]]
                polygons.append([n - 1 if n > 0 else len(corners) + n for n in numbers])
    return _fans(np.array(corners, np.float64).reshape(-1, 3), _by_size(polygons))


def _stl(path: Path) -> np.ndarray:
    data = path.read_bytes()
    start = _STL_HEADER_BYTES + 4
    count = int.from_bytes(data[_STL_HEADER_BYTES:start], "little")
    if len(data) == start + count * _STL_TRIANGLE.itemsize:
        return np.frombuffer(data, _STL_TRIANGLE, count, start)["corners"].astype(np.float64)
    if not data.lstrip().startswith(b"solid"):
        raise ValueError(f"{count} triangles are announced, but it has {len(data)} bytes")
    return np.array(_VERTEX.findall(data), np.float64).reshape(-1, 3, 3)
