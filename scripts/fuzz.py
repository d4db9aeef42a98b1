#!/usr/bin/env python3
"""Hostile input at length: damaged files, messages and datagrams to every reader, within time and memory.

    python scripts/fuzz.py --minutes 60 --folder /tmp/fuzz
    python scripts/fuzz.py --inputs 100000 --targets mcap,pcd

Inputs are sound ones that were changed where it hurts: sizes, counts, names, numbers; checksums fit again.
A reader may return or raise a `GmmTorchError`. Anything else is a fault: another error, more than 10 s of a
processor, more than 512 MiB above what the process had, a new file beside the input, the end of the process.
The inputs of faults are kept in the folder. The exit status is 1 if there is one.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import ctypes
import functools
import json
import logging
import os
import random
import resource
import select
import shutil
import signal
import socket
import struct
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "scripts"), str(ROOT / "tests")]
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np  # noqa: E402
import torch  # noqa: E402
from hostile_bytes import (  # noqa: E402
    Change,
    changed,
    changed_tensors,
    changed_yaml,
    changed_zip,
    mended_datagram,
    mended_e57,
    mended_mcap,
    mended_png,
    mended_tensors,
    png,
)

import gmmtorch as gt  # noqa: E402
from gmmtorch import datasets  # noqa: E402
from gmmtorch.errors import GmmTorchError  # noqa: E402
from gmmtorch.mapping import MapBuilder, TiledMap, tile_files  # noqa: E402

SECONDS, MEMORY, SILENCE = 10, 512 << 20, 60
"""Of a processor and bytes for an input, at most; seconds without an outcome."""
BATCH, BATCH_SECONDS = 6_000, 5
"""Inputs and seconds of a process, at most: slow readers get fewer inputs."""


class Target(NamedTuple):
    """What is fed: `seeds` by the names of their files, and the function that reads such a file.

    mend: makes the checksums of a changed file right again.
    change: changes sound bytes, given all seeds and a source of random numbers.
    has_thread: whether the reader starts a thread, which a fork does not copy.
    """

    seeds: dict[str, bytes]
    read: Callable[[Path], object]
    mend: Callable[[bytes], bytes] | None = None
    change: Change = changed
    has_thread: bool = False


# -- sound inputs ------------------------------------------------------------------------------------


def targets(folder: Path) -> dict[str, Target]:
    """Every reader with small sound inputs, which the package's own writers and the formats' rules make."""
    scans = datasets.load("synthetic_building", n_scans=2)
    few = [scan.select(torch.arange(scan.n_beams) % 400 == 0) for scan in scans]
    poses = [scans.pose(index) for index in range(2)]
    return {
        **bags(folder, few, poses),
        **clouds(folder, few[0].points),
        **logs(),
        **packets(folder),
        **nuscenes(),
        **folders(folder),
        **mixtures(folder, few[0].points),
        **maps(folder, few),
        **sharing(few),
        **sockets(),
    }


def taken(folder: Path, *names: str) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in names}


def read_all(kind: str, path: Path, **options: Any) -> None:
    for scan in datasets.load(kind, path, **options):
        scan.ends()


def in_folder(
    files: Mapping[str, bytes], changing: Mapping[str, str], read: Callable[[Path], object], **rest: Any
) -> Target:
    """A reader of folders. changing: names of files by those of their seeds; the others stay sound."""

    def read_one(path: Path) -> None:
        with tempfile.TemporaryDirectory(prefix="gmmtorch-fuzz", dir=path.parent.parent) as place:
            for name, data in {**files, changing[path.name]: path.read_bytes()}.items():
                (Path(place) / name).parent.mkdir(exist_ok=True)
                (Path(place) / name).write_bytes(data)
            read(Path(place))

    return Target({seed: files[name] for seed, name in changing.items()}, read_one, **rest)


def bags(folder: Path, scans: list[Any], poses: list[Any]) -> dict[str, Target]:
    from gmmtorch.datasets import MessageDecoder
    from gmmtorch.datasets.ros import bag_reader, sensor_messages
    from gmmtorch.export.bag import BagWriter, write_bag

    def messages(path: Path) -> None:
        """A message alone: its decoder, and the conversion of its points."""
        kind = path.suffix[1:]
        decoder = MessageDecoder(bag_reader.standard_definitions(False), packed=False)
        content = decoder.decode(path.read_bytes(), f"sensor_msgs/msg/{kind}")
        convert = {
            "PointCloud2": sensor_messages.cloud_points,
            "LaserScan": sensor_messages.laser_points,
            "Image": sensor_messages.depth_image,
            "CompressedImage": sensor_messages.compressed_depth_image,
            "MultiEchoLaserScan": sensor_messages.laser_points,
        }
        convert[kind](content)

    def bag(path: Path) -> None:
        read_all("rosbag", path)
        reader = datasets.BagReader(path)
        datasets.bag_facts(reader)

    found, seeds = {}, {}
    matrix = np.array([2.0, 0, 2, 0, 2, 1.5, 0, 0, 1])
    camera = {
        "header": {"frame_id": "c"},
        "height": 3,
        "width": 4,
        "k": matrix,
        "distortion_model": "plumb_bob",
    }
    for name in ("a.bag", "a.mcap", "a.db3"):
        write_bag(folder / name, scans, poses)
        mend = mended_mcap if name == "a.mcap" else None
        found[name[2:]] = Target(taken(folder, name), bag, mend)
        found[f"{name[2:]} intact"] = Target(
            taken(folder, name), lambda path: datasets.bag_facts(datasets.BagReader(path, True)), mend
        )
    with BagWriter(folder / "b.mcap") as writer:
        writer.cloud("/a", 0.0, "lidar", np.ones((5, 3)))
        fields = {"header": {"frame_id": "laser"}, "angle_increment": 0.1, "range_max": 9.0}
        writer.message("/b", "sensor_msgs/msg/LaserScan", 0.0, {**fields, "ranges": np.ones(9, np.float32)})
        image = {"height": 3, "width": 4, "encoding": "16UC1", "step": 8, "data": np.ones(24, np.uint8)}
        writer.message("/c", "sensor_msgs/msg/Image", 0.0, image)
        echoes = [{"echoes": np.ones(2, np.float32)}] * 9
        writer.message("/e", "sensor_msgs/msg/MultiEchoLaserScan", 0.0, {**fields, "ranges": echoes})
        packed = {"format": "16UC1; compressedDepth png", "data": np.frombuffer(bytes(12) + png(), np.uint8)}
        writer.message("/d", "sensor_msgs/msg/CompressedImage", 0.0, packed)
    for message in datasets.BagReader(folder / "b.mcap").messages({"/a", "/b", "/c", "/d", "/e"}):
        seeds[f"a.{message.type.rpartition('/')[2]}"] = message.data
    with BagWriter(folder / "c.mcap") as writer:
        for time in (0.0, 0.1):
            writer.message("/c/camera_info", "sensor_msgs/msg/CameraInfo", time, camera)
            writer.message("/c/image", "sensor_msgs/msg/Image", time, {**image, "header": {"frame_id": "c"}})
            writer.message("/p", "geometry_msgs/msg/PoseStamped", time, {"pose": {"orientation": {"w": 1.0}}})
    found["camera"] = Target(
        taken(folder, "c.mcap"), lambda path: read_all("rosbag", path, poses="/p"), mended_mcap
    )
    found["metadata"] = in_folder(
        {"metadata.yaml": METADATA.encode(), "a.db3": (folder / "a.db3").read_bytes()},
        {"m.yaml": "metadata.yaml"},
        lambda place: datasets.bag_facts(datasets.BagReader(place)),
        change=changed_yaml,
    )
    return {**found, "messages": Target(seeds, messages)}


METADATA = """rosbag2_bagfile_information:
  version: 5
  storage_identifier: sqlite3
  relative_file_paths: &a
    - a.db3
  duration: {nanoseconds: 100}
  starting_time: {nanoseconds_since_epoch: 1}
  message_count: 4
  compression_format: ""
  compression_mode: ""
  topics_with_message_count:
    - topic_metadata:
        name: /points
        type: sensor_msgs/msg/PointCloud2
        serialization_format: cdr
        offered_qos_profiles: "- history: 3\n  depth: 0\n  reliability: 1\n  durability: 2"
      message_count: 2
  files:
    - {path: a.db3, starting_time: {nanoseconds_since_epoch: 1}, duration: {nanoseconds: 9}, message_count: 4}
