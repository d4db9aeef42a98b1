"""Readers of recordings: bags, captures, clouds, logs and folders."""

from __future__ import annotations

import contextlib
import functools
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from fuzzing.hostile_bytes import changed_yaml, mended_e57, mended_mcap, mended_png, png
from fuzzing.target import Target, in_folder, read_all, taken

from gmmtorch import datasets


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
        for topic in datasets.BagReader(path).topics:
            if topic.type.endswith("Datagram"):
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
    from gmmtorch.datasets.depth_images import read_image

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

    def colours(path: Path) -> None:
        read_image(path, str(path), ("JPEG", "PNG"), 1 << 25, "RGB")

    return {**found, "colour images": Target(seeds, colours, mended_png)}


def nuscenes() -> dict[str, Target]:
    from gmmtorch.datasets import scan_folders

    pose = {"token": "p", "rotation": [1.0, 0.0, 0.0, 0.0], "translation": [1.0, 2.0, 0.0]}
    sweep = {"token": "d", "sample_token": "s", "ego_pose_token": "p", "calibrated_sensor_token": "c"}
    sweep |= {"timestamp": 5, "filename": "samples/LIDAR_TOP/a.pcd.bin"}

    def table(path: Path) -> None:
        scan_folders._transforms(path, ["p"])
        scan_folders._sweeps(path, {"s"})

    return {"nuscenes": Target({"a.json": json.dumps([pose, sweep] * 3, indent=0).encode()}, table)}
