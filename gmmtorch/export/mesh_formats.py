"""Writes triangle meshes as PLY, OBJ or GLB (binary glTF 2.0)."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.export.mesh import TriangleMesh
from gmmtorch.files import write_bytes

_GLTF_FLOAT, _GLTF_UINT = 5126, 5125  # component types
_ARRAY, _ELEMENTS = 34962, 34963  # buffer targets
_UPRIGHT = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]  # quaternion that turns z up, ours, to y up, glTF's


def write_mesh(path: str | Path, mesh: TriangleMesh) -> Path:
    """Writes a mesh with its normals, atomically; the suffix `.ply`, `.obj` or `.glb` selects the format.

    PLY, binary: vertices x, y, z (double, m) and nx, ny, nz (float). OBJ: text, with six decimals. GLB:
    float32 relative to the middle of the mesh, whose place is the node's translation; y is up, as glTF
    demands.

    Raises `InvalidArgumentError` for another suffix or a mesh without triangles.
    """
    path = Path(path)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise InvalidArgumentError(f"path={path} must end in {', '.join(_WRITERS)}.")
    if len(mesh.faces) == 0:
        raise InvalidArgumentError(f"The mesh for {path} has no triangle; use smaller cells.")
    vertices, normals, faces = (part.detach().cpu().numpy() for part in mesh)
    return write_bytes(path, writer(vertices, normals, faces))


def _ply(vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> bytes:
    names = ("x", "y", "z", "nx", "ny", "nz")
    rows = np.empty(len(vertices), [(name, "<f8" if i < 3 else "<f4") for i, name in enumerate(names)])
    for i, name in enumerate(names):
        rows[name] = (vertices if i < 3 else normals)[:, i % 3]
    triangles = np.empty(len(faces), [("n", "u1"), ("corners", "<i4", 3)])
    triangles["n"], triangles["corners"] = 3, faces
    header = "\n".join(
        [
            "ply",
            "format binary_little_endian 1.0",
            f"element vertex {len(vertices)}",
            *(f"property {'double' if i < 3 else 'float'} {name}" for i, name in enumerate(names)),
            f"element face {len(faces)}",
            "property list uchar int vertex_indices",
            "end_header\n",
        ]
    )
    return header.encode("ascii") + rows.tobytes() + triangles.tobytes()


def _obj(vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> bytes:
    lines = ["v {:.6f} {:.6f} {:.6f}".format(*row) for row in vertices.tolist()]
    lines += ["vn {:.4f} {:.4f} {:.4f}".format(*row) for row in normals.tolist()]
    lines += ["f {0}//{0} {1}//{1} {2}//{2}".format(*row) for row in (faces + 1).tolist()]
    return ("\n".join(lines) + "\n").encode("ascii")


def _glb(vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> bytes:
    middle = (vertices.min(0) + vertices.max(0)) / 2
    local = (vertices - middle).astype("<f4")
    parts = [local.tobytes(), normals.astype("<f4").tobytes(), faces.astype("<u4").tobytes()]
    begins = np.cumsum([0, *map(len, parts)]).tolist()
    x, y, z = middle.tolist()
    content = {
        "asset": {"version": "2.0", "generator": "gmmtorch"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": _UPRIGHT, "translation": [x, z, -y]}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1}, "indices": 2, "material": 0}]}
        ],
        "materials": [
            {
                "doubleSided": True,
                "pbrMetallicRoughness": {
                    "baseColorFactor": [0.75, 0.75, 0.78, 1.0],
                    "metallicFactor": 0.0,
                    "roughnessFactor": 0.9,
                },
            }
        ],
        "buffers": [{"byteLength": begins[-1]}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": begin, "byteLength": len(part), "target": target}
            for begin, part, target in zip(begins, parts, (_ARRAY, _ARRAY, _ELEMENTS), strict=False)
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _GLTF_FLOAT,
                "count": len(local),
                "type": "VEC3",
                "min": local.min(0).tolist(),
                "max": local.max(0).tolist(),
            },
            {"bufferView": 1, "componentType": _GLTF_FLOAT, "count": len(normals), "type": "VEC3"},
            {"bufferView": 2, "componentType": _GLTF_UINT, "count": faces.size, "type": "SCALAR"},
        ],
    }
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(parts)  # every part is a multiple of four bytes long
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


_WRITERS: dict[str, Callable[[np.ndarray, np.ndarray, np.ndarray], bytes]] = {
    ".ply": _ply,
    ".obj": _obj,
    ".glb": _glb,
}
