#!/usr/bin/env python3
"""Hostile input at length: damaged files, messages and datagrams to every reader, within time and memory.

    python scripts/fuzz.py --minutes 60 --folder /tmp/fuzz
    python scripts/fuzz.py --inputs 100000 --targets mcap,pcd

Inputs are sound ones that were changed where it hurts: sizes, counts, names, numbers; checksums fit again.
A reader may return or raise a `GmmTorchError`. Anything else is a fault: another error, more than 10 s, more
than 512 MiB above what the process had, a new file beside the input, the death of the process. The inputs of
faults are kept in the folder. The exit status is 1 if there is one.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import logging
import os
import random
import re
import resource
import select
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np  # noqa: E402
import torch  # noqa: E402

import gmmtorch as gt  # noqa: E402
from gmmtorch import datasets  # noqa: E402
from gmmtorch.errors import GmmTorchError  # noqa: E402
from gmmtorch.mapping import TiledMap, tile_files  # noqa: E402

SECONDS, MEMORY, BATCH, SILENCE = 10, 512 << 20, 500, 40
HOSTILE = (
    b"../../../tmp/x", b"\x1b[31mred\x1b]0;title\x07", b"\0", b"\r\n\t", b"a" * 3000, "\u202e".encode(),
    b"%s%n",
    b"nan", b"-inf", b"1e999", b"9" * 40, b"-1", b"0", b"0x10", b"1_0", b"1,5", b"{{}}", b"!!python/object:x",
)  # fmt: skip
SIZES = (0, 1, 2, 127, 255, 2**15, 2**16 - 1, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1, 2**64 - 1)


class Target(NamedTuple):
    """What is fed: `seeds` by the names of their files, and the function that reads such a file.

    mend: makes the checksums of a changed file right again.
    """

    seeds: dict[str, bytes]
    read: Callable[[Path], object]
    mend: Callable[[bytes], bytes] | None = None


# -- sound inputs ------------------------------------------------------------------------------------


def targets(folder: Path) -> dict[str, Target]:
    """Every reader with small sound inputs, which the package's own writers and the formats' rules make."""
    scans = datasets.load("synthetic_building", n_scans=2)
    few = [scan.select(torch.arange(scan.n_beams) % 400 == 0) for scan in scans]
    poses = [scans.pose(index) for index in range(2)]
    found = {**bags(folder, few, poses), **clouds(folder, few[0].points), **logs(), **sharing(few)}
    found |= packets(folder) | nuscenes()
    built = gt.GaussianMap()
    for scan in few:
        built.insert(scan)
    built.finish()
    built.save(folder / "a.safetensors")
    found["map"] = Target(taken(folder, "a.safetensors"), lambda path: gt.GaussianMap.load(path), mended_map)
    tiles = tile_files(built.components(), built.settings)
    found["tiles"] = Target(
        {"index.safetensors": tiles["index.safetensors"]},
        lambda path: TiledMap(path.parent).near([0, 0, 0], [1, 1, 1]),
        mended_map,
    )
    return found


def taken(folder: Path, *names: str) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in names}


def mended_map(data: bytes) -> bytes:
    from gmmtorch.files import with_checksum

    try:
        return with_checksum(data)
    except ValueError:
        return data


def read_all(kind: str, path: Path, **options: Any) -> None:
    for scan in datasets.load(kind, path, **options):
        scan.ends()


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
        }
        convert[kind](content)

    def bag(path: Path) -> None:
        read_all("rosbag", path)
        reader = datasets.BagReader(path)
        datasets.bag_facts(reader)

    found, seeds = {}, {}
    for name in ("a.bag", "a.mcap", "a.db3"):
        write_bag(folder / name, scans, poses)
        found[name[2:]] = Target(taken(folder, name), bag)
        found[f"{name[2:]} intact"] = Target(
            taken(folder, name), lambda path: datasets.bag_facts(datasets.BagReader(path, True))
        )
    with BagWriter(folder / "b.mcap") as writer:
        writer.cloud("/a", 0.0, "lidar", np.ones((5, 3)))
        fields = {"header": {"frame_id": "laser"}, "angle_increment": 0.1, "range_max": 9.0}
        writer.message("/b", "sensor_msgs/msg/LaserScan", 0.0, {**fields, "ranges": np.ones(9, np.float32)})
        image = {"height": 3, "width": 4, "encoding": "16UC1", "step": 8, "data": np.ones(24, np.uint8)}
        writer.message("/c", "sensor_msgs/msg/Image", 0.0, image)
        packed = {"format": "16UC1; compressedDepth png", "data": np.frombuffer(bytes(12) + png(), np.uint8)}
        writer.message("/d", "sensor_msgs/msg/CompressedImage", 0.0, packed)
    for message in datasets.BagReader(folder / "b.mcap").messages({"/a", "/b", "/c", "/d"}):
        seeds[f"a.{message.type.rpartition('/')[2]}"] = message.data
    return {**found, "messages": Target(seeds, messages)}


def png() -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = b"".join(b"\0" + struct.pack(">4H", *range(4)) for _ in range(3))
    head = struct.pack(">IIBBBBB", 4, 3, 16, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


def mended_png(data: bytes) -> bytes:
    found, at = bytearray(data), 8
    while at + 12 <= len(found):
        (length,) = struct.unpack_from(">I", found, at)
        if at + 12 + length > len(found):
            break
        struct.pack_into(">I", found, at + 8 + length, zlib.crc32(found[at + 4 : at + 8 + length]))
        at += 12 + length
    return bytes(found)


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


def mended_e57(data: bytes) -> bytes:
    """Pages of 1024 bytes, of which the last four are a CRC-32C."""
    from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import crc32c

    pages = [data[begin : begin + 1020] for begin in range(0, len(data) - 1023, 1024)]
    return b"".join(page + struct.pack(">I", crc32c(page)) for page in pages)


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


def sharing(scans: list[Any]) -> dict[str, Target]:
    from gmmtorch.team.sharing import Replica, decode

    built, replica = gt.GaussianMap(), Replica(1)
    for scan in scans:
        built.insert(scan)
    built.finish()
    replica.add(built.components())
    packets = replica.datagrams(1_200)

    def receive(path: Path) -> None:
        data = path.read_bytes()
        decode(data)
        Replica(2).receive(data)

    return {"datagrams": Target({f"{i}.packet": one for i, one in enumerate(packets[:20])}, receive)}


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


# -- changes -----------------------------------------------------------------------------------------


def changed(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """A sound input with one to four changes."""
    found = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        at = rng.randrange(len(found)) if found else 0
        kind = rng.randrange(9)
        if kind == 0 and found:
            found[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            form = rng.choice("BHIQ")
            size = struct.calcsize(form)
            number = (rng.choice(SIZES) + rng.choice((-1, 0, 0, 1))) % (1 << 8 * size)
            found[at : at + size] = struct.pack(rng.choice("<>") + form, number)
        elif kind == 2:
            del found[at : at + rng.choice((1, 2, 4, 8, 100, 5000))]
        elif kind == 3:
            end = at + rng.choice((1, 4, 8, 64, 1000))
            found[at:at] = found[at:end] * rng.choice((1, 1, 2, 50))
        elif kind == 4:
            del found[at:]
        elif kind == 5:
            other = rng.choice(others)
            begin = rng.randrange(len(other)) if other else 0
            found[at : at + rng.choice((4, 64, 1000))] = other[begin : begin + rng.choice((4, 64, 1000))]
        elif kind == 6:
            words = list(re.finditer(rb"[A-Za-z0-9_./+-]{1,40}", found[max(0, at - 200) : at + 200]))
            if words:
                word, start = rng.choice(words), max(0, at - 200)
                found[start + word.start() : start + word.end()] = rng.choice(HOSTILE)
        elif kind == 7:
            found[at : at + rng.choice((8, 100, 4096))] = rng.randbytes(rng.choice((8, 100, 4096)))
        else:
            found[at : at + rng.choice((4, 8))] = struct.pack(
                rng.choice(("<f", "<d")),
                rng.choice((float("nan"), float("inf"), -1e308 * 10, 1e38, -0.0, 1e-40)),
            )
    return bytes(found[: 4 << 20])


# -- runs --------------------------------------------------------------------------------------------


class TooLongError(Exception):
    """A reader took more than its seconds."""


def child(target: Target, seed: int, n: int, place: Path, to: int) -> None:
    """Feeds n inputs; writes a line for each to a pipe."""
    rng = random.Random(seed)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def stop(*_: object) -> None:
        raise TooLongError

    signal.signal(signal.SIGALRM, stop)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    before = set(place.iterdir())
    for _ in range(n):
        name = rng.choice(list(target.seeds))
        data = changed(target.seeds[name], list(target.seeds.values()), rng)
        if target.mend is not None and rng.random() < 0.7:
            data = target.mend(data)
        path = place / name
        path.write_bytes(data)
        signal.alarm(SECONDS)
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
            signal.alarm(0)
        if outcome.startswith("fault"):
            shutil.copy(path, place / f"fault-{zlib.crc32(data):08x}-{name}")
        path.unlink()
        extra = [one.name for one in set(place.iterdir()) - before if not one.name.startswith("fault-")]
        if extra:
            outcome = f"fault: files were written: {extra[:3]}"
        os.write(to, (json.dumps(outcome) + "\n").encode())
    os._exit(0)


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
    folder = options.folder or Path(tempfile.mkdtemp(prefix="fuzz"))
    (folder / "seeds").mkdir(parents=True, exist_ok=True)
    chosen = targets(folder / "seeds")
    if options.targets:
        names = options.targets.split(",")
        if unknown := set(names) - chosen.keys():
            parser.error(f"no targets {', '.join(sorted(unknown))}; there are {', '.join(chosen)}")
        chosen = {name: chosen[name] for name in names}
    counts = {name: collections.Counter[str]() for name in chosen}
    seconds = collections.Counter[str]()
    end = time.monotonic() + 60 * (options.minutes or 1e9)
    seed = options.seed * 1_000_000
    n_inputs = options.inputs or (10**12 if options.minutes else 20_000)
    while sum(map(collections.Counter.total, counts.values())) < n_inputs and time.monotonic() < end:
        for name, target in chosen.items():
            place = folder / name.replace(" ", "_")
            place.mkdir(exist_ok=True)
            seed += 1
            start = time.monotonic()
            size = min(BATCH, max(20, n_inputs // len(chosen)))
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
