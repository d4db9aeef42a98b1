"""Each remedy that an error of a recording's reader names is applied to the input that caused the error."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import scan_files
from test_depth_cameras import OWN, camera, recorded
from test_rosbag import POINTS, drive

from gmmtorch.datasets import load
from gmmtorch.errors import GmmTorchError, text_of

pytest.importorskip("rosbags")

from sensor_bags import BagWriter, moved

from gmmtorch.export.bag import cloud_fields

TIMES = (0.0, 1.0, 2.0)
TRAJECTORY = "".join(f"{time} {time} 0 0 0 0 0 1\n" for time in TIMES)


class Case(NamedTuple):
    """write: makes the input in a folder and returns its path. wrong: options of the first attempt.
    values: of options that the error names without a literal value."""

    write: Callable[[Path], Path]
    wrong: dict[str, Any] = {}  # noqa: RUF012
    values: dict[str, Any] = {}  # noqa: RUF012


def bag(
    *edges: tuple[str, str],
    frames: tuple[str, ...] = ("lidar", "lidar"),
    static: tuple[tuple[str, str], ...] = (),
    odometry: bool = True,
    times: tuple[float, ...] = TIMES,
    late: float = 0.0,
) -> Callable[[Path], Path]:
    """A bag with clouds of some frames, odometry of a base, and transforms.

    late: seconds of the sensor's clock after that of the poses.
    """

    def write(folder: Path) -> Path:
        with BagWriter(folder / "a.mcap") as to:
            for edge in static:
                to.transforms(0.0, {edge: np.eye(4)}, static=True)
            for time in times:
                for edge in edges:
                    to.transforms(time, {edge: moved(time)})
                if odometry:
                    to.odometry("/odom", time, "world", "base", moved(time))
            for i, frame in enumerate(frames):
                fields = np.array([tuple(row) for row in POINTS], [(axis, "<f4") for axis in "xyz"])
                name, time = "sensor_msgs/msg/PointCloud2", 0.5 + i
                to.message("/points", name, time + late, cloud_fields(frame, fields), received=time)
        return folder / "a.mcap"

    return write


def two_topics(kind: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        with BagWriter(folder / "a.mcap") as to:
            drive(to)
            to.message("/text", "std_msgs/msg/String", 0.0, {"data": "hello"})
            for topic in ("/a", "/b"):
                to.cloud(topic, 0.5, "lidar", POINTS)
            if kind == "two types":
                to.laser("/a", 0.5, "lidar", [1.0], 0.0, 0.1, 8.0)
            for topic in ("/imu", "/imu2"):
                to.message(topic, "sensor_msgs/msg/Imu", 0.5, {"header": {"frame_id": "lidar"}})
        return folder / "a.mcap"

    return write


def depth_bag(*infos: dict[str, Any]) -> Callable[[Path], Path]:
    return lambda folder: recorded(folder / "a.mcap", *infos, topic="/camera/depth/image_raw")


def two_infos(folder: Path) -> Path:
    with BagWriter(folder / "a.mcap") as to:
        drive(to)
        for name in ("left", "right"):
            to.message(f"/{name}/camera_info", "sensor_msgs/msg/CameraInfo", 0.5, camera())
        to.depth(
            "/depth",
            0.5,
            "lidar",
            np.full((48, 64), 1000),
            [[50, 0, 32], [0, 50, 24], [0, 0, 1]],
        )
    return folder / "a.mcap"


def folder_of(*names: str, metadata: str | None = None) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        path = bag(("odom", "lidar"))(folder)
        (folder / "bag").mkdir()
        for name in names:
            (folder / "bag" / name).write_bytes(path.read_bytes())
        if metadata is not None:
            (folder / "bag" / "metadata.yaml").write_text(metadata)
        return folder / "bag"

    return write


CASES = {
    "several topics": Case(two_topics("")),
    "no such topic": Case(two_topics(""), {"topic": "/c"}, {"topic": "/a"}),
    "not a sensor": Case(two_topics(""), {"topic": "/text"}, {"topic": "/a"}),
    "two types": Case(two_topics("two types"), {"topic": "/a"}, {"topic": "/b"}),
    "no TF": Case(bag()),
    "no TF, no odometry": Case(bag(odometry=False), {}, {"TOPIC": None}),
    "no such poses": Case(bag(("odom", "lidar")), {"poses": "none"}),
    "not poses": Case(bag(("odom", "lidar")), {"poses": "/points"}),
    "only static": Case(bag(static=(("mast", "lidar"),)), {}, {"NAME": None}),
    "only static, unnamed": Case(bag(static=(("mast", "lidar"),), frames=("", "")), {}, {"NAME": "lidar"}),
    "robots in a fixed frame": Case(
        bag(("map", "base"), ("map", "base2"), frames=("map",)), {}, {"NAME": "base"}
    ),
    "unnamed frame": Case(bag(("odom", "base"), frames=("", "")), {}, {"NAME": "base"}),
    "unnamed frame, wrong name": Case(
        bag(("odom", "base"), frames=("", "")), {"sensor_frame": "x"}, {"NAME": "base"}
    ),
    "unknown frame": Case(bag(("odom", "base")), {}, {"NAME": "base"}),
    "unknown frame beside another": Case(bag(("odom", "base"), frames=("base", "lidar"))),
    "a frame that no message has": Case(bag(("odom", "base"), ("base", "lidar")), {"sensor_frame": "base"}),
    "two frames": Case(bag(frames=("lidar", "rear", "rear")), {"poses": "standing"}),
    "two frames, one unnamed": Case(bag(frames=("", "rear", "")), {"poses": "standing"}),
    "no mount": Case(bag(("odom", "lidar")), {"poses": "/odom"}),
    "no mount of an unnamed frame": Case(bag(frames=("", "")), {"poses": "/odom"}),
    "not connected": Case(bag(("odom", "lidar"), ("map", "base")), {"frame": "map"}),
    "two parents": Case(bag(("odom", "lidar"), ("map", "lidar"))),
    "loop": Case(bag(("a", "lidar"), ("lidar", "a"))),
    "another clock": Case(bag(("odom", "lidar"), late=5000.0), {}, {"max_gap": None}),
    "rare poses": Case(bag(("odom", "lidar"), times=(0.0, 9.0)), {}, {"max_gap": 10.0, "received": None}),
    "registered": Case(
        bag(("map", "base"), frames=("map", "map")), {"poses": "FILE"}
    ),
    "two cameras": Case(two_infos),
    "no camera": Case(depth_bag()),
    "another size": Case(depth_bag(camera(width=99))),
    "unknown lens": Case(depth_bag(camera(d=np.ones(4), distortion_model="odd"))),
    "changing camera": Case(depth_bag(camera(), camera(binning_x=2))),
}  # fmt: skip


def remedies(message: str, case: Case, options: dict[str, Any], folder: Path) -> list[dict[str, Any]]:
    """The options that an error names, with their values."""
    known = {
        "TOPIC": "/odom",
        "FILE": str(folder / "t.txt"),
        "NAME": "base",
        "[fx,fy,cx,cy]": OWN,
        "[x,y,z,qx,qy,qz,qw]": [0, 0, 0, 0, 0, 0, 1],
        **case.values,
    }
    message = message.replace(
        "‹poses›=TOPIC, FILE or standing",
        "‹poses›=TOPIC ‹poses›=FILE ‹poses›=standing",
    )
    found = re.findall(r"‹(\w+)›(?:=(\[[\w,/]*\]|[\w/.-]*[\w/]))?", message)
    named = [(name, known.get(value or name, value)) for name, value in found]
    named = [(n, v[1:-1].split(",") if str(v).startswith("[/") else v) for n, v in named]
    return [
        {name: value} for name, value in named if value is not None and str(options.get(name)) != str(value)
    ]


def check(case: Case, path: Path, options: dict[str, Any], folder: Path, depth: int = 0) -> bool:
    """Follows the remedies of errors, at most three in turn, to scans. Returns whether there was none."""
    try:
        scans, error = list(load("rosbag", path, **options)), None
    except GmmTorchError as caught:
        scans, error = [], caught
    if error is None:
        assert any(len(scan.points) for scan in scans)
        return True
    found = remedies(text_of(error), case, options, folder)
    assert found, f"no remedy in: {error}"
    assert depth < 3, f"the remedies of {options} lead to: {error}"
    for remedy in found:
        check(case, path, {**options, **remedy}, folder, depth + 1)
    return False


@pytest.mark.parametrize("name", CASES)
def test_each_remedy_works_for_the_input_that_caused_the_error(tmp_path, name):
    case = CASES[name]
    (tmp_path / "t.txt").write_text(TRAJECTORY)
    assert not check(
        case,
        case.write(tmp_path),
        {n: str(tmp_path / "t.txt") if v == "FILE" else v for n, v in case.wrong.items()},
        tmp_path,
    )


SCANNED = """rosbag2_bagfile_information:
  version: {version}
  storage_identifier: {storage}
  relative_file_paths: [{files}]
  duration: {{nanoseconds: 1}}
  starting_time: {{nanoseconds_since_epoch: 0}}
  message_count: 0
  topics_with_message_count: []
