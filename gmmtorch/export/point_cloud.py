"""Observed cells as points with occupancy probabilities, and their PLY, PCD and OctoMap files."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, OutputError
from gmmtorch.files import write_bytes
from gmmtorch.occupancy import (
    CellClass,
    SparseEvidence,
    Thresholds,
    VoxelGrid,
    check_resolution,
    occupancy_probability,
)
from gmmtorch.optional_packages import load_pyoctomap
from gmmtorch.scan import display_colours

RGB = ("red", "green", "blue")
_GLTF_TYPES, _GLTF_TARGETS = {"f": 5126, "u": 5125}, {"f": 34962, "u": 34963}
_MIN_STEPS = 16  # least number of float32 values per cell side; with fewer, centres would be too inexact


@dataclass(frozen=True, eq=False)
class CellCloud:
    """Centres (M, D) of cells of side `resolution`, world metres, and their occupancy probability (M,).

    Raises `InvalidArgumentError` for shapes that do not match, centres that are not finite, and probabilities
    outside [0, 1].
    """

    centers: Tensor
    probability: Tensor
    resolution: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "resolution", check_resolution(self.resolution))
        m = self.centers.shape[0] if self.centers.ndim == 2 else -1
        if m < 0 or self.centers.shape[1] not in (2, 3) or self.probability.shape != (m,):
            raise InvalidArgumentError(
                f"centers has shape {tuple(self.centers.shape)} and probability "
                f"{tuple(self.probability.shape)}; expected (M, 2) or (M, 3), and (M,)."
            )
        if not bool(torch.isfinite(self.centers).all()):
            raise InvalidArgumentError("centers holds NaN or infinite values; drop such cells.")
        if not bool(((self.probability >= 0) & (self.probability <= 1)).all()):
            raise InvalidArgumentError("probability holds values outside [0, 1], or NaN; give occupancies.")

    @classmethod
    def of_grid(cls, grid: VoxelGrid, probability: Tensor) -> CellCloud:
        """The cells of a grid whose probability is not exactly ½. `probability` has the shape of the grid."""
        if tuple(probability.shape) != grid.shape:
            raise InvalidArgumentError(
                f"probability has shape {tuple(probability.shape)}; the grid's is {grid.shape}."
            )
        known = (probability != 0.5).nonzero()
        origin = torch.tensor(grid.origin, dtype=torch.float64, device=known.device)
        centers = origin + (known.double() + 0.5) * grid.resolution
        return cls(centers, probability[probability != 0.5].double(), grid.resolution)

    @classmethod
    def of_blocks(cls, blocks: SparseEvidence, prior: float = 1.0) -> CellCloud:
        """The cells of a lattice that have evidence, with the probability that follows from it."""
        cells, hits, misses = blocks.cells()
        theta = occupancy_probability(hits, misses, prior)
        return cls((cells.double() + 0.5) * blocks.resolution, theta, blocks.resolution)

    def __len__(self) -> int:
        return self.centers.shape[0]

    def above(self, threshold: float) -> CellCloud:
        """The cells whose occupancy probability is above the threshold."""
        chosen = self.probability > threshold
        return CellCloud(self.centers[chosen], self.probability[chosen], self.resolution)

    def positions(self) -> np.ndarray:
        """Centres as an array (M, 3) on the CPU; z = 0 for a 2D map."""
        array = self.centers.detach().cpu().double().numpy()
        return np.pad(array, ((0, 0), (0, 3 - array.shape[1])))


def write_ply(path: str | Path, cells: CellCloud, colours: Tensor | None = None) -> Path:
    """Writes the cells, atomically, as binary PLY: vertices x, y, z (double) and intensity = θ (float).

    `colours`: linear RGB (M, 3) from 0 to 1, written as sRGB: red, green, blue (uchar).
    """
    comment = f"centres of cells of {cells.resolution!r} m; intensity is the probability of occupancy"
    columns = _columns(cells, "<f8")
    if colours is not None:
        columns |= dict(zip(RGB, colour_bytes(colours).T, strict=True))
    return write_bytes(path, ply_bytes(columns, comment))


def colour_bytes(colours: Tensor) -> np.ndarray:
    """sRGB (M, 3) uint8 of linear RGB (M, 3) from 0 to 1."""
    shades = 255 * display_colours(colours.detach().cpu().double().clamp(0, 1))
    return shades.round().numpy().astype(np.uint8)


def ply_bytes(
    vertices: Mapping[str, np.ndarray], comment: str = "", faces: np.ndarray | None = None
) -> bytes:
    """Binary PLY of vertices, columns (V,) of floating numbers and bytes, and triangles (F, 3)."""
    names = {"<f8": "double", "<f4": "float", "|u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0"] + [f"comment {comment}"] * bool(comment)
    header += [f"element vertex {len(next(iter(vertices.values())))}"]
    header += [f"property {names[column.dtype.str]} {name}" for name, column in vertices.items()]
    content = _rows(vertices)
    if faces is not None:
        content += _rows({"n": np.full(len(faces), 3, np.uint8), "corners": faces.astype("<i4")})
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    return "\n".join([*header, "end_header\n"]).encode("ascii") + content


def _rows(columns: Mapping[str, np.ndarray]) -> bytes:
    """Columns (N, …), row by row."""
    length = len(next(iter(columns.values())))
    rows = np.empty(length, [(name, values.dtype, values.shape[1:]) for name, values in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    return rows.tobytes()


def glb_bytes(
    vertices: Mapping[str, np.ndarray],
    faces: np.ndarray | None = None,
    primitive: Mapping[str, Any] = MappingProxyType({}),
    node: Mapping[str, Any] = MappingProxyType({}),
    **more: Any,
) -> bytes:
    """Binary glTF 2.0 of one primitive: attributes (V, n) of vertices by name, as float32, and triangles
    (F, 3). primitive, node and `more` are further entries of these objects, and of the file.
    """
    tables = [values.astype("<f4") for values in vertices.values()]
    tables += [] if faces is None else [faces.astype("<u4").reshape(-1, 1)]
    shapes = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
    data = [table.tobytes() for table in tables]  # each a multiple of four bytes long
    begins = np.cumsum([0, *map(len, data)]).tolist()
    accessors: list[dict[str, Any]] = [
        {
            "bufferView": view,
            "componentType": _GLTF_TYPES[table.dtype.kind],
            "count": len(table),
            "type": shapes[table.shape[1]],
        }
        for view, table in enumerate(tables)
    ]
    accessors[0] |= {"min": tables[0].min(0).tolist(), "max": tables[0].max(0).tolist()}
    indices = {} if faces is None else {"indices": len(vertices)}
    attributes = {name: number for number, name in enumerate(vertices)}
    content = {
        "asset": {"version": "2.0", "generator": "gmmtorch"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **node}],
        "meshes": [{"primitives": [{"attributes": attributes, **indices, **primitive}]}],
        "buffers": [{"byteLength": begins[-1]}],
        "bufferViews": [
            {
                "buffer": 0,
                "byteOffset": begin,
                "byteLength": len(part),
                "target": _GLTF_TARGETS[table.dtype.kind],
            }
            for begin, part, table in zip(begins, data, tables, strict=False)
        ],
        "accessors": accessors,
        **more,
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", begins[-1], b"BIN\0") + b"".join(data)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def write_pcd(path: str | Path, cells: CellCloud) -> Path:
    """Writes the cells, atomically, as binary PCD: fields x, y, z and intensity = θ, all float32.

    PCL reads only float32. Raises `InvalidArgumentError` if float32 cannot represent the cell centres exactly
    enough.
    """
    positions = cells.positions()
    far = float(np.abs(positions).max()) if len(cells) else 0.0
    if np.spacing(np.float32(far)) * _MIN_STEPS > cells.resolution:
        raise InvalidArgumentError(
            f"cells of {cells.resolution} m lie {far:.6g} m from the origin, where the float32 numbers of a "
            "PCD file are too coarse; write PLY, which has doubles, or move the map closer to its origin."
        )
    header = "\n".join(
        [
            "# .PCD v0.7 - Point Cloud Data file format",
            "VERSION 0.7",
            "FIELDS x y z intensity",
            "SIZE 4 4 4 4",
            "TYPE F F F F",
            "COUNT 1 1 1 1",
            f"WIDTH {len(cells)}",
            "HEIGHT 1",
            "VIEWPOINT 0 0 0 1 0 0 0",
            f"POINTS {len(cells)}",
            "DATA binary\n",
        ]
    )
    return write_bytes(path, header.encode("ascii") + _rows(_columns(cells, "<f4")))


def _columns(cells: CellCloud, kind: str) -> dict[str, np.ndarray]:
    """Columns (M,) of cells: x, y, z of this type, and intensity."""
    columns = dict(zip("xyz", cells.positions().astype(kind).T, strict=True))
    return columns | {"intensity": cells.probability.detach().cpu().numpy().astype("<f4")}


_REACH = 1 << 15  # cells on either side of the origin, because OctoMap's keys have 16 bits
_MIN_PROBABILITY = 1e-6  # least distance of a probability from 0 and 1: log-odds of ±13.8


def write_octomap(
    path: str | Path, cells: CellCloud, thresholds: Thresholds | None = None, colours: Tensor | None = None
) -> Path:
    """Writes the cells, atomically, as an OctoMap: `.ot` with log-odds, or `.bt` with two classes.

    A `.ot` file contains every cell, with its probability clamped to [10⁻⁶, 1 − 10⁻⁶]. A `.bt` file
    contains the cells that `thresholds` classify as occupied or free. Other space is absent, which means
    unknown in OctoMap. Eight equal siblings are merged into one node. A 2D map becomes the layer of cells
    above z = 0. With `colours`, linear RGB (M, 3) from 0 to 1, a `.ot` file has a ColorOcTree.

    Raises `InvalidArgumentError` for another suffix, for cells that are not aligned to multiples of the
    resolution, and for cells beyond the range of OctoMap's keys; `GmmTorchError` without pyoctomap.
    """
    path = Path(path)
    if path.suffix not in (".bt", ".ot"):
        raise InvalidArgumentError(f"path={path} must end in .bt (two classes) or .ot (probabilities).")
    pyoctomap = load_pyoctomap()
    centers = _lattice_centers(cells)
    theta = cells.probability.detach().cpu().double().clamp(_MIN_PROBABILITY, 1 - _MIN_PROBABILITY)
    with_colours = colours is not None and path.suffix == ".ot"
    tree = (pyoctomap.ColorOcTree if with_colours else pyoctomap.OcTree)(cells.resolution)
    tree.setClampingThresMin(_MIN_PROBABILITY)
    tree.setClampingThresMax(1 - _MIN_PROBABILITY)
    if path.suffix == ".ot":
        for center, value in zip(centers, theta.logit().tolist(), strict=True):
            tree.updateNode(center, value)
        if colours is not None:
            for center, shade in zip(centers, colour_bytes(colours).tolist(), strict=True):
                tree.setNodeColor(center, *shade)
            tree.updateInnerOccupancy()  # inner nodes get the mean colour
            tree.prune()
        data = tree.write()
    else:
        label = (thresholds or Thresholds()).classify(cells.probability.detach().cpu()).numpy()
        for kind, value in ((CellClass.FREE, -1.0), (CellClass.OCCUPIED, 1.0)):
            tree.updateNodes(centers[label == kind], value)
        data = tree.writeBinary()
    if not data:
        raise OutputError(f"{path} was not written, because pyoctomap could not serialize the octree.")
    return write_bytes(path, data)


def _lattice_centers(cells: CellCloud) -> np.ndarray:
    """Cell centres (M, 3) on OctoMap's grid, whose cells reach from i·resolution to (i+1)·resolution."""
    units = cells.positions() / cells.resolution
    units[:, cells.centers.shape[1] :] = 0.5
    index = np.floor(units)
    if len(units) and not (index.min() >= -_REACH and index.max() < _REACH):
        far = float(np.abs(index).max()) * cells.resolution
        raise InvalidArgumentError(
            f"cells of {cells.resolution} m lie {far:.6g} m from the origin; OctoMap reaches "
            f"{_REACH * cells.resolution:.6g} m. Move the map closer to its origin, or use a resolution of "
            f"{far / (_REACH - 1):.3g} m or more."
        )
    if len(units) and float(np.abs(units - index - 0.5).max()) > 1e-3:
        raise InvalidArgumentError(
            f"the cells of {cells.resolution} m are not aligned to multiples of that size, which OctoMap "
            "requires; create their grid with VoxelGrid.covering."
        )
    return (index + 0.5) * cells.resolution