"""


def clouds(folder: Path, points: torch.Tensor) -> dict[str, Target]:
    import open3d

    from gmmtorch.datasets.point_files.point_chunks import read_cloud

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.numpy()[:60]))
    for name, options in {
        "text.pcd": {"write_ascii": True},
        "binary.pcd": {},
        "packed.pcd": {"compressed": True},
        "text.ply": {"write_ascii": True},
        "binary.ply": {},
    }.items():
        open3d.io.write_point_cloud(str(folder / name), cloud, **options)
    np.save(folder / "a.npy", points.numpy()[:60])
    found = {
        "pcd": Target(taken(folder, "text.pcd", "binary.pcd", "packed.pcd"), read_cloud),
        "ply": Target(taken(folder, "text.ply", "binary.ply"), read_cloud),
        "npy": Target(taken(folder, "a.npy"), read_cloud),
    }
    with contextlib.suppress(ImportError):
        import pye57

        with pye57.E57(str(folder / "a.e57"), mode="w") as file:
            data = {f"cartesian{axis}": points.numpy()[:60, k].copy() for k, axis in enumerate("XYZ")}
            file.write_scan_raw(data, rotation=np.eye(4)[0], translation=np.ones(3))
        found["e57"] = Target(taken(folder, "a.e57"), lambda path: read_all("e57", path), mended_e57)
    try:
        import laspy
    except ImportError:
        return found
    las = laspy.create(point_format=3, file_version="1.2")
    las.x, las.y, las.z = points.numpy()[:60].T
    for name in ("a.las", "a.laz"):
        las.write(folder / name)
    return {**found, "las": Target(taken(folder, "a.las", "a.laz"), read_cloud)}


def logs() -> dict[str, Target]:
    from gmmtorch.datasets import read_trajectory
    from gmmtorch.datasets.depth_images import read_png

    def depth(path: Path) -> None:
        read_png(path, str(path))

    laser = b"FLASER 5 1.0 2.0 3.0 81.83 1.5 0.1 0.2 0.3 0.1 0.2 0.3 10.0 host 0.5\n" * 3
    node = b"NODE 0 0 0 0 0 0.1\n1 2 3\n2 3 4\n" * 3
    vector = struct.pack("<i3d", 3, 1.0, 2.0, 3.0)
    pose = vector + struct.pack("<i4d", 4, 1.0, 0.0, 0.0, 0.0)
    graph = struct.pack("<I", 1) + struct.pack("<I", 2) + vector * 2 + pose + struct.pack("<II", 0, 0)
    tum = b"".join(b"%d.5 1 2 3 0 0 0 1\n" % i for i in range(4))
    return {
        "carmen": Target({"a.log": laser}, lambda path: read_all("carmen", path)),
        "octomap": Target({"a.log": node, "a.graph": graph}, lambda path: read_all("octomap_log", path)),
        "trajectory": Target({"a.txt": tum, "k.txt": b"1 0 0 1 0 1 0 2 0 0 1 3\n" * 3}, read_trajectory),
        "png": Target({"a.png": png()}, depth, mended_png),
    }


def folders(folder: Path) -> dict[str, Target]:
    """Recordings in folders, of which one file is changed, and pictures."""
    from gmmtorch.datasets.colour_images import read_image

    rows, pose = b"1 0 0 1 0 1 0 2 0 0 1 3\n" * 2, b"1 0 0 1\n0 1 0 2\n0 0 1 3\n0 0 0 1\n"
    cloud = (folder / "binary.pcd").read_bytes()
    kitti = {
        "velodyne/0.bin": np.ones((4, 4), "<f4").tobytes(),
        "velodyne/1.bin": np.ones((4, 4), "<f4").tobytes(),
        "labels/0.label": struct.pack("<4I", 1, 2, 0, 70_000),
        "labels/1.label": struct.pack("<4I", 1, 2, 0, 70_000),
        "poses.txt": rows,
        "calib.txt": b"P0: 1 2\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n",
        "times.txt": b"0.0\n0.1\n",
    }
    scans = {"scans/0.pcd": cloud, "scans/1.pcd": cloud, "poses.txt": rows}
    matrix = b"2 0 2\n0 2 1.5\n0 0 1\n"
    frames = {"frame-0.depth.png": png(), "frame-0.pose.txt": pose, "camera-intrinsics.txt": matrix}
    tum = {
        "depth/1.png": png(),
        "depth.txt": b"# depth\n1.0 depth/1.png\n1.1 depth/1.png\n",
        "rgb.txt": b"1.0 depth/1.png\n",
        "groundtruth.txt": b"0.5 1 2 3 0 0 0 1\n1.5 1 2 3 0 0 0 1\n",
    }
    intrinsics = [2.0, 2.0, 2.0, 1.5]
    changing = {"k.txt": "poses.txt", "c.txt": "calib.txt", "t.txt": "times.txt"}
    binary = {"b.bin": "velodyne/0.bin", "l.label": "labels/0.label"}
    lists = {"d.txt": "depth.txt", "r.txt": "rgb.txt", "g.txt": "groundtruth.txt"}
    pictures = {"f.txt": "frame-0.pose.txt", "i.txt": "camera-intrinsics.txt", "p.png": "frame-0.depth.png"}
    read_kitti = functools.partial(read_all, "kitti", attributes=["intensity", "class"])
    read_tum = functools.partial(read_all, "tum", intrinsics=intrinsics, attributes=["colour"], max_gap=2.0)
    found = {
        "kitti": in_folder(kitti, {**changing, **binary}, read_kitti),
        "tum": in_folder(tum, lists, read_tum),
        "depth frames": in_folder(
            frames, pictures, lambda path: read_all("depth_frames", path), mend=mended_png
        ),
        "scan folder": in_folder(scans, {"k.txt": "poses.txt"}, lambda path: read_all("scan_folder", path)),
    }
    from PIL import Image

    Image.fromarray(np.arange(192, dtype=np.uint8).reshape(8, 8, 3)).save(folder / "a.jpg")
    seeds = {**taken(folder, "a.jpg"), "a.png": png()}
    return {**found, "colour images": Target(seeds, read_image, mended_png)}


def mixtures(folder: Path, points: torch.Tensor) -> dict[str, Target]:
    """Mixtures of other programs and our own, meshes and octrees."""
    from gmmtorch import export
    from gmmtorch.datasets import read_triangles

    mixture = gt.GaussianMixture(2, random_state=0).fit(points.numpy())
    mixture.save(folder / "mixture.safetensors")
    weights, means, covariances = mixture.weights_, mixture.means_, mixture.covariances_
    numbers = [np.asarray(value) for value in (weights, means, covariances)]
    np.savez_compressed(
        folder / "a.npz", **dict(zip(("weights", "means", "covariances"), numbers, strict=True))
    )
    plain = export.read_npz(folder / "a.npz")
    export.write_gira_csv(folder / "a.csv", plain)
    built = gt.GaussianMap()
    built.insert(gt.Scan(points, torch.zeros(3)))
    built.finish()
    for name in ("s.ply", "s.spz"):
        export.write_splats(folder / name, export.Splats.of(built.components()))
    corners = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n" * 2
    axes = b"".join(b"property float %c\n" % axis for axis in b"xyz")
    ply = b"ply\nformat ascii 1.0\nelement vertex 3\n" + axes
    ply += b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    ply += b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    stl = bytes(80) + struct.pack("<I", 2) + struct.pack("<12fH", *range(12), 0) * 2
    found = {
        "mixture": Target(
            taken(folder, "mixture.safetensors"), gt.GaussianMixture.load, mended_tensors, changed_tensors
        ),
        "npz": Target(taken(folder, "a.npz"), export.read_npz, change=changed_zip),
        "npz as a whole": Target(taken(folder, "a.npz"), export.read_npz),
        "csv": Target(taken(folder, "a.csv"), export.read_gira_csv),
        "splats": Target(taken(folder, "s.ply", "s.spz"), export.read_splats),
        "meshes": Target({"a.obj": corners, "a.stl": stl, "a.ply": ply}, read_triangles),
    }
    with contextlib.suppress(ImportError):
        from gmmtorch.experiments.baselines import OctoMapMap

        octree = OctoMapMap(0.5)
        octree.insert(gt.Scan(points[:20], torch.zeros(3)))
        octree.save(folder / "a.ot")
        found["octree"] = Target(taken(folder, "a.ot"), OctoMapMap.from_octree)
    return found


def maps(folder: Path, scans: list[Any]) -> dict[str, Target]:
    """Maps, their tiles, checkpoints and grids: each changed as a whole, and behind its checksums."""
    from gmmtorch.mapping.tiles.tile_index import read_index
    from gmmtorch.occupancy import OccupancyGrid

    built = gt.GaussianMap()
    data = datasets.load("synthetic_building", n_scans=2)
    builder = MapBuilder(data, built)
    for _ in builder.insert_all():
        pass
    built.save(folder / "whole.safetensors")
    builder.save(folder / "checkpoint.safetensors", {})
    exact = gt.GaussianMap(codec="float")
    coloured = gt.GaussianMap()
    for scan in scans:
        exact.insert(scan)
        n = len(scan.points)
        channels = {"colour": torch.rand(n, 3), "class": torch.arange(n) % 4, "intensity": torch.rand(n)}
        coloured.insert(gt.Scan(scan.points, scan.origin, attributes=channels))
    for name, one in {"exact": exact, "coloured": coloured}.items():
        one.finish()
        one.save(folder / f"{name}.safetensors")
    grid = OccupancyGrid(0.5)
    grid.insert(scans[0])
    grid.save(folder / "grid.safetensors")
    tiles = tile_files(coloured.components(), coloured.settings)
    index, tile = "index.safetensors", next(name for name in tiles if name.startswith("tile"))

    def read_map(path: Path) -> None:
        found = gt.GaussianMap.load(path)
        found.occupancy(torch.zeros(1, found.dim or 3, dtype=torch.float64))

    def read_tiles(place: Path) -> None:
        """The index states the tile that is there, so that the tile's content is what decides."""
        content = (place / tile).read_bytes()
        if content != tiles[tile]:
            known, facts = read_index(place / index)
            row = [f"tile_{a}_{b}.safetensors" for a, b in known.tiles.tolist()].index(tile)
            known.n_bytes[row], known.crc32[row] = len(content), zlib.crc32(content)
            (place / index).write_bytes(known.to_bytes(**facts))
        found = TiledMap(place)
        for row in found.near([-9, -9, -9], [9, 9, 9])[:3]:
            found.components(row)

    def continued(path: Path) -> None:
        MapBuilder(data, gt.GaussianMap()).load(path, {})

    seeds = taken(folder, "exact.safetensors", "coloured.safetensors")
    behind = {"mend": mended_tensors, "change": changed_tensors}
    return {
        "map": Target(seeds, read_map, mended_tensors),
        "map behind": Target(seeds, read_map, **behind),
        "checkpoint": Target(taken(folder, "checkpoint.safetensors"), continued, **behind),
        "grid": Target(taken(folder, "grid.safetensors"), OccupancyGrid.load, **behind),
        "tiles": in_folder(tiles, {"i.safetensors": index, "t.safetensors": tile}, read_tiles, **behind),
    }


