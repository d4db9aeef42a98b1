"""gmmtorch-map inputs=[…]: recordings, their merged tiles, stops, failures and lost workers."""

from __future__ import annotations

import math
import os
import signal
import socket
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from command_runs import QUIET, Finished, refused, run_here, succeeded

from gmmtorch.cli import recordings as map_recordings
from gmmtorch.cli.recordings import find_recordings, run_tasks
from gmmtorch.cli.reporting import map_outputs
from gmmtorch.datasets import load
from gmmtorch.errors import MissingDataError
from gmmtorch.mapping import Components, GaussianMap, TiledMap
from gmmtorch.occupancy.calibrator import Calibration

Run = Callable[..., Finished]
OPTIONS = ["dataset=carmen", "map.window=3", "tile=4", *QUIET]
N_SCANS = 6


def write_log(path: Path, first: float) -> None:
    """A CARMEN log of a laser that moves along a room of 12 by 6 metres, from x = `first`."""
    lines = []
    for step in range(N_SCANS):
        x, y = first + 0.3 * step, 2.0 + 0.01 * step
        ranges = []
        for beam in range(180):
            angle = math.radians(beam - 90)
            along, across = math.cos(angle), math.sin(angle)
            walls = [((12 if along > 0 else 0) - x) / along] if along else []
            walls += [((6 if across > 0 else 0) - y) / across] if across else []
            ranges.append(f"{min(walls):.3f}")
        pose = f"{x:.3f} {y:.3f} 0.0"
        lines.append(f"FLASER 180 {' '.join(ranges)} {pose} {pose} {step} robot {step}")
    path.write_text("\n".join(lines) + "\n")


def write_logs(folder: Path) -> Path:
    """A folder with three recordings."""
    folder.mkdir()
    for number in range(3):
        write_log(folder / f"drive{number}.log", 1.0 + 3 * number)
    return folder


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """Recordings that a test may change."""
    return write_logs(tmp_path / "logs")


def inputs(*paths: str | Path) -> str:
    return "inputs=[{}]".format(",".join(f'"{path}"' for path in paths))


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    def run_command(paths: str | Path | list[Path], *options: str, folder: str = "run") -> Finished:
        given = inputs(*(paths if isinstance(paths, list) else [paths]))
        return run_here(monkeypatch, "map", tmp_path / folder, *OPTIONS, given, *options)

    return run_command


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """A run of the three recordings with everything that it writes."""
    folder = tmp_path_factory.mktemp("whole")
    options = [inputs(write_logs(folder / "logs") / "*.log"), "export=[map_server]"]
    options += ["report.figures=true", "report.tensorboard=true"]
    with pytest.MonkeyPatch.context() as patch:
        return succeeded(run_here(patch, "map", folder / "run", *OPTIONS, *options))


def tiles(done: Finished) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (done.folder / "tiles").iterdir()}


def test_recordings_are_mapped_and_merged_into_the_map_of_all(whole, generator):
    *rows, merged = whole.results()["rows"]
    assert [row["dataset"] for row in rows] == ["drive0", "drive1", "drive2"]
    assert [row["n_scans"] for row in rows] == [N_SCANS] * 3
    tiled = TiledMap(whole.folder / "tiles")
    assert merged["n_components"] == tiled.n_components == sum(row["n_components"] for row in rows)
    assert merged["n_tiles"] == len(tiled.index) > 1
    assert merged["nbytes"] == sum(map(len, tiles(whole).values()))
    assert (merged["n_recordings"], merged["n_failed"], merged["n_scans"]) == (3, 0, 3 * N_SCANS)
    points = torch.tensor([[6.0, 3.0], [12.0, 3.0], [20.0, 3.0]])  # free, a wall, unknown
    theta = torch.as_tensor(tiled.occupancy(points))
    assert theta[0] < 0.1
    assert theta[1] > 0.5
    assert theta[2] == 0.5
    parts, known = [], []
    for number in range(3):
        built = GaussianMap(window=3)
        for scan in load("carmen", whole.folder.parent / "logs" / f"drive{number}.log"):
            built.insert(scan)
        parts.append(built.components())
        known.append(built.query_options.calibration)
    together = Components.concatenate(parts)
    together = GaussianMap.of(together, codec="quantized", calibration=Calibration.merged(known))
    points = torch.rand(200, 2, generator=generator, dtype=torch.float64) * torch.tensor([14, 8])
    torch.testing.assert_close(tiled.occupancy(points), together.occupancy(points), rtol=0, atol=1e-9)
    assert {"navigation.pgm", "navigation.yaml"} <= whole.files()
    assert sum(name.endswith("trajectory.tum") for name in whole.files()) == 3


