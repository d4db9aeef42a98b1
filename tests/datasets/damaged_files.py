"""Reads damaged copies of files of every format, with limits of memory and time. A program, run by a test.

    python damaged_files.py FOLDER SEED COUNT FORMAT…

prints one line of JSON for each reading that ended in anything but finite points or a `GmmTorchError`.
"""

from __future__ import annotations

import gzip
import json
import random
import resource
import shutil
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import scan_files
import test_octomap_log
import test_point_chunks
import torch
from PIL import Image

from gmmtorch.datasets import load, open_points, read_triangles
from gmmtorch.errors import GmmTorchError

MEMORY_BYTES = 1 << 30
CPU_SECONDS = 20
HEADER_BYTES = 400

IDENTITY = scan_files.kitti(np.eye(3), [0.0, 0.0, 0.0])
POINTS = [(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)]


def carmen(folder: Path, name: str = "a.log") -> None:
    test = scan_files.flaser([1.0, 2.0, 3.0], (1.0, 2.0, 0.5)) * 4
    (folder / name).write_bytes(gzip.compress(test.encode()) if name.endswith("z") else test.encode())


def octomap(folder: Path) -> None:
    (folder / "a.log").write_text("NODE 1 2 3 0 0 0.5\n1 2 3\n4 5 6\n" * 4)


def octomap_graph(folder: Path) -> None:
    pose = test_octomap_log.MOVED
    (folder / "a.graph").write_bytes(test_octomap_log.graph([(pose, POINTS)] * 3, n_edges=2))


def frames(folder: Path) -> None:
    scan_files.depth_folder(folder, [(np.full((6, 8), 1500, np.uint16), np.eye(4))])


def scans(folder: Path, form: str) -> None:
    content = {
        "binary.pcd": scan_files.pcd(POINTS),
        "ascii.pcd": scan_files.pcd(POINTS, binary=False),
        "ascii.ply": scan_files.ply(POINTS),
    }
    scan_files.scan_folder(folder, {form: content[form]}, IDENTITY)


def compressed(folder: Path) -> None:
    import open3d

    cloud = open3d.t.geometry.PointCloud(np.random.default_rng(0).normal(size=(40, 3)))
    open3d.t.io.write_point_cloud(str(folder / "a.pcd"), cloud, write_ascii=False, compressed=True)


def mesh(folder: Path, suffix: str) -> None:
    import open3d

    box = open3d.geometry.TriangleMesh.create_box()
    box.compute_triangle_normals()
    open3d.io.write_triangle_mesh(str(folder / f"a.{suffix}"), box)


def all_scans(name: str, path: str) -> Callable[[Path], list[torch.Tensor]]:
    def read(folder: Path) -> list[torch.Tensor]:
        dataset = load(name, folder / path)
        return [*(scan.points for scan in dataset), *(dataset.pose(i) for i in range(len(dataset)))]

    return read


def bag(folder: Path, name: str, pack: bool) -> None:
    from rosbags.rosbag1 import Writer
    from rosbags.rosbag2 import CompressionFormat, CompressionMode
    from sensor_bags import BagWriter

    writer = BagWriter(folder / name)
    if pack and name.endswith(".bag"):
        writer.writer.set_compression(Writer.CompressionFormat.LZ4)
    elif pack:
        writer.writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer as to:
        for time in (0.0, 1.0):
            to.transforms(time, {("odom", "lidar"): np.eye(4)})
            to.cloud("/points", time, "lidar", np.array(POINTS), [0.0, 0.0])
            to.laser("/scan", time, "lidar", [1.0, 2.0], 0.0, 0.1, 9.0)


def bag_scans(name: str) -> Callable[[Path], list[torch.Tensor]]:
    def read(folder: Path) -> list[torch.Tensor]:
        clouds = load("rosbag", folder / name)
        lasers = load("rosbag", folder / name, topic="/scan", poses="standing")
        return [scan.points for scan in (*clouds, *lasers)]

    return read


def kitti_sequence(folder: Path) -> None:
    (folder / "velodyne").mkdir()
    np.ones((4, 4), "<f4").tofile(folder / "velodyne" / "0.bin")
    (folder / "poses.txt").write_text(IDENTITY)
    (folder / "calib.txt").write_text(f"Tr: {IDENTITY}")
    (folder / "times.txt").write_text("0.5\n")


def tum_sequence(folder: Path) -> None:
    Image.fromarray(np.full((4, 5), 5000, np.uint16)).save(folder / "0.png")
    (folder / "depth.txt").write_text("1.5 0.png\n")
    (folder / "groundtruth.txt").write_text("1.4 0 0 0 0 0 0 1\n1.6 1 0 0 0 0 0 1\n")


def all_points(name: str) -> Callable[[Path], list[torch.Tensor]]:
    return lambda folder: [chunk.points for chunk in open_points(folder / name)]


