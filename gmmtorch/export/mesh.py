"""Triangle meshes of the surfaces of a map, and their PLY, OBJ and GLB files."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.export.point_cloud import RGB, colour_bytes, glb_bytes, ply_bytes
from gmmtorch.files import write_bytes
from gmmtorch.linalg import ragged_index
from gmmtorch.mapping import Components
from gmmtorch.occupancy import check_resolution

_EXTENT = 2.0  # deviations that a component reaches along its surface; a uniform square ends at √3
_BAND = 1.75  # cells on either side of a surface in which its distance counts
_LEAST_DEVIATION = 0.4  # cells; smaller components would fall between the lattice points
_BACK = -0.5  # smallest cosine of a crossing's direction with the normal; others lie between two surfaces
_WINDOW = 16  # cells, longest side of the rectangles that are evaluated
_PAIRS = 1 << 20  # pairs of component and lattice point that are evaluated at a time
_POINT_BYTES = 120  # of a lattice point or window while it is processed
_LEAST_FALLOFF = 1e-4
_LEAST_CROSSINGS = 3  # of the edges of a cell with a vertex; fewer occur at the borders of sheets
_REACH = 1 << 20  # cells on either side of the origin that a key can hold
_STEPS = (1 << 42, 1 << 21, 1)  # of a key, for one cell along x, y, z


class TriangleMesh(NamedTuple):
    """Vertices (V, 3), metres; unit normals (V, 3), which point to the observed side; faces (F, 3) int64,
    counter-clockwise from that side."""

    vertices: Tensor
    normals: Tensor
    faces: Tensor

    def inside(self, low: Sequence[float], high: Sequence[float]) -> TriangleMesh:
        """The triangles whose corners all lie in the box between two corners (3,), metres."""
        box = (self.vertices.new_tensor(corner) for corner in (low, high))
        kept = ((self.vertices >= next(box)) & (self.vertices <= next(box))).all(1)
        return _compact(self.vertices, self.normals, self.faces[kept[self.faces].all(1)])


class _Field(NamedTuple):
    """Sums over components at lattice points: keys (P,), ascending; distance (P,), m; normal (P, 3)."""

    keys: Tensor
    distance: Tensor
    normal: Tensor


class _Sheets(NamedTuple):
    """Flat components: means (K, 3), axes (K, 3, 3) as columns with the normal first, deviations (K, 2) along
    the surface, weights (K,)."""

    means: Tensor
    axes: Tensor
    deviations: Tensor
    weights: Tensor


class _Windows(NamedTuple):
    """Rectangles on sheets: sheet (W,); center and half sides (W, 2) along the sheet's axes, metres."""

    sheet: Tensor
    center: Tensor
    half: Tensor


def surface_mesh(components: Components, resolution: float, memory_limit: int = 4 << 30) -> TriangleMesh:
    """The surfaces of a 3D map as triangles with sides of about `resolution` metres.

    A surface is a sheet that faces the sensors; a wall that was observed from both sides has two sheets.
    Sheets end where the components end. Components of beams without return are left out.

    Args:
        components: of a 3D map.
        resolution: side of the lattice's cells (m).
        memory_limit: bytes of the lattice, at most.

    Raises `InvalidArgumentError` for a 2D map or an invalid argument, and `MemoryLimitError`.
    """
    if components.dim != 3:
        raise InvalidArgumentError("A mesh needs a 3D map; this map is 2D: export map_server instead.")
    side = check_resolution(resolution)
    sheets = _sheets(components, side)
    field = _field(sheets, side, memory_limit)
    return _surface_nets(field, side)


