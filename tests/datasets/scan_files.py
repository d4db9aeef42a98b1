"""Files of scans for tests of the readers: laser logs, clouds, and folders of scans and depth images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

TURN_LEFT = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def flaser(readings: list[float], pose: tuple[float, ...] = (0.0, 0.0, 0.0)) -> str:
    words = ["FLASER", len(readings), *readings, *pose, 9, 9, 9, 0.0, "host", 0.0]
    return " ".join(map(str, words)) + "\n"


def text(table: np.ndarray) -> bytes:
    """The records of a table, one in each line."""
    return "".join(" ".join(repr(x.item()) for x in row) + "\n" for row in table).encode()


def pcd_of(table: np.ndarray, kinds: str, form: str = "binary", viewpoint: str = "0 0 0 1 0 0 0") -> bytes:
    """A PCD file of records. kinds: letters of TYPE."""
    names, n = table.dtype.names, len(table)
    header = (
        f"VERSION 0.7\nFIELDS {' '.join(names)}\n"
        f"SIZE {' '.join(str(table.dtype[name].itemsize) for name in names)}\nTYPE {' '.join(kinds)}\n"
        f"COUNT {' '.join('1' for _ in names)}\nWIDTH {n}\nHEIGHT 1\nVIEWPOINT {viewpoint}\nPOINTS {n}\n"
        f"DATA {form}\n"
    )
    return header.encode() + (table.tobytes() if form == "binary" else text(table))


def ply_of(table: np.ndarray, form: str = "ascii") -> bytes:
    """A PLY file of vertices."""
    names = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "i4": "int"}
    lines = [f"property {names[table.dtype[n].str[1:]]} {n}\n" for n in table.dtype.names]
    header = f"ply\nformat {form} 1.0\nelement vertex {len(table)}\n{''.join(lines)}end_header\n"
    return header.encode() + (text(table) if form == "ascii" else table.tobytes())


def cloud(points: list) -> np.ndarray:
    return np.array([tuple(point) for point in points], [(axis, "<f4") for axis in "xyz"])


def pcd(points: list, viewpoint: str = "0 0 0 1 0 0 0", binary: bool = True) -> bytes:
    return pcd_of(cloud(points), "FFF", "binary" if binary else "ascii", viewpoint)


def ply(points: list) -> bytes:
    return ply_of(cloud(points))


def kitti(rotation: np.ndarray, translation: list[float]) -> str:
    return " ".join(str(v) for v in np.column_stack([rotation, translation]).ravel()) + "\n"


def scan_folder(path: Path, clouds: dict[str, bytes], poses: str) -> Path:
    (path / "scans").mkdir()
    for name, content in clouds.items():
        (path / "scans" / name).write_bytes(content)
    (path / "poses.txt").write_text(poses)
    return path


def depth_folder(path: Path, frames: list[tuple[np.ndarray, np.ndarray]]) -> Path:
    height, width = frames[0][0].shape[:2]
    center = (width - 1) / 2, (height - 1) / 2
    (path / "camera-intrinsics.txt").write_text(f"100 0 {center[0]}\n0 200 {center[1]}\n0 0 1\n")
    for number, (depth, pose) in enumerate(frames):
        Image.fromarray(depth).save(path / f"frame-{number:06d}.depth.png")
        np.savetxt(path / f"frame-{number:06d}.pose.txt", pose)
    return path