"""


def metadata(storage: str = "mcap", files: str = "a 0.mcap", version: int = 9) -> str:
    return SCANNED.format(storage=storage, files=files, version=version)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "a: 1",
        metadata('""'),
        metadata("sqlite3"),
        metadata("mcap"),
        metadata(version=12),
        metadata(files=""),
    ],
)
@pytest.mark.parametrize("name", ["a 0.mcap", "a 0.db3"])
def test_the_only_file_of_a_bag_is_read_by_its_own_magic(tmp_path, text, name):
    """The content is that of MCAP."""
    text = text.replace("a 0.mcap", name)
    dataset = load("rosbag", folder_of(name, metadata=text)(tmp_path))
    assert [len(scan.points) for scan in dataset] == [2, 2]


def test_a_folder_with_several_files_asks_for_one(tmp_path):
    path = folder_of("a 0.mcap", "a 1.mcap")(tmp_path)
    with pytest.raises(GmmTorchError, match=r"give one file: a 0\.mcap, a 1\.mcap"):
        load("rosbag", path)
    assert len(load("rosbag", path / "a 0.mcap")) == 2


@pytest.mark.parametrize("files", ["a 0.mcap, a 1.mcap", "a 1.mcap"])
def test_a_bag_that_misses_a_file_says_so(tmp_path, caplog, files):
    path = folder_of("a 0.mcap", metadata=metadata(files=files))(tmp_path)
    assert len(load("rosbag", path)) == 2
    assert "nothing can be read of a 1.mcap" in caplog.text


def test_remedies_of_kitti_are_applied(tmp_path):
    """The calibration of poses of the Velodyne, and times for a trajectory with times."""
    (tmp_path / "velodyne").mkdir()
    np.ones((4, 4), "<f4").tofile(tmp_path / "velodyne" / "0.bin")
    (tmp_path / "poses.txt").write_text(scan_files.kitti(np.eye(3), [1.0, 0.0, 0.0]))
    with pytest.raises(GmmTorchError, match=r"write the line '(.*)'") as caught:
        load("kitti", tmp_path)
    line = re.search(r"write the line '(.*)'", str(caught.value))
    (tmp_path / "calib.txt").write_text(f"{line[1]}\n")
    assert load("kitti", tmp_path)[0].origin.tolist() == [1, 0, 0]
    (tmp_path / "t.txt").write_text(TRAJECTORY)
    with pytest.raises(GmmTorchError, match=r"times\.txt is missing"):
        load("kitti", tmp_path, poses=str(tmp_path / "t.txt"))
    (tmp_path / "times.txt").write_text("0.5\n")
    assert load("kitti", tmp_path, poses=str(tmp_path / "t.txt"))[0].origin.tolist() == [0.5, 0, 0]