def sharing(scans: list[Any]) -> dict[str, Target]:
    """Datagrams and frames of teams, codes of points, and stores."""
    from sharing.message_examples import examples
    from sharing.structured_bodies import structured

    from gmmtorch.team.sharing import POINT_CODECS, Replica, Store, TeamKey, ViewLibrary, ViewsMessage, decode
    from gmmtorch.team.sharing.messages.datagrams import Kind
    from gmmtorch.team.sharing.point_codecs import point_codec
    from gmmtorch.team.sharing.transport.security import Opener, Sealer

    replica = Replica(1)
    built = gt.GaussianMap()
    for scan in scans:
        built.insert(scan)
    built.finish()
    replica.add(built.components())
    packets = [*replica.datagrams(1_200)[:8], *examples()]
    listeners: dict[str, Any] = {}

    def receive(data: bytes) -> None:
        """A robot that has heard the datagrams before; now and then a new one."""
        if listeners.get("n", 0) % 500 == 0:
            listeners.update(replica=Replica(2, incarnation=1, most_components=20_000), views=ViewLibrary(2))
        listeners["n"] = listeners.get("n", 0) + 1
        listeners["replica"].receive(data)
        message = decode(data)
        if isinstance(message, ViewsMessage):
            listeners["views"].receive(message, 0.0)

    def formed(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
        """A changed datagram, or one that follows its format with extreme numbers."""
        return structured(rng.choice(list(Kind)), rng) if rng.random() < 0.5 else changed(data, others, rng)

    key = TeamKey.generate()
    sealers = [Sealer(1, key), Sealer(1, None)]

    def framed(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
        """A changed datagram in a sound frame, or a changed frame."""
        frame = rng.choice(sealers).seal(mended_datagram(formed(data, others, rng))[:1200])
        return frame if rng.random() < 0.7 else changed(frame, others, rng)

    def open_frame(path: Path) -> None:
        if "openers" not in listeners:
            listeners["openers"] = [Opener(key), Opener(None)]
        for opener in listeners["openers"]:
            opened = opener.open(path.read_bytes(), "127.0.0.1:1")
            if opened is not None:
                receive(opened[1])

    codecs = {name: point_codec(name, 0.1, 0.01) for name in POINT_CODECS}
    ends = torch.rand(20, 3, dtype=torch.float64)

    def restore(path: Path) -> None:
        with tempfile.TemporaryDirectory(dir=path.parent.parent) as place:
            shutil.copy(path, place)
            with Store(Path(place) / path.name, robot=1) as store:
                store.restore(Replica(1))
                store.progress()

    with tempfile.TemporaryDirectory() as place:
        with Store(Path(place) / "a.store", robot=1) as store:
            own = Replica(1)
            store.restore(own)
            own.add(built.components())
            store.keep(own.datagrams())
            store.save_progress(1, {"x": torch.ones(3)})
        stored = taken(Path(place), "a.store")
    numbered = {f"{i}.packet": one for i, one in enumerate(packets)}
    return {
        "datagrams": Target(numbered, lambda path: receive(path.read_bytes()), mended_datagram, formed),
        "frames": Target(numbered, open_frame, change=framed),
        "point codes": Target(
            {f"a.{name}": codec.encode(ends) for name, codec in codecs.items()},
            lambda path: codecs[path.suffix[1:]].decode(path.read_bytes()),
        ),
        "stores": Target(stored, restore),
    }


def packets(folder: Path) -> dict[str, Target]:
    """Captures of an XT32 and an OS-1-16, and what states their angles."""
    from gmmtorch.datasets.packets import hesai, ouster

    cells = b"\x88\x13\x09\0" * 32
    blocks = b"".join(struct.pack("<H", 60 * block) + cells for block in range(8))
    xt = bytes([0xEE, 0xFF, 6, 1, 0, 0, 32, 8, 1, 4, 1, 0]) + blocks + bytes(28)
    pixels = struct.pack("<IHHHH", 5000, 9, 7, 8, 0) * 16
    columns = [struct.pack("<QHHI", 10**6 * k, k, 1, 88 * k) + pixels + b"\xff" * 4 for k in range(16)]
    metadata = {
        "beam_altitude_angles": [0.5 * k for k in range(16)],
        "beam_azimuth_angles": [0.0] * 16,
        "lidar_mode": "512x10",
        "lidar_to_sensor_transform": np.eye(4).ravel().tolist(),
    }
    (folder / "os.json").write_text(json.dumps(metadata))
    frames = [frame for data in (xt, xt, b"".join(columns), xt) for frame in ethernet(data)]
    pcap = struct.pack("<IHHIIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
    pcap += b"".join(struct.pack("<4I", 1, 1000 * k, len(f), len(f)) + f for k, f in enumerate(frames))
    pcapng = struct.pack("<3I2HqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28)
    pcapng += struct.pack("<2I2H2I", 1, 20, 1, 0, 65535, 20)
    for number, frame in enumerate(frames):
        body = struct.pack("<5I", 0, 0, number, len(frame), len(frame)) + frame + bytes(-len(frame) % 4)
        pcapng += struct.pack("<2I", 6, 12 + len(body)) + body + struct.pack("<I", 12 + len(body))

    def capture(path: Path) -> None:
        for topic in datasets.BagReader(path, True).topics:
            if topic.type.endswith("Sweep"):
                options = {"calibration": str(folder / "os.json")} if topic.name.endswith("3392") else {}
                read_all("rosbag", path, poses="standing", topic=topic.name, **options)

    def angles(path: Path) -> None:
        if path.suffix == ".csv":
            hesai.read_angles(path)
        else:
            ouster.read_metadata(path.read_bytes(), path.name)

    rows = b"".join(b"%d,%d.5,0.1\n" % (k, 15 - k) for k in range(32))
    stated = {"a.csv": b"Channel,Elevation,Azimuth\n" + rows, **taken(folder, "os.json")}
    return {
        "captures": Target({"a.pcap": pcap, "a.pcapng": pcapng}, capture),
        "lidar angles": Target(stated, angles),
    }


def ethernet(data: bytes) -> list[bytes]:
    """The frames of a datagram to the port with the number of its bytes."""
    udp, found = struct.pack(">4H", 9, len(data), 8 + len(data), 0) + data, []
    for at in range(0, len(udp), 1480):
        part = udp[at : at + 1480]
        place = at // 8 | 0x2000 * (at + 1480 < len(udp))
        head = struct.pack(">2B3H2BH", 0x45, 0, 20 + len(part), 1, place, 64, 17, 0)
        found.append(bytes(12) + b"\x08\0" + head + bytes([10, 0, 0, 1, 10, 0, 0, 2]) + part)
    return found


def nuscenes() -> dict[str, Target]:
    from gmmtorch.datasets import scan_folders

    pose = {"token": "p", "rotation": [1.0, 0.0, 0.0, 0.0], "translation": [1.0, 2.0, 0.0]}
    sweep = {"token": "d", "sample_token": "s", "ego_pose_token": "p", "calibrated_sensor_token": "c"}
    sweep |= {"timestamp": 5, "filename": "samples/LIDAR_TOP/a.pcd.bin"}

    def table(path: Path) -> None:
        scan_folders._transforms(path, ["p"])
        scan_folders._sweeps(path, {"s"})

    return {"nuscenes": Target({"a.json": json.dumps([pose, sweep] * 3, indent=0).encode()}, table)}


# -- sockets: one for each process; its thread is tried again after each input -------------------------


def sockets() -> dict[str, Target]:
    """The UDP transport and the viewer, each asked again after each input whether it still works."""
    found = {
        "udp": Target(
            {"frame": b"\xe1" + bytes(40), "empty": b""}, functools.partial(_to_udp, {}), has_thread=True
        )
    }
    with contextlib.suppress(ImportError):
        import viser

        import gmmtorch.live.map_viewer  # noqa: F401

        upgrade = (
            b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
            b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: viser-v"
            + viser.__version__.encode()
            + b"\r\n"
        )
        host = b"Host: 127.0.0.1:8080\r\n"
        message = (
            b"\x83\xa4type\xb3ViewerCameraMessage\xa4wxyz\x94\xcb" + bytes(8) + b"\x00\x00\x00\xa3fov\x01"
        )
        seeds = {
            "get": b"GET / HTTP/1.1\r\n" + host + b"Accept-Encoding: gzip\r\nIf-None-Match: x\r\n\r\n",
            "path": b"GET /../../../etc/passwd HTTP/1.1\r\n" + host + b"\r\n",
            "socket": b"GET / HTTP/1.1\r\n" + host + upgrade + b"Origin: http://127.0.0.1:8080\r\n\r\n",
            "message": b"GET / HTTP/1.1\r\n" + host + upgrade + b"\r\n" + _websocket_frame(message),
        }
        found["viewer"] = Target(seeds, functools.partial(_to_viewer, {}), has_thread=True)
    return found


def _websocket_frame(payload: bytes) -> bytes:
    """A binary frame of a client (RFC 6455), whose mask changes nothing."""
    return b"\x82" + bytes([0x80 | len(payload)]) + bytes(4) + payload


def _to_udp(kept: dict[str, Any], path: Path) -> None:
    from gmmtorch.team.sharing import UdpTransport

    if not kept:
        kept.update(to=UdpTransport.unicast(1), by=socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    transport, data = kept["to"], path.read_bytes()[:60_000]
    before = transport.received.datagrams
    kept["by"].sendto(data, transport.address)
    end = time.monotonic() + 5
    while transport.received.datagrams == before:
        if time.monotonic() > end:
            raise RuntimeError("the transport no longer receives")
        time.sleep(0)
    transport.deliver(1, 0.0)


def _to_viewer(kept: dict[str, Any], path: Path) -> None:
    from gmmtorch.live.map_viewer import MapViewer

    if not kept:
        place = MapViewer(gt.GaussianMap(), port=20_000 + os.getpid() % 40_000).server.get_port()
        kept["place"] = "127.0.0.1", place
    own = f"127.0.0.1:{kept['place'][1]}".encode()
    sound = b"GET /nothing HTTP/1.1\r\nHost: " + own + b"\r\n\r\n"
    hostile, received = path.read_bytes().replace(b"127.0.0.1:8080", own), b""
    for data, wanted in ((hostile, False), (sound, True)):
        with socket.create_connection(kept["place"], timeout=5) as connection:
            connection.sendall(data)
            connection.settimeout(0.01 if not wanted else 5)
            with contextlib.suppress(ConnectionError, TimeoutError):
                received = connection.recv(4096)
        if wanted and not received.startswith(b"HTTP/1.1 "):
            raise RuntimeError(f"the viewer no longer answers: {received[:60]!r}")


# -- runs --------------------------------------------------------------------------------------------


class TooLongError(Exception):
    """A reader took more than its seconds."""


M_ARENA_MAX = -8


@functools.cache
def parse_once() -> None:
    """Definitions of messages that did not change are parsed once, because that takes half of the time."""
    import rosbags.typesys

    parse = rosbags.typesys.get_types_from_msg
    rosbags.typesys.get_types_from_msg = functools.lru_cache(maxsize=200)(parse)


def child(target: Target, seed: int, n: int, place: Path, to: int) -> None:
    """Feeds n inputs, fewer if they take too long; writes a line for each to a pipe."""
    rng, end = random.Random(seed), time.monotonic() + BATCH_SECONDS
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(M_ARENA_MAX, 1)  # so that the memory of idle threads does not count
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def stop(*_: object) -> None:
        raise TooLongError

    signal.signal(signal.SIGPROF, stop)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    before = set(place.iterdir())
    for _ in range(n):
        if time.monotonic() > end:
            break
        name = rng.choice(list(target.seeds))
        data = target.change(target.seeds[name], list(target.seeds.values()), rng)
        if target.mend is not None and rng.random() < 0.7:
            data = target.mend(data)
        path = place / name
        path.write_bytes(data)
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, resource.RLIM_INFINITY))
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        outcome = "read"
        try:
            target.read(path)
        except GmmTorchError as error:
            outcome = "refused"
            if not str(error).isprintable():
                outcome = "fault: a message with control characters"
        except BaseException as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            outcome = (
                f"fault: {type(error).__name__} in {Path(last.filename).name}:{last.lineno} {error!s:.80}"
            )
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        if outcome.startswith("fault"):
            shutil.copy(path, place / f"fault-{zlib.crc32(data):08x}-{name}")
        path.unlink()
        extra = [one.name for one in set(place.iterdir()) - before if not one.name.startswith("fault-")]
        if extra:
            outcome = f"fault: files were written: {extra[:3]}"
        os.write(to, (json.dumps(outcome) + "\n").encode())
    os._exit(0)


def warm_up(name: str, target: Target, place: Path) -> None:
    """Reads the sound inputs, so that what readers import is in memory. Raises an error if one is refused."""
    for seed, data in target.seeds.items() if not target.has_thread else ():
        path = place / seed
        path.write_bytes(data)
        try:
            target.read(path)
        except GmmTorchError as error:
            raise AssertionError(f"{name}: the sound {seed} is refused: {error}") from error
        path.unlink()


def batch(target: Target, seed: int, n: int, place: Path) -> Iterator[str]:
    """The outcomes of n inputs in a process of their own."""
    begin, end = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(begin)
        try:
            child(target, seed, n, place, end)
        finally:
            os._exit(3)
    os.close(end)
    rest, status = b"", None
    while True:
        if not select.select([begin], [], [], SILENCE)[0]:
            os.kill(pid, signal.SIGKILL)
            status = "fault: it hangs outside of Python"
            break
        data = os.read(begin, 65536)
        if not data:
            break
        *lines, rest = (rest + data).split(b"\n")
        yield from (json.loads(line) for line in lines)
    os.close(begin)
    _, code = os.waitpid(pid, 0)
    if status is None and code:
        status = f"fault: the process ended with status {code}"
    if status is not None:
        for path in place.iterdir():
            if path.name in target.seeds:
                path.rename(place / f"fault-{seed}-{path.name}")
        yield status


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, help="how long it runs")
    parser.add_argument("--inputs", type=int, help="how many inputs it feeds, if it does not run for minutes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--targets", default="", help="names, separated by commas; all without")
    parser.add_argument("--folder", type=Path, help="for inputs that made faults; a temporary one without")
    options = parser.parse_args()
    logging.disable()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    parse_once()
    memory = Path("/dev/shm")  # where writing a file takes no time
    folder = options.folder or Path(tempfile.mkdtemp(prefix="fuzz", dir=memory if memory.is_dir() else None))
    (folder / "seeds").mkdir(parents=True, exist_ok=True)
    chosen = targets(folder / "seeds")
    if options.targets:
        names = options.targets.split(",")
        if unknown := set(names) - chosen.keys():
            parser.error(f"no targets {', '.join(sorted(unknown))}; there are {', '.join(chosen)}")
        chosen = {name: chosen[name] for name in names}
    for name, target in chosen.items():
        (folder / name.replace(" ", "_")).mkdir(exist_ok=True)
        warm_up(name, target, folder / name.replace(" ", "_"))
    counts = {name: collections.Counter[str]() for name in chosen}
    seconds = collections.Counter[str]()
    end = time.monotonic() + 60 * (options.minutes or 1e9)
    seed = options.seed * 1_000_000
    n_inputs = options.inputs or (10**12 if options.minutes else 20_000)
    while sum(map(collections.Counter.total, counts.values())) < n_inputs and time.monotonic() < end:
        for name, target in chosen.items():
            place = folder / name.replace(" ", "_")
            seed += 1
            start = time.monotonic()
            size = min(BATCH, max(20, n_inputs // (20 * len(chosen))))
            outcomes = collections.Counter(batch(target, seed, size, place))
            for outcome in outcomes:
                if outcome.startswith("fault") and outcome not in counts[name]:
                    print(f"{name}: {outcome} (in {place})", flush=True)
            counts[name] += outcomes
            seconds[name] += round(time.monotonic() - start)
        (folder / "counts.json").write_text(json.dumps({"outcomes": counts, "seconds": seconds}, indent=1))
    n_faults = 0
    print(f"\n{'reader':16}{'inputs':>10}{'read':>10}{'refused':>10}{'faults':>8}")
    for name, found in counts.items():
        faults = sum(n for outcome, n in found.items() if outcome.startswith("fault"))
        total = found["read"] + found["refused"] + faults
        print(f"{name:16}{total:>10,}{found['read']:>10,}{found['refused']:>10,}{faults:>8,}")
        n_faults += faults
    return int(n_faults > 0)


if __name__ == "__main__":
    sys.exit(main())