def _sheets(components: Components, side: float) -> _Sheets:
    """The surface components as oriented sheets."""
    kept = (~components.max_range & (components.support > 0)).nonzero().squeeze(1)
    chosen = components.selected(kept)
    variances, axes = torch.linalg.eigh(chosen.covariances)
    view = chosen.origins[chosen.seen_from] - chosen.means[chosen.seen_by]
    view = view / view.norm(dim=1, keepdim=True).clamp_min(1e-9)
    seen = chosen.means.new_zeros(len(chosen), 3)
    seen.index_add_(0, chosen.seen_by, view * chosen.seen_count[:, None])
    normal = axes[:, :, 0]
    sign = torch.where((normal * seen).sum(1) < 0, -1.0, 1.0).to(normal)
    axes = torch.cat([(normal * sign[:, None])[:, :, None], axes[:, :, 1:]], 2)
    deviations = variances.clamp_min(0).sqrt()
    # Thin sheets are exact, blobs are not; their distances count less where both overlap.
    weights = 1 / (deviations[:, 0] ** 2 + (0.25 * side) ** 2)
    return _Sheets(chosen.means, axes, deviations[:, 1:].clamp_min(_LEAST_DEVIATION * side), weights)


def _windows(sheets: _Sheets, side: float, memory_limit: int) -> _Windows:
    """The rectangles around all sheets, cut so that the boxes around oblique ones stay small."""
    reach = _EXTENT * sheets.deviations
    n = (2 * reach / (_WINDOW * side)).ceil().clamp_min(1)
    _check_memory(float(n.prod(1).sum()), side, memory_limit)
    n = n.long()
    sheet, number = ragged_index(n.prod(1))
    place = torch.stack([number // n[sheet, 1], number % n[sheet, 1]], 1)
    half = reach[sheet] / n[sheet]
    return _Windows(sheet, (2 * place + 1) * half - reach[sheet], half)


def _check_memory(n_points: float, side: float, memory_limit: int) -> None:
    if _POINT_BYTES * n_points > memory_limit:
        raise MemoryLimitError(
            f"resolution={side:g} m needs more than {memory_limit:,} bytes of lattice points; use larger "
            "cells."
        )


def _field(sheets: _Sheets, side: float, memory_limit: int) -> _Field:
    """The averaged distances and normals at all lattice points near a sheet."""
    band = _BAND * side
    windows = _windows(sheets, side, memory_limit)
    axes = sheets.axes[windows.sheet]
    middle = sheets.means[windows.sheet] + torch.einsum("wij,wj->wi", axes[:, :, 1:], windows.center)
    reach = torch.cat([torch.full_like(windows.half[:, :1], band), windows.half], 1)
    half = torch.einsum("wij,wj->wi", axes.abs(), reach)
    first = ((middle - half) / side).ceil().long()
    size = (((middle + half) / side).floor().long() - first + 1).clamp_min(0)
    if len(first) and int((first.abs() + size).max()) >= _REACH - 2:
        far = float(sheets.means.abs().max())
        raise InvalidArgumentError(
            f"resolution={side:g} m is too fine for a map that reaches {far:.6g} m from the origin; use at "
            f"least {far / (_REACH - 4):.2g} m."
        )
    starts, total = [0], size.prod(1).cumsum(0)
    while starts[-1] < len(total):
        before = int(total[starts[-1] - 1]) if starts[-1] else 0
        end = int(torch.searchsorted(total, before + _PAIRS, right=True))
        starts.append(max(starts[-1] + 1, end))
    keys, sums = [first.new_zeros(0)], [sheets.means.new_zeros(0, 5)]
    for begin, end in itertools.pairwise(starts):
        _check_memory(sum(map(len, keys)), side, memory_limit)
        rows = slice(begin, end)
        part = _Windows(*(value[rows] for value in windows))
        for kept, found in zip((keys, sums), _near(sheets, part, first[rows], size[rows], side), strict=True):
            kept.append(found)
    key, total_sums = _reduced(torch.cat(keys), torch.cat(sums))
    weight = total_sums[:, :1].clamp_min(1e-300)
    return _Field(key, total_sums[:, 1] / weight[:, 0], total_sums[:, 2:] / weight)


def _near(
    sheets: _Sheets, windows: _Windows, first: Tensor, size: Tensor, side: float
) -> tuple[Tensor, Tensor]:
    """Keys (P,) and sums Σw, Σw·d, Σw·n (P, 5) of the lattice points near the sheets, in some windows."""
    band = _BAND * side
    row, number = ragged_index(size.prod(1))
    n = size[row]
    cell = torch.stack([number // (n[:, 1] * n[:, 2]), number // n[:, 2] % n[:, 1], number % n[:, 2]], 1)
    cell = cell + first[row]
    sheet = windows.sheet[row]
    local = torch.einsum("pi,pij->pj", cell * side - sheets.means[sheet], sheets.axes[sheet])
    along = (local[:, 1:] / sheets.deviations[sheet]).square().sum(1)
    low, high = windows.center - windows.half, windows.center + windows.half
    inside = ((local[:, 1:] >= low[row]) & (local[:, 1:] < high[row])).all(1)
    near = (inside & (along <= _EXTENT**2) & (local[:, 0].abs() <= band)).nonzero().squeeze(1)
    distance, sheet = local[near, 0], sheet[near]
    falloff = torch.exp(-along[near]) * (1 - (distance / band).square()).square().clamp_min(_LEAST_FALLOFF)
    weight = sheets.weights[sheet] * falloff
    normal = sheets.axes[sheet][:, :, 0]
    values = torch.cat([torch.stack([weight, weight * distance], 1), weight[:, None] * normal], 1)
    return _reduced(_key(cell[near]), values)


def _key(cell: Tensor) -> Tensor:
    """One whole number for each lattice point (P, 3); a step along an axis adds its entry of `_STEPS`."""
    return ((cell + _REACH) * cell.new_tensor(_STEPS)).sum(1)


def _cell(key: Tensor) -> Tensor:
    """The inverse of `_key`."""
    parts = torch.stack([key // _STEPS[0], key // _STEPS[1] % _STEPS[1], key % _STEPS[1]], 1)
    return parts - _REACH


def _reduced(keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """The distinct keys, ascending, and the sums of their values."""
    distinct, place = torch.unique(keys, return_inverse=True)
    return distinct, values.new_zeros(len(distinct), values.shape[1]).index_add_(0, place, values)


def _found(keys: Tensor, wanted: Tensor) -> Tensor:
    """The rows of keys (ascending), −1 for those that are absent."""
    row = torch.searchsorted(keys, wanted).clamp_max(max(len(keys) - 1, 0))
    return torch.where(keys[row] == wanted, row, -1) if len(keys) else torch.full_like(wanted, -1)


def _surface_nets(field: _Field, side: float) -> TriangleMesh:
    """The zero level of a field: a vertex for each cell with crossed edges, a quadrilateral for each edge."""
    places, normals, corners, upward = [], [], [], []
    for axis, step in enumerate(_STEPS):
        other = _found(field.keys, field.keys + step)
        a = (other >= 0).nonzero().squeeze(1)
        b = other[a]
        begin, end = field.distance[a], field.distance[b]
        normal = field.normal[a] + field.normal[b]
        rises = end > begin
        facing = torch.where(rises, 1.0, -1.0).to(normal) * normal[:, axis]
        crossed = ((begin < 0) != (end < 0)) & (facing > _BACK * normal.norm(dim=1))
        a, begin, end = a[crossed], begin[crossed], end[crossed]
        place = _cell(field.keys[a]).double() * side
        place[:, axis] += side * begin / (begin - end)
        second, third = _STEPS[(axis + 1) % 3], _STEPS[(axis + 2) % 3]
        around = field.keys.new_tensor([second + third, third, 0, second])
        places.append(place)
        normals.append(normal[crossed])
        corners.append(field.keys[a][:, None] - around)
        upward.append(rises[crossed])
    corner = torch.cat(corners)
    cells, vertex = torch.unique(corner, return_inverse=True)
    crossings = torch.bincount(vertex.flatten(), minlength=len(cells))
    sums = field.normal.new_zeros(len(cells), 6)
    values = torch.cat([torch.cat(places), torch.cat(normals)], 1)
    sums.index_add_(0, vertex.flatten(), values.repeat_interleave(4, 0))
    points = sums[:, :3] / crossings[:, None]
    quads = torch.where(torch.cat(upward)[:, None], vertex, vertex.flip(1))
    quads = quads[(crossings[quads] >= _LEAST_CROSSINGS).all(1)]
    return _compact(points, torch.nn.functional.normalize(sums[:, 3:], dim=1), _triangles(points, quads))


def _triangles(points: Tensor, quads: Tensor) -> Tensor:
    """Quadrilaterals (Q, 4) cut along their shorter diagonals (F, 3)."""
    corner = points[quads]
    shorter = (corner[:, 0] - corner[:, 2]).norm(dim=1) <= (corner[:, 1] - corner[:, 3]).norm(dim=1)
    turned = torch.where(shorter[:, None], quads, quads.roll(-1, 1))
    return torch.cat([turned[:, [0, 1, 2]], turned[:, [0, 2, 3]]])


def _compact(points: Tensor, normals: Tensor, faces: Tensor) -> TriangleMesh:
    """The mesh without unused vertices."""
    used, place = torch.unique(faces, return_inverse=True)
    return TriangleMesh(points[used], normals[used], place.view(-1, 3))


_UPRIGHT = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]  # quaternion that turns z up, ours, to y up, glTF's


def write_mesh(path: str | Path, mesh: TriangleMesh, colours: Tensor | None = None) -> Path:
    """Writes a mesh with its normals, atomically; the suffix `.ply`, `.obj` or `.glb` selects the format.

    PLY, binary: vertices x, y, z (double, m) and nx, ny, nz (float). OBJ: text, with six decimals. GLB:
    float32 relative to the middle of the mesh, whose place is the node's translation; y is up, as glTF
    demands. `colours`: linear RGB (V, 3) from 0 to 1 of the vertices, written as sRGB (PLY: red, green, blue,
    uchar; OBJ: after the coordinates) and as linear RGB (GLB).

    Raises `InvalidArgumentError` for another suffix or a mesh without triangles.
    """
    path = Path(path)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise InvalidArgumentError(f"path={path} must end in {', '.join(_WRITERS)}.")
    if len(mesh.faces) == 0:
        raise InvalidArgumentError(f"The mesh for {path} has no triangle; use smaller cells.")
    vertices, normals, faces = (part.detach().cpu().numpy() for part in mesh)
    linear = None if colours is None else colours.detach().cpu().double().clamp(0, 1)
    return write_bytes(path, writer(vertices, normals, faces, linear))


def _ply(vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, linear: Tensor | None) -> bytes:
    columns = [*vertices.astype("<f8").T, *normals.astype("<f4").T]
    columns += [] if linear is None else [*colour_bytes(linear).T]
    return ply_bytes(dict(zip(("x", "y", "z", "nx", "ny", "nz", *RGB), columns, strict=False)), faces=faces)


def _obj(vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, linear: Tensor | None) -> bytes:
    table = vertices if linear is None else np.concatenate([vertices, colour_bytes(linear) / 255], 1)
    line = "v {:.6f} {:.6f} {:.6f}" + " {:.4f} {:.4f} {:.4f}" * (linear is not None)
    lines = [line.format(*row) for row in table.tolist()]
    lines += ["vn {:.4f} {:.4f} {:.4f}".format(*row) for row in normals.tolist()]
    lines += ["f {0}//{0} {1}//{1} {2}//{2}".format(*row) for row in (faces + 1).tolist()]
    return ("\n".join(lines) + "\n").encode("ascii")


def _glb(vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, linear: Tensor | None) -> bytes:
    middle = (vertices.min(0) + vertices.max(0)) / 2
    x, y, z = middle.tolist()
    attributes = {"POSITION": vertices - middle, "NORMAL": normals}
    attributes |= {} if linear is None else {"COLOR_0": linear.numpy()}
    shade = [0.75, 0.75, 0.78, 1.0] if linear is None else [1.0] * 4
    surface = {"baseColorFactor": shade, "metallicFactor": 0.0, "roughnessFactor": 0.9}
    return glb_bytes(
        attributes,
        faces,
        primitive={"material": 0},
        node={"rotation": _UPRIGHT, "translation": [x, z, -y]},
        materials=[{"doubleSided": True, "pbrMetallicRoughness": surface}],
    )


_WRITERS: dict[str, Callable[[np.ndarray, np.ndarray, np.ndarray, Tensor | None], bytes]] = {
    ".ply": _ply,
    ".obj": _obj,
    ".glb": _glb,
}
