"""dataset=nuscenes: scenes in tables by the published schema, with every kind of damage."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gmmtorch.datasets import load
from gmmtorch.datasets import scan_folders as folders
from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, MissingDataError

N_SWEEPS = 6  # of which every third is a key frame
RNG = np.random.default_rng(0)


def quaternion(rotation: Rotation) -> list[float]:
    """w, x, y, z."""
    x, y, z, w = rotation.as_quat()
    return [w, x, y, z]


def write(
    folder: Path, scenes: tuple[str, ...] = ("scene-0061", "scene-0103")
) -> dict[str, list[np.ndarray]]:
    """A data set with two scenes; returns the points of each sweep in the world (docs/schema_nuscenes.md)."""
    tables: dict[str, list[dict[str, Any]]] = {
        name: [] for name in ("scene", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor")
    }
    mount = Rotation.from_euler("zyx", [-90, 2, 1], degrees=True), np.array([0.9, 0.0, 1.8])
    for channel, modality in (("LIDAR_TOP", "lidar"), ("CAM_FRONT", "camera"), ("RADAR_FRONT", "radar")):
        tables["sensor"].append({"token": f"s{channel}", "channel": channel, "modality": modality})
        tables["calibrated_sensor"].append(
            {
                "token": f"c{channel}",
                "sensor_token": f"s{channel}",
                "translation": mount[1].tolist(),
                "rotation": quaternion(mount[0]),
                "camera_intrinsic": [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]] if modality == "camera" else [],
            }
        )
    expected: dict[str, list[np.ndarray]] = {}
    for number, scene in enumerate(scenes):
        tables["scene"].append({"token": f"t{scene}", "name": scene, "description": "Rain, 'turn'"})
        expected[scene] = []
        for k in range(N_SWEEPS):
            is_key = k % 3 == 0
            sample = f"{scene}-sample{k // 3}"
            if is_key:
                tables["sample"].append({"token": sample, "timestamp": k, "scene_token": f"t{scene}"})
            ego = Rotation.from_euler("z", 10.0 * k, degrees=True), np.array([600.0 + k, 1600.0 + number, 0])
            points = np.column_stack(
                [RNG.normal(size=(9, 3)) * 10, RNG.integers(0, 256, 9), np.arange(9)]
            ).astype("<f4")
            points[0, :3], points[1, 0] = 0, np.nan
            for channel, suffix in (("LIDAR_TOP", "pcd.bin"), ("CAM_FRONT", "jpg"), ("RADAR_FRONT", "pcd")):
                token = f"{scene}-{channel}-{k}"
                place = "samples" if is_key else "sweeps"
                name = f"{place}/{channel}/n015__{channel}__{scene}-{k}.{suffix}"
                tables["ego_pose"].append(
                    {"token": token, "timestamp": k, "rotation": quaternion(ego[0])}
                    | {"translation": ego[1].tolist()}
                )
                tables["sample_data"].append(
                    {"token": token, "sample_token": sample, "ego_pose_token": token}
                    | {"calibrated_sensor_token": f"c{channel}", "timestamp": 1532402927647951 + 50_000 * k}
                    | {"fileformat": suffix.split(".")[0], "is_key_frame": is_key, "filename": name}
                )
                if channel == "LIDAR_TOP":
                    (folder / name).parent.mkdir(parents=True, exist_ok=True)
                    points.tofile(folder / name)
            in_car = mount[0].apply(points[2:, :3].astype(float)) + mount[1]
            expected[scene].append(np.column_stack([ego[0].apply(in_car) + ego[1], points[2:, 3]]))
    RNG.shuffle(tables["sample_data"])
    (folder / "v1.0-mini").mkdir()
    for name, rows in tables.items():
        (folder / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows, indent=0))
    return expected


def test_sweeps_of_a_scene_are_in_the_frame_of_the_map(tmp_path):
    expected = write(tmp_path)
    for path in (tmp_path, tmp_path / "v1.0-mini"):
        found = load("nuscenes", path, scene="scene-0103", attributes=["intensity"])
        assert (found.name, len(found)) == ("scene-0103", N_SWEEPS)
        np.testing.assert_allclose(found.times - 1532402927.647951, 0.05 * np.arange(N_SWEEPS), atol=1e-6)
        for k, scan in enumerate(found):
            np.testing.assert_allclose(scan.points, expected["scene-0103"][k][:, :3], atol=1e-5)
            np.testing.assert_array_equal(
                scan.attributes["intensity"].flatten(), expected["scene-0103"][k][:, 3]
            )
            np.testing.assert_allclose(found.pose(k)[:3, 3], scan.origin, atol=1e-9)
    assert not found.skipped


def test_records_across_blocks_are_read(tmp_path, monkeypatch):
    expected = write(tmp_path)
    monkeypatch.setattr(folders, "_BLOCK_BYTES", 700)
    found = load("nuscenes", tmp_path, scene="scene-0061")
    np.testing.assert_allclose(found[5].points, expected["scene-0061"][5][:, :3], atol=1e-5)


def test_key_frames_alone_are_read(tmp_path):
    write(tmp_path, ("scene-0061",))
    for file in (tmp_path / "sweeps" / "LIDAR_TOP").iterdir():
        file.unlink()
    found = load("nuscenes", tmp_path)
    assert len(found) == 2
    assert found.skipped == {"its file is missing": 4}


def test_a_scene_must_be_chosen(tmp_path):
    write(tmp_path)
    for scene in (None, "scene-1"):
        with pytest.raises(InvalidArgumentError, match="scenes are scene-0061, scene-0103"):
            load("nuscenes", tmp_path, scene=scene)
    with pytest.raises(InvalidArgumentError, match="have intensity"):
        load("nuscenes", tmp_path, scene="scene-0061", attributes=["colour"])
    with pytest.raises(MissingDataError):
        load("nuscenes", tmp_path / "none")
    with pytest.raises(DataError, match="are none"):
        load("nuscenes", tmp_path / "samples")


def changed(folder: Path, table: str, before: str, after: str) -> None:
    path = folder / "v1.0-mini" / f"{table}.json"
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))


@pytest.mark.parametrize(
    ("table", "before", "after"),
    [
        ("sample_data", "samples/LIDAR_TOP", "../LIDAR_TOP"),
        ("sample_data", "samples/LIDAR_TOP", "/etc/LIDAR_TOP"),
        ("sample_data", '"timestamp": 1', '"timestamp": -1'),
        ("sample_data", '"timestamp": 1', '"timestamp": 1e999, "x": 1'),
        ("sample_data", '"timestamp": 1', '"timestamp": ' + "9" * 5000 + ', "x": 1'),
        ("sample_data", '"ego_pose_token": "', '"ego_pose_token": 3, "y": "'),
        ("sample_data", '"sample_token"', '"sample_token'),
        ("ego_pose", '"rotation": [', '"rotation": [0, '),
        ("ego_pose", '"token"', '"other"'),
        ("ego_pose", '"rotation": [', '"rotation": [0, 0, 0, 0, '),
        ("ego_pose", "60", "NaN"),
        ("ego_pose", '"translation": [', '"translation": [' + "9" * 400 + ", "),
        ("calibrated_sensor", '"rotation": [', '"rotation": "'),
        ("calibrated_sensor", "0.9", "1e999"),
        ("scene", '"token"', '"other"'),
    ],
)
def test_damaged_tables_are_refused(tmp_path, table, before, after):
    write(tmp_path, ("scene-0061",))
    changed(tmp_path, table, before, after)
    with pytest.raises(GmmTorchError, match=r"sample|pose|calibrated|scene"):
        load("nuscenes", tmp_path)


def test_a_record_that_is_not_closed_is_left_out(tmp_path):
    write(tmp_path, ("scene-0061",))
    changed(tmp_path, "sample", "{", "{{")
    assert len(load("nuscenes", tmp_path)) == N_SWEEPS


def test_cut_files_are_refused(tmp_path):
    write(tmp_path, ("scene-0061",))
    file = next((tmp_path / "samples" / "LIDAR_TOP").iterdir())
    file.write_bytes(file.read_bytes()[:-3])
    with pytest.raises(DataError, match="truncated"):
        list(load("nuscenes", tmp_path))
    (tmp_path / "v1.0-mini" / "sample.json").unlink()
    with pytest.raises(DataError, match=r"sample\.json is missing"):
        load("nuscenes", tmp_path)


@pytest.mark.parametrize("filling", [b"{", b"}", b"[[[{", b'{"token": "', b"{" + b" " * 30 + b"}"])
def test_tables_without_records_take_bounded_memory(tmp_path, filling):
    write(tmp_path, ("scene-0061",))
    (tmp_path / "v1.0-mini" / "ego_pose.json").write_bytes(filling * ((9 << 20) // len(filling)))
    tracemalloc.start()
    with pytest.raises(DataError, match="ego_pose"):
        load("nuscenes", tmp_path)
    assert tracemalloc.get_traced_memory()[1] < 25e6
    tracemalloc.stop()