FORMATS: dict[str, tuple[Callable[[Path], object], Callable[[Path], list[torch.Tensor]]]] = {
    "carmen": (carmen, all_scans("carmen", "a.log")),
    "carmen_gzip": (lambda folder: carmen(folder, "a.gz"), all_scans("carmen", "a.gz")),
    "octomap_log": (octomap, all_scans("octomap_log", "a.log")),
    "octomap_graph": (octomap_graph, all_scans("octomap_log", "a.graph")),
    "depth_frames": (frames, all_scans("depth_frames", "")),
    **{
        f"scans/{form}": (lambda folder, form=form: scans(folder, form), all_scans("scan_folder", ""))
        for form in ("binary.pcd", "ascii.pcd", "ascii.ply")
    },
    **{
        name: (lambda folder, name=name: test_point_chunks.written(folder, name), all_points(name))
        for name in ("c.npy", *test_point_chunks.RECORDS, *test_point_chunks.TEXT, "a.las", "a.laz")
    },
}
RECORDINGS: dict[str, tuple[Callable[[Path], object], Callable[[Path], list[torch.Tensor]]]] = {
    "kitti": (kitti_sequence, all_scans("kitti", "")),
    "tum": (tum_sequence, all_scans("tum", "")),
    **{
        f"{name}{'.packed' * pack}": (
            lambda folder, name=name, pack=pack: bag(folder, name, pack),
            bag_scans(name),
        )
        for name, pack in (
            ("a.mcap", False),
            ("a.mcap", True),
            ("a.db3", False),
            ("a.bag", False),
            ("a.bag", True),
        )
    },
}
WITH_OPEN3D = {
    "compressed.pcd": (compressed, all_points("a.pcd")),
    **{
        f"mesh.{suffix}": (
            lambda folder, suffix=suffix: mesh(folder, suffix),
            lambda folder, suffix=suffix: [read_triangles(folder / f"a.{suffix}")],
        )
        for suffix in ("ply", "obj", "stl")
    },
}


def damaged(data: bytes, draw: random.Random) -> bytes:
    """The bytes with one damage: a changed byte, a changed word, a cut, a gap, or a number made huge."""
    place = draw.randrange(min(len(data), HEADER_BYTES) if draw.random() < 0.7 else len(data))
    kind = draw.randrange(6)
    if kind <= 1:
        return (
            data[:place]
            + bytes([draw.choice([0, 1, 127, 128, 255, draw.randrange(256)])])
            + data[place + 1 :]
        )
    if kind == 2:
        word = draw.choice([b"\xff" * 4, b"\xff\xff\xff\x7f", b"\0\0\0\0", b"\xff" * 8, b"\0\0\0\x40"])
        return data[:place] + word + data[place + len(word) :]
    if kind == 3:
        return data[:place]
    if kind == 4:
        return data[:place] + data[place + draw.randrange(1, 9) :]
    digits = [i for i, byte in enumerate(data[: 2 * HEADER_BYTES]) if chr(byte).isdigit()]
    place = draw.choice(digits) if digits else place
    return data[:place] + draw.choice([b"999999999999", b"-1", b"4294967295", b"1e308"]) + data[place + 1 :]


def limit_memory() -> None:
    """Limits the address space to what is in use now and `MEMORY_BYTES` more."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES, resource.RLIM_INFINITY))


def out_of_time(*_: object) -> None:
    raise TimeoutError(f"more than {CPU_SECONDS} s of processor time")


def outcome(read: Callable[[Path], list[torch.Tensor]], folder: Path) -> str | None:
    """What is wrong with a reading; None for finite points or a `GmmTorchError`."""
    signal.setitimer(signal.ITIMER_VIRTUAL, CPU_SECONDS)
    try:
        found = read(folder)
    except GmmTorchError:
        return None
    except BaseException:
        return traceback.format_exc(limit=-6)
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
    return None if all(bool(torch.isfinite(points).all()) for points in found) else "a point is not finite"


def wrong_outcomes(root: Path, seed: int, count: int, names: list[str], limited: bool) -> Iterator[str]:
    """A line of JSON for each of `count` damaged copies of a file of each format that is read wrongly."""
    signal.signal(signal.SIGVTALRM, out_of_time)
    known = {**FORMATS, **RECORDINGS, **WITH_OPEN3D}
    folders = {name: root / name for name in names}
    for name, folder in folders.items():
        folder.mkdir(parents=True)
        known[name][0](folder)
        assert known[name][1](folder)  # the undamaged file is read, and imports what reading needs
    if limited:
        limit_memory()
    for name, folder in folders.items():
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        for number in range(count):
            draw = random.Random(f"{name} {seed} {number}")
            path = draw.choice(files)
            whole = path.read_bytes()
            path.write_bytes(damaged(whole, draw))
            shutil.copy(path, root / f"last-{path.name}")  # what a crash leaves to look at
            if (wrong := outcome(known[name][1], folder)) is not None:
                kept = root / f"{number}-{path.name}"
                shutil.copy(path, kept)
                yield json.dumps({"format": name, "file": str(kept), "wrong": wrong})
            path.write_bytes(whole)


def main(root: str, seed: str, count: str, *names: str) -> None:
    for line in wrong_outcomes(Path(root), int(seed), int(count), list(names), limited=True):
        print(line, flush=True)
    print("done", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
