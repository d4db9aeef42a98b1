"""Trials: finished ones are not run again, and one failure starts no other."""

from __future__ import annotations

import itertools
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from exploration.rooms import SMALL, without_seconds
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError, OutputError
from gmmtorch.simulation.furniture import box
from gmmtorch.team.exploration.mission import trials as trials_module
from gmmtorch.team.exploration.mission.trials import ROW, STAGE, Trial, WorldOptions, run_mission, run_trials

ROOM = box((0.1, 0.1, 0.1), (6.1, 5.1, 3.1))


def write_mesh(path: Path, triangles: Tensor) -> str:
    import open3d

    corners = triangles.reshape(-1, 3).double().numpy()
    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(corners),
        open3d.utility.Vector3iVector(torch.arange(len(corners)).view(-1, 3).numpy()),
    )
    open3d.io.write_triangle_mesh(str(path), mesh)
    return str(path)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(autouse=True)
def with_the_cache(cache: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The properties of each world are computed once for all tests."""
    monkeypatch.setenv("GMMTORCH_CACHE", cache)


@pytest.fixture
def mesh_file(tmp_path: Path) -> str:
    return write_mesh(tmp_path / "room.ply", ROOM)


def trial(mesh_file: str, folder: Path | None, **changes: Any) -> Trial:
    team = replace(SMALL, **{"duration": 2.0, "size": 1, **changes})
    return Trial(WorldOptions("mesh", path=mesh_file), team, folder)


# -- one trial ----------------------------------------------------------------------------------------


def test_digests_are_equal_for_equal_missions_only() -> None:
    one = Trial(WorldOptions(), SMALL)
    same = replace(one, world=WorldOptions(cache=False), folder=Path("elsewhere"))
    assert one.digest == same.digest
    others = [
        replace(one, team=replace(SMALL, seed=1)),
        replace(one, team=replace(SMALL, camera=replace(SMALL.camera, width=50))),
        replace(one, world=WorldOptions(seed=1)),
    ]
    assert len({one.digest, *(other.digest for other in others)}) == 4


def test_on_tick_sees_the_mission_at_its_start_and_after_every_tick(mesh_file: str) -> None:
    seen: list[tuple[int, bool]] = []
    run_mission(
        trial(mesh_file, None, duration=5.0, sample_every=2.0),
        on_tick=lambda mission: seen.append((mission.n_ticks, mission.has_sampled)),
    )
    assert seen == [(0, True), (1, False), (2, True), (3, False), (4, True), (5, True)]


def test_a_trial_of_an_edited_mesh_is_run_again(mesh_file: str, tmp_path: Path, steps: list[int]) -> None:
    (before,) = run_trials([trial(mesh_file, tmp_path / "row")])
    write_mesh(Path(mesh_file), torch.cat([ROOM, box((4.5, 3.5, 0.1), (5.5, 4.5, 1.0))]))
    (after,) = run_trials([trial(mesh_file, tmp_path / "row")])
    assert len(steps) == 4
    assert after["observable_bits"] != before["observable_bits"]


def test_a_kept_row_counts_for_equal_facts_only(
    mesh_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = trial(mesh_file, tmp_path / "row")
    assert one.kept_row() is None
    one.keep_row({"seed": 0}, report={"figures": True})
    assert one.kept_row(report={"figures": True}) == {"seed": 0}
    assert one.kept_row() is one.kept_row(report={"figures": False}) is None
    assert replace(one, team=replace(one.team, seed=1)).kept_row(report={"figures": True}) is None
    with monkeypatch.context() as patch:
        patch.setattr(trials_module, "__version__", "0.0")
        assert one.kept_row(report={"figures": True}) is None
    (tmp_path / "row" / ROW).write_text("{}")
    with pytest.raises(DataError, match=r"row\.json is damaged"):
        one.kept_row()


def test_a_folder_that_cannot_be_written_is_found_before_the_first_tick(
    tmp_path: Path, steps: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setattr(WorldOptions, "open", None)  # nor is the world opened
    with pytest.raises(OutputError, match="file"):
        run_mission(trial("room.ply", tmp_path / "file" / "kept"))
    assert steps == []


# -- several ------------------------------------------------------------------------------------------


def test_finished_trials_are_not_run_again(mesh_file: str, tmp_path: Path, steps: list[int]) -> None:
    trials = [trial(mesh_file, tmp_path / str(seed), seed=seed) for seed in range(2)]
    rows = run_trials(trials)
    n_steps, heard, events = len(steps), [], []
    again = run_trials(trials, on_row=heard.append, on_event=lambda *event: events.append(event))
    assert again == heard == json.loads(json.dumps(rows))
    assert len(steps) == n_steps
    assert events == [(STAGE, 4, 4)]


def test_progress_of_one_worker_counts_the_seconds_of_all_trials(mesh_file: str) -> None:
    events: list[tuple[Any, ...]] = []
    samples: list[float] = []
    run_trials(
        [trial(mesh_file, None, seed=seed, duration=3.0, sample_every=2.0) for seed in range(2)],
        on_event=lambda *event: events.append(event),
        on_sample=lambda mission: samples.append(mission.elapsed),
    )
    assert {(stage, total) for stage, _, total in events} == {(STAGE, 6)}
    assert list(dict.fromkeys(done for _, done, _ in events)) == [0, 2, 3, 5, 6]
    assert samples == [0.0, 2.0, 3.0] * 2


@pytest.mark.slow
def test_trials_in_two_processes_give_the_rows_of_one(mesh_file: str, tmp_path: Path) -> None:
    found = []
    for workers in (2, 1):
        events: list[tuple[Any, ...]] = []
        trials = [
            trial(mesh_file, tmp_path / f"{workers}_{name}", size=2, framework=name)
            for name in ("gmm_shared", "grid_shared")
        ]
        rows = run_trials(trials, workers, on_event=lambda *e, to=events: to.append(e))
        found.append([without_seconds(row) for row in rows])
        seconds = [done for _, done, _ in events]
        assert (seconds[0], seconds[-1]) == (0, 4)
        assert all(one <= other for one, other in itertools.pairwise(seconds))
        assert all((one.folder / ROW).is_file() for one in trials if one.folder)
    assert found[0] == found[1]


def in_this_process(monkeypatch: pytest.MonkeyPatch, run: Any) -> None:
    """Trials of several workers run in threads of this process, by a function of the test."""
    joblib = pytest.importorskip("joblib")
    monkeypatch.setattr(joblib, "Parallel", lambda **options: _PARALLEL(backend="threading", **options))
    monkeypatch.setattr(trials_module, "_run_and_keep", run)


_PARALLEL = __import__("joblib").Parallel


def test_after_a_failure_no_trial_starts_and_running_ones_finish(monkeypatch: pytest.MonkeyPatch) -> None:
    begun, ended, rows = [], [], []

    def run(one: Trial) -> dict[str, Any]:
        begun.append(one.team.seed)
        if one.team.seed == 0:
            while len(begun) < 2:
                time.sleep(0.01)
            raise OutputError("The disk is full.")
        time.sleep(0.5)  # longer than the failing trial
        ended.append(one.team.seed)
        return {"seed": one.team.seed}

    in_this_process(monkeypatch, run)
    with pytest.raises(OutputError, match="disk is full"):
        run_trials([trial("room.ply", None, seed=seed) for seed in range(6)], 2, on_row=rows.append)
    assert sorted(begun) == [0, 1]
    assert ended == [1]
    assert rows == [{"seed": 1}]


def test_a_killed_worker_is_reported_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    from concurrent.futures.process import BrokenProcessPool

    class Broken:
        def __init__(self, **options: Any) -> None: ...

        def __call__(self, tasks: Any) -> Any:
            raise BrokenProcessPool

    monkeypatch.setattr(__import__("joblib"), "Parallel", Broken)
    with pytest.raises(GmmTorchError, match=r"was killed.*in the same folders.*workers=1"):
        run_trials([trial("room.ply", None, seed=seed) for seed in range(3)], workers=2)


def test_after_an_interrupt_no_trial_starts(mesh_file: str, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[int] = []

    def run(one: Trial, on_tick: Any = None) -> dict[str, Any]:
        begun.append(one.team.seed)
        return {"seed": one.team.seed}

    def interrupt(row: dict[str, Any]) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(trials_module, "_run_and_keep", run)
    with pytest.raises(KeyboardInterrupt):
        run_trials([trial(mesh_file, None, seed=seed) for seed in range(9)], on_row=interrupt)
    assert begun == [0]
