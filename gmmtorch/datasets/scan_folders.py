"""Folders of point clouds with their sensor poses, also those of the KITTI odometry benchmark.

`ScanFolder` has `scans/*.pcd` (or `*.ply`) in the sensor frame, and `poses.txt` with one KITTI row per scan:
12 numbers, the upper 3×4 part of world ← sensor, row by row; metres. `PcdViewpoint` has PCD files with points
in the world frame and the sensor origin in VIEWPOINT.

`Kitti` has `velodyne/*.bin`, float32 x, y, z, reflectance; optional `labels/*.label` of SemanticKITTI;
`poses.txt` with a row of the left camera for each scan;
`calib.txt` with the row `Tr`, camera ← Velodyne; and, optional, `times.txt` in seconds.

`NuScenes` has tables in JSON, which state scenes, poses and the names of `*.pcd.bin` files, float32 x, y, z,
intensity, ring.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.base import (
    NO_POSE,
    Dataset,
    Ranges,
    check_poses,
    natural_key,
    number_rows,
    require_path,
)
from gmmtorch.datasets.point_files.channels import CLASS, check_channels, read_channels
from gmmtorch.datasets.point_files.pcd_files import pcd_header
from gmmtorch.datasets.point_files.point_chunks import read_cloud
from gmmtorch.datasets.trajectory import Trajectory, kitti_poses, read_rows, read_trajectory, to_nanoseconds
from gmmtorch.errors import DAMAGED_CONTENT, DataError, InvalidArgumentError
from gmmtorch.pose import Pose
from gmmtorch.scan import INTENSITY, Scan


class ScanFolder(Dataset):
    """Scans in the natural order of their file names (scan_2 before scan_10).

    Points at or beyond `max_range` have no return. NaN, infinite points and points at the sensor origin are
    invalid and dropped; scans with infinite points, or NaN in a PLY file, are counted. With `standing`,
    poses.txt is not read, and every scan is in the frame of the sensor.
    """

    _poses: Tensor

    def __init__(
        self,
        path: str | Path,
        ranges: Ranges,
        stride: int = 1,
        standing: bool = False,
        attributes: Iterable[str] = (),
    ) -> None:
        self.attributes = check_channels(attributes)
        path = require_path(
            path,
            "folder",
            "scans/*.pcd or scans/*.ply in the sensor frame, and poses.txt (12 numbers per row)",
            "KITTI odometry, MulRan and most lidar SLAM systems export this layout.",
        )
        super().__init__(path.name, ranges, stride)
        scans = path / "scans"
        self._files = sorted([*scans.glob("*.pcd"), *scans.glob("*.ply")], key=natural_key)
        if not self._files:
            raise DataError(f"{scans} contains no .pcd and no .ply file; put one file per scan there.")
        if standing:
            self._poses = Pose.identity(3, len(self._files)).matrix
            return
        self._poses = _read_poses(path / "poses.txt")
        if len(self._poses) != len(self._files):
            raise DataError(
                f"{path}: poses.txt has {len(self._poses)} rows, but there are {len(self._files)} scans; "
                "write one pose for each scan, in the order of the file names."
            )

    def _read(self, index: int) -> Scan:
        points = read_cloud(self._files[index])
        usual = torch.isfinite(points)
        if self._files[index].suffix == ".pcd":
            usual |= points.isnan()  # a beam without return
        if not bool(usual.all()):
            self._skip("points dropped: their coordinates are not finite", index)
        channels = read_channels(self._files[index], self.attributes) if self.attributes else {}
        self._note_missing(channels, index)
        return self.ranges.posed(points, self._poses[index], channels)


def _read_poses(path: Path) -> Tensor:
    """Poses (S, 4, 4) of a file of KITTI rows."""
    if not path.is_file():
        raise DataError(
            f"{path} is missing; write one row of 12 numbers (world ← sensor) for each scan, or "
            "estimate the poses with ‹odometry›=auto."
        )
    rows = read_rows(path)
    if rows.shape[1] != 12:
        raise DataError(f"{path} has {rows.shape[1]} numbers per row; a KITTI pose has 12.")
    return kitti_poses(path, rows).matrix


class PcdViewpoint(Dataset):
    """Scans in the natural order of their file names (scan_2 before scan_10).

    Points at or beyond `max_range` from the viewpoint have no return. NaN, infinite points and points at the
    sensor origin are invalid and dropped. The orientation in VIEWPOINT is not used.
    """

    def __init__(
        self, path: str | Path, ranges: Ranges, stride: int = 1, attributes: Iterable[str] = ()
    ) -> None:
        self.attributes = check_channels(attributes)
        path = require_path(
            path,
            "folder",
            "*.pcd in the world frame, the sensor position in VIEWPOINT",
            "The la3dm project publishes its simulated lidar scans this way.",
        )
        super().__init__(path.name, ranges, stride)
        self._files = sorted(path.glob("*.pcd"), key=natural_key)
        if not self._files:
            raise DataError(f"{path} contains no .pcd file.")

    def _known_pose(self, index: int) -> Tensor:
        """The position in VIEWPOINT with the rotation of the world frame."""
        return Pose.from_yaw(0.0, _viewpoint(self._files[index])).matrix

    def _read(self, index: int) -> Scan:
        path = self._files[index]
        channels = read_channels(path, self.attributes) if self.attributes else {}
        self._note_missing(channels, index)
        return self.ranges.scan(read_cloud(path), _viewpoint(path), None, channels)


def _viewpoint(path: Path) -> Tensor:
    """The sensor position (3,) in the header of a PCD file."""
    words = pcd_header(path).get("VIEWPOINT", [])
    if len(words) not in (3, 7):
        raise DataError(
            f"{path}: VIEWPOINT {' '.join(words)} has {len(words)} numbers; it needs a position and a "
            "quaternion, 7 numbers."
        )
    origin = torch.from_numpy(number_rows([" ".join(words)], len(words), f"{path}: VIEWPOINT")[0, :3])
    if not bool(torch.isfinite(origin).all()):
        raise DataError(f"{path}: VIEWPOINT {' '.join(words)} does not begin with a sensor position.")
    return origin


_CALIBRATION = "Tr: 1 0 0 0 0 1 0 0 0 0 1 0"


class _BinaryClouds(Dataset):
    """Scans in files of float32: x, y, z and intensity, and further numbers up to `_width`."""

    _poses: Tensor
    _width = 4

    def _read(self, index: int) -> Scan:
        """The scan of the points that are finite and not at the sensor."""
        path = self._files[index]
        if path.stat().st_size % (4 * self._width):
            raise DataError(
                f"{path} is not a whole number of points of {4 * self._width} bytes; it is truncated."
            )
        table = np.fromfile(path, "<f4").reshape(-1, self._width)
        points = torch.from_numpy(table[:, :3].astype(np.float64))
        valid = points.isfinite().all(1) & (points != 0).any(1)
        channels = {name: values[valid] for name, values in self._channels(path, table).items()}
        return self.ranges.posed(points[valid], self._poses[index], channels)

    def _channels(self, path: Path, table: np.ndarray) -> dict[str, Tensor]:
        intensity = torch.from_numpy(np.where(np.isfinite(table[:, 3]), table[:, 3], np.nan))
        return {INTENSITY: intensity} if INTENSITY in self.attributes else {}


class Kitti(_BinaryClouds):
    """Scans of one sequence in the natural order of their file names.

    The world frame is that of the Velodyne at the origin of the poses: x forward, z up. The clouds of the
    benchmark are deskewed already.

    Poses are also found where the benchmark has them, in `../../poses/NN.txt`. Others are KITTI rows of the
    camera as in poses.txt, or TUM rows of the Velodyne, which need times.txt. Channels are "intensity", the
    reflectance, and "class", the label of SemanticKITTI (the lower 16 bits; 0, unlabeled, is unknown).
    """

    def __init__(
        self,
        path: str | Path,
        ranges: Ranges,
        stride: int = 1,
        poses: str | None = None,
        max_gap: float = 2.0,
        attributes: Iterable[str] = (),
    ) -> None:
        self.attributes = check_channels(
            attributes, [INTENSITY, CLASS], "scans of KITTI have intensity and class"
        )
        path = require_path(
            path,
            "folder",
            "velodyne/*.bin, poses.txt and calib.txt",
            "The KITTI odometry benchmark and SemanticKITTI publish sequences in this layout.",
        )
        super().__init__(path.resolve().name, ranges, stride)
        files = sorted((path / "velodyne").glob("*.bin"), key=natural_key)
        if not files:
            raise DataError(f"{path / 'velodyne'} contains no .bin file; put one file per scan there.")
        times = read_rows(path / "times.txt")[:, 0] if (path / "times.txt").is_file() else None
        if times is not None and len(times) < len(files):
            raise DataError(f"{path / 'times.txt'} has {len(times)} rows for {len(files)} scans.")
        trajectory = read_trajectory(poses or _poses_file(path))
        if poses is not None and trajectory.has_times:
            if times is None:
                raise DataError(
                    f"{path / 'times.txt'} is missing; the trajectory {poses} needs times of scans."
                )
            found, known = trajectory.at(to_nanoseconds(times[: len(files)]), max_gap)
        else:
            found, known = _of_lidar(path, trajectory, len(files)), np.ones(len(files), bool)
        if not known.any() and times is not None:
            raise DataError(
                f"{path}: no scan has a pose. Scans are from {times[0]:.3f} to {times[-1]:.3f} s, poses from "
                f"{trajectory.times[0] / 1e9:.3f} to {trajectory.times[-1] / 1e9:.3f} s."
            )
        self._skip(NO_POSE, *np.flatnonzero(~known).tolist())
        self._files = [file for file, is_known in zip(files, known, strict=True) if is_known]
        self._poses = found[known].matrix
        self._times = None if times is None else torch.from_numpy(times[: len(files)][known])

    def _channels(self, path: Path, table: np.ndarray) -> dict[str, Tensor]:
        channels = super()._channels(path, table)
        if CLASS in self.attributes:
            channels[CLASS] = torch.from_numpy(_kitti_labels(path, len(table)))
        return channels


def _kitti_labels(scan: Path, n_points: int) -> np.ndarray:
    """The labels (N,) of a scan of SemanticKITTI, −1 where unlabeled."""
    path = scan.parent.parent / "labels" / f"{scan.stem}.label"
    if not path.is_file():
        raise DataError(f"{path} is missing; SemanticKITTI publishes the labels of each scan there.")
    if path.stat().st_size != 4 * n_points:
        raise DataError(
            f"{path} has {path.stat().st_size:,} bytes, not 4 for each of {n_points:,} points; it is damaged,"
            " or of another scan."
        )
    labels = np.fromfile(path, "<u4").astype(np.int64) & 0xFFFF
    return np.where(labels == 0, -1, labels)


def _poses_file(path: Path) -> Path:
    beside = path.resolve().parent.parent / "poses" / f"{path.resolve().name}.txt"
    return beside if beside.is_file() and not (path / "poses.txt").is_file() else path / "poses.txt"


def _of_lidar(path: Path, trajectory: Trajectory, n_scans: int) -> Pose:
    """Poses (N) of the Velodyne, Tr⁻¹ P Tr, from those of the camera."""
    if len(trajectory) < n_scans:
        raise DataError(
            f"{path} has {n_scans} scans, but only {len(trajectory)} poses; write one row for each scan."
        )
    mount = _calibration(path / "calib.txt")
    return mount.inverse() @ trajectory.poses[:n_scans] @ mount


def _calibration(path: Path) -> Pose:
    """camera ← Velodyne, the row Tr of calib.txt."""
    if not path.is_file():
        raise DataError(
            f"{path} is missing; it states the Velodyne's pose on the camera. If poses.txt has poses of the "
            f"Velodyne, write the line '{_CALIBRATION}'."
        )
    for line in path.read_text("utf-8", errors="replace").splitlines():
        name, _, numbers = line.partition(":")
        if name.strip() in ("Tr", "Tr_velo_cam", "Tr_velo_to_cam"):
            try:
                rows = np.array([float(word) for word in numbers.split()]).reshape(3, 4)
            except ValueError as error:
                raise DataError(f"{path}: the row {name} is not 12 numbers ({error}).") from error
            matrix = np.vstack([rows, [0, 0, 0, 1]])
            return Pose.from_matrix(check_poses(torch.from_numpy(matrix), f"{path}, row {name}"))
    raise DataError(
        f"{path} has no row Tr (camera ← Velodyne); a calibration without rotation: '{_CALIBRATION}'."
    )


_BLOCK_BYTES, _MOST_RECORDS = 1 << 22, 1 << 16
_RECORD = re.compile(rb"\{[^{}]*\}")
_TOKEN = re.compile(rb'"token"\s*:\s*"([^"]{1,80})"')
_LIDAR_FILE, _TOP = b".pcd.bin", "LIDAR_TOP"


class NuScenes(_BinaryClouds):
    """The sweeps of the lidar in one scene of nuScenes, at 20 a second, in the order of their times.

    The world frame is that of the map of the city. Sweeps are compensated for motion already. Those whose
    file is missing are left out and counted: if only the key frames were fetched, they are read.

    The folder has `samples/`, `sweeps/` and the tables in `v1.0-mini/`, or is that of the tables. scene: its
    name, as in "scene-0061"; None: the only one. The channel is "intensity".
    """

    _width = 5

    def __init__(
        self,
        path: str | Path,
        ranges: Ranges,
        stride: int = 1,
        scene: str | None = None,
        attributes: Iterable[str] = (),
    ) -> None:
        self.attributes = check_channels(attributes, [INTENSITY], "scans of nuScenes have intensity")
        path = require_path(
            *(path, "folder", "v1.0-mini/*.json, samples/ and sweeps/", "nuscenes.org publishes this layout.")
        )
        tables = _tables(path)
        name, token = _scene(tables, scene)
        super().__init__(name, ranges, stride)
        samples = _records(tables / "sample.json", b'"%s"' % token.encode("latin-1"))
        stated = _sweeps(tables / "sample_data.json", samples)
        sweeps = [row for row in stated if (tables.parent / row["filename"]).is_file()]
        if not sweeps:
            raise DataError(
                f"{tables}: none of {len(stated)} sweeps in {name} has a file; fetch the lidar's."
            )
        self._skip("its file is missing", *range(len(stated) - len(sweeps)))
        self._files = [tables.parent / row["filename"] for row in sweeps]
        ego = _transforms(tables / "ego_pose.json", [row["ego_pose_token"] for row in sweeps])
        mounts = [row["calibrated_sensor_token"] for row in sweeps]
        mount = _transforms(tables / "calibrated_sensor.json", mounts)
        self._poses = (ego @ mount).matrix
        self._times = torch.tensor([row["timestamp"] / 1e6 for row in sweeps], dtype=torch.float64)


def _tables(path: Path) -> Path:
    """The folder with the tables."""
    found = sorted({file.parent for file in (*path.glob("scene.json"), *path.glob("*/scene.json"))})
    if len(found) != 1:
        names = ", ".join(map(str, found)) or "none"
        raise DataError(f"{path}: folders with scene.json and other tables are {names}; give one of them.")
    return found[0]


def _scene(tables: Path, wanted: str | None) -> tuple[str, str]:
    """Name and token of a scene."""
    records = _records(tables / "scene.json", b'"name"')
    scenes = {str(row.get("name")): token for token, row in records.items()}
    names = sorted(scenes)
    if wanted is None and len(names) == 1:
        wanted = names[0]
    if wanted is None or wanted not in scenes:
        shown = ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")
        raise InvalidArgumentError(
            f"‹scene›={wanted} is not a scene of {tables}, whose scenes are {shown or 'none'}; choose one."
        )
    return wanted, scenes[wanted]


def _sweeps(table: Path, samples: Collection[str]) -> list[dict[str, Any]]:
    """The records of the sweeps of one lidar that belong to samples, in the order of their times."""
    found = _records(table, _LIDAR_FILE, samples=samples).values()
    rows = [row for row in found if str(row.get("filename")).endswith(_LIDAR_FILE.decode())]
    for row in rows:
        file, time = PurePosixPath(str(row["filename"])), row.get("timestamp")
        is_inside = not file.is_absolute() and ".." not in file.parts and "\0" not in str(file)
        has_tokens = all(
            isinstance(row.get(name), str) for name in ("ego_pose_token", "calibrated_sensor_token")
        )
        if not (is_inside and has_tokens and isinstance(time, int) and 0 <= time < 1 << 62):
            raise DataError(f"{table}: the record {row.get('token')!r:.80} of a sweep is damaged.")
    lidars = {PurePosixPath(row["filename"]).parent.name for row in rows}
    if len(lidars) > 1 and _TOP not in lidars:
        raise DataError(f"{table} has several lidars, {', '.join(sorted(lidars))}, and none is {_TOP}.")
    chosen = _TOP if _TOP in lidars else next(iter(lidars), "")
    kept = [row for row in rows if PurePosixPath(row["filename"]).parent.name == chosen]
    return sorted(kept, key=lambda row: row["timestamp"])


def _transforms(table: Path, tokens: list[str]) -> Pose:
    """The rigid motions (N) of records with some tokens: translation in metres, quaternion w, x, y, z."""
    found = _records(table, b'"rotation"', set(tokens))
    try:
        rows = [found[token] for token in tokens]
        shifts = np.array([row["translation"] for row in rows], np.float64).reshape(len(rows), 3)
        turns = np.array([row["rotation"] for row in rows], np.float64).reshape(len(rows), 4)
        return Pose.from_quaternion(shifts, np.roll(turns, -1, 1))
    except DAMAGED_CONTENT as error:
        raise DataError(f"{table}: the pose of a sweep is missing or damaged ({error!s:.80}).") from error


def _records(
    table: Path, mark: bytes, tokens: Collection[str] | None = None, samples: Collection[str] | None = None
) -> dict[str, dict[str, Any]]:
    """The records of a table by their tokens: those that contain a mark, have one of some tokens, and are of
    one of some samples; None: any.

    The table is a list of flat JSON objects, of up to a gigabyte: it is read in blocks, and only records that
    are wanted are parsed. Raises `DataError`.
    """
    if not table.is_file():
        raise DataError(f"{table} is missing; fetch the metadata of nuScenes, which has it.")
    found, rest = dict[str, dict[str, Any]](), b""
    with table.open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            rest, end = rest + block, 0
            for match in _RECORD.finditer(rest):
                end, token = match.end(), _TOKEN.search(match[0])
                if token is None or mark not in match[0]:
                    continue
                name = token[1].decode("latin-1")
                if tokens is not None and name not in tokens:
                    continue
                try:
                    row = json.loads(match[0])
                except (ValueError, RecursionError) as error:
                    raise DataError(
                        f"{table}: a record is not JSON ({error!s:.80}); it is damaged."
                    ) from error
                if samples is None or row.get("sample_token") in samples:
                    found[name] = row
            rest = rest[end:]
            if len(rest) > _BLOCK_BYTES or len(found) > _MOST_RECORDS:
                raise DataError(
                    f"{table} is not a table of nuScenes, or has too many records; it is damaged."
                )
    return found
