"""Files of scans for tests of the readers: laser logs, clouds, and folders of scans and depth images."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from PIL import Image

TURN_LEFT = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def flaser(readings: list[float], pose: tuple[float, ...] = (0.0, 0.0, 0.0)) -> str:
    words = ["FLASER", len(readings), *readings, *pose, 9, 9, 9, 0.0, "host", 0.0]
    return " ".join(map(str, words)) + "\n"


def pcd(
    points: list, viewpoint: str = "0 0 0 1 0 0 0", binary: bool = True, announce: int | None = None
) -> bytes:
    n = len(points) if announce is None else announce
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT {viewpoint}\nPOINTS {n}\nDATA {'binary' if binary else 'ascii'}\n"
    )
    if binary:
        return header.encode() + b"".join(struct.pack("<3f", *p) for p in points)
    return (header + "".join("{} {} {}\n".format(*p) for p in points)).encode()


def ply(points: list) -> bytes:
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n" + "".join(
        f"property float {axis}\n" for axis in "xyz"
    )
    return (header + "end_header\n" + "".join("{} {} {}\n".format(*p) for p in points)).encode()


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