def test_a_run_has_the_pictures_of_its_map_and_the_paths_of_its_recordings(whole):
    assert {"above.png", "components.png"} <= whole.files()
    assert any(name.startswith("tensorboard/events") for name in whole.files())
    merged = whole.results()["rows"][-1]
    assert merged["metres"] == pytest.approx(3 * 0.3 * (N_SCANS - 1), rel=0.01)
    paths = map_outputs.trajectories(whole.folder, 2)
    assert [tuple(path.shape) for path in paths] == [(N_SCANS, 2)] * 3
    (first, last) = paths[0][0], paths[2][-1]
    torch.testing.assert_close(first, torch.tensor([1.0, 2.0], dtype=torch.float64))
    torch.testing.assert_close(last, torch.tensor([8.5, 2.05], dtype=torch.float64))


def test_a_map_larger_than_the_memory_limit_is_written_without_pictures(run, logs):
    done = succeeded(run(logs / "*.log", "report.figures=true", "runtime.memory_limit=100000"))
    assert "pictures  none: " in done.stdout
    assert "give the bounds of a smaller box" in done.stdout
    assert "above.png" not in done.files()
    assert len(TiledMap(done.folder / "tiles").index) > 1


def test_exports_open_only_the_tiles_in_the_bounds(whole, monkeypatch, tmp_path):
    opened: list[int] = []
    read = TiledMap.components

    def count(self: TiledMap, row: int) -> Components:
        opened.append(row)
        return read(self, row)

    monkeypatch.setattr(TiledMap, "components", count)
    output = tmp_path / "part.yaml"
    quiet = [f"path={whole.folder}", f"output={output}", "report.progress=false"]
    succeeded(run_here(monkeypatch, "export", tmp_path, *quiet, "bounds=[0.5,0.5,0.9,0.9]"))
    n_tiles = len(TiledMap(whole.folder / "tiles").index)
    assert 0 < len(opened) < n_tiles
    opened.clear()
    succeeded(run_here(monkeypatch, "export", tmp_path, *quiet))
    assert len(opened) == n_tiles
    assert "must be 4 numbers" in refused(
        run_here(monkeypatch, "export", tmp_path / "x", *quiet, "bounds=[0]")
    )
    csv = [*quiet, f"output={tmp_path / 'map.csv'}"]
    assert "components in 2D" in succeeded(run_here(monkeypatch, "export", tmp_path, *csv)).stdout


def test_the_order_of_the_inputs_does_not_change_the_tiles(run, logs, whole):
    paths = [logs / f"drive{number}.log" for number in (2, 1, 0)]
    other = succeeded(run([*paths, logs / "*1.log"]))  # one of them twice
    assert tiles(other) == tiles(whole)


def test_a_stopped_run_keeps_finished_recordings(run, logs, whole, monkeypatch):
    mapped, seen = map_recordings.map_recording, []

    def stop_at_second(*arguments: object) -> object:
        seen.append(arguments)
        if len(seen) == 2:
            raise KeyboardInterrupt
        return mapped(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(map_recordings, "map_recording", stop_at_second)
    stopped = run(logs / "*.log")
    assert stopped.status == 130
    assert sum(name.endswith("recording.json") for name in stopped.files()) == 1
    assert not (stopped.folder / "tiles").exists()
    again = succeeded(run(logs / "*.log"))
    assert "continues: 1 of 3 recordings are finished" in again.stdout
    assert len(seen) == 4
    assert tiles(again) == tiles(whole)
    other = run(logs / "*.log", "seed=5")
    assert other.status == 1
    assert "is of another run: it has seed=0, this run has seed=5" in other.stderr
    note = next((again.folder / "recordings").glob("*/recording.json"))
    note.write_text("{}")
    assert "recording.json is damaged" in run(logs / "*.log").stderr


def test_a_failed_recording_is_reported_and_ends_no_other(run, logs, whole):
    good = (logs / "drive1.log").read_text()
    (logs / "drive1.log").write_text("no scans\n")
    done = run(logs / "*.log")
    assert done.status == 1
    assert "1 of 3 recordings could not be mapped" in done.stderr
    assert "drive1.log" in done.stderr
    assert "Traceback" not in done.stderr
    *rows, merged = done.results()["rows"]
    assert [bool(row["error"]) for row in rows] == [False, True, False]
    assert (merged["n_recordings"], merged["n_failed"]) == (2, 1)
    assert merged["n_components"] == TiledMap(done.folder / "tiles").n_components
    (logs / "drive1.log").write_text(good)
    assert tiles(succeeded(run(logs / "*.log"))) == tiles(whole)


def test_a_run_without_any_map_fails(run, logs):
    for path in logs.iterdir():
        path.write_text("")
    done = run(logs / "*.log")
    assert done.status == 1
    assert "3 of 3 recordings could not be mapped" in done.stderr
    assert not (done.folder / "tiles").exists()


def test_urls_are_read_by_fsspec(run, logs, whole, monkeypatch):
    fsspec = pytest.importorskip("fsspec")
    memory = fsspec.filesystem("memory")
    for path in logs.iterdir():
        memory.pipe(f"/drives/{path.name}", path.read_bytes())
    try:
        remote = succeeded(run("memory://drives/*.log", folder="remote"))
        assert [row["dataset"] for row in remote.results()["rows"][:3]] == ["drive0", "drive1", "drive2"]
        assert tiles(remote) == tiles(whole)
        assert "matches no file" in refused(run("memory://drives/*.bag", folder="none"))
    finally:
        memory.rm("/drives", recursive=True)
    assert "nonsense://a cannot be read" in refused(run("nonsense://a", folder="none"))
    monkeypatch.setitem(sys.modules, "s3fs", None)
    error = refused(run("s3://fleet/*.log", folder="none"))
    assert "s3://fleet/*.log cannot be read: Install s3fs to access S3" in error


def test_wrong_inputs_are_refused_before_any_work(run, logs, monkeypatch):
    assert "matches no file or folder" in refused(run([logs / "*.log", logs / "*.bag"]))
    log = logs / "drive0.log"
    assert "with inputs, use gmmtorch-view" in refused(run(log, "view=true"))
    assert "leave dataset.path out" in refused(run(log, f"dataset.path={log}"))
    assert "inputs are paths of dataset=synthetic_building" in refused(run(log, "dataset=synthetic_building"))
    assert "map.window=0" in refused(run(log, "map.window=0"))
    assert "workers=0" in refused(run(log, "workers=0"))
    monkeypatch.setitem(sys.modules, "ray", None)
    assert "pip install 'gmmtorch[cluster]'" in refused(run(logs / "*.log", "workers=2"))


def test_recordings_have_distinct_names(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "my drive.log").write_text("")
    found = find_recordings([str(tmp_path / "**" / "*.log"), str(tmp_path / "a" / "*")])
    assert len(found) == 2
    assert all(name.startswith("my_drive.log-") for name in found)
    with pytest.raises(MissingDataError):
        find_recordings([str(tmp_path / "c")])


# -- workers that are lost -------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_task_runs_again_if_its_worker_is_killed(tmp_path):
    pytest.importorskip("ray")
    marks = str(tmp_path)

    def killed(name: str, n_deaths: int) -> str:  # a nested function: workers cannot import this file
        place = Path(marks) / name
        deaths = len(place.read_text()) if place.exists() else 0
        if name == "broken":
            raise ValueError("no such thing")
        if deaths < n_deaths:
            place.write_text("x" * (deaths + 1))
            os.kill(os.getpid(), signal.SIGKILL)
        return f"{name} done"

    deaths = {"never": 0, "once": 1, "twice": 2, "always": 9, "broken": 0}
    arguments = {name: (name, n) for name, n in deaths.items()}
    found = {outcome.name: outcome for outcome in run_tasks(killed, arguments, 2, None)}
    assert {name: outcome.n_lost for name, outcome in found.items()} == {**deaths, "always": 3}
    results = [found[name].result for name in deaths]
    assert results == ["never done", "once done", "twice done", None, None]
    assert "its worker was lost 3 times" in str(found["always"].error)
    assert "no such thing" in str(found["broken"].error)


@pytest.mark.slow
def test_workers_of_ray_give_the_same_tiles(run, logs, whole):
    pytest.importorskip("ray")
    there = succeeded(run(logs / "*.log", "workers=2"))
    assert tiles(there) == tiles(whole)
    workers = {row["worker"] for row in there.results()["rows"][:3]}
    assert not any(worker.endswith(f":{os.getpid()}") for worker in workers)


def test_a_cluster_that_cannot_be_reached_is_an_error(run, logs):
    pytest.importorskip("ray")
    with socket.socket() as closed:  # a port at which nobody listens
        closed.bind(("127.0.0.1", 0))
        address = f"ray://127.0.0.1:{closed.getsockname()[1]}"
        assert f"cluster={address} cannot be reached" in refused(run(logs / "*.log", f"cluster={address}"))
