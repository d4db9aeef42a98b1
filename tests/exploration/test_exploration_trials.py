"""Trials: they go on where they were, are not run twice, and stop where one fails."""

from __future__ import annotations

import concurrent.futures
import concurrent.futures.process
import itertools
import json
import pickle
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from exploration.furnished_room import SHELF, SMALL, room, without_seconds
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, OutputError
from gmmtorch.exploration.mission import trials as trials_module
from gmmtorch.exploration.mission.mission import Mission
from gmmtorch.exploration.mission.pace import Pace, Paces
from gmmtorch.exploration.mission.trials import (
    CHECKPOINT,
    ROW,
    STAGE,
    Trial,
    WorldOptions,
    run_mission,
    run_trials,
)
from gmmtorch.simulation.worlds.solids import box


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
    """Each world is worked out once for all tests."""
    monkeypatch.setenv("GMMTORCH_CACHE", cache)


@pytest.fixture
def mesh_file(tmp_path: Path) -> str:
    return write_mesh(tmp_path / "room.ply", room(SHELF))


def trial(mesh_file: str, folder: Path | None, every: float = 2.0, **changes: Any) -> Trial:
    team = replace(SMALL, **{"duration": 6.0, **changes})
    return Trial(WorldOptions("mesh", path=mesh_file), team, folder, checkpoint_every=every)


# -- checkpoints --------------------------------------------------------------------------------------


def test_a_killed_trial_goes_on_to_the_same_row(
    mesh_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, whole = run_mission(trial(mesh_file, tmp_path / "whole"))
    steps = 0
    step = Mission.step

    def killed(self: Mission) -> None:
        nonlocal steps
        steps += 1
        if steps == 4:
            raise KeyboardInterrupt
        step(self)

    monkeypatch.setattr(Mission, "step", killed)
    with pytest.raises(KeyboardInterrupt):
        run_mission(trial(mesh_file, tmp_path / "cut"))
    assert (tmp_path / "cut" / CHECKPOINT).is_file()
    _, resumed = run_mission(trial(mesh_file, tmp_path / "cut"))
    assert steps == 4 + 4  # from the checkpoint after the second on
    assert without_seconds(resumed) == without_seconds(whole)


@pytest.mark.parametrize(
    ("every", "after"), [(0.0, []), (0.1, [1, 2, 3, 4]), (0.4, [1, 2, 3, 4]), (3.0, [3, 4]), (1e9, [4])]
)
def test_checkpoints_are_written_as_often_as_they_are_wanted(
    every: float, after: list[int], mesh_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[int] = []
    monkeypatch.setattr(
        trials_module, "save_checkpoint", lambda path, state, **_: written.append(state["mission"]["tick"])
    )
    run_mission(trial(mesh_file, tmp_path / "kept", every, duration=4.0, size=1))
    assert written == after


def test_a_checkpoint_of_other_options_is_refused(mesh_file: str, tmp_path: Path) -> None:
    run_mission(trial(mesh_file, tmp_path / "kept", duration=2.0, size=1))
    with pytest.raises(DataError, match=r"another mission \(seed=0 there, 5 here\)"):
        run_mission(trial(mesh_file, tmp_path / "kept", duration=2.0, size=1, seed=5))


def test_missions_have_the_same_digest_if_they_are_the_same() -> None:
    one = Trial(WorldOptions(), SMALL)
    same = replace(one, world=WorldOptions(cache=False), folder=Path("elsewhere"), checkpoint_every=1.0)
    assert one.digest == same.digest
    others = [
        replace(one, team=replace(SMALL, seed=1)),
        replace(one, team=replace(SMALL, camera=replace(SMALL.camera, width=50))),
        replace(one, world=WorldOptions(seed=1)),
    ]
    assert len({one.digest, *(other.digest for other in others)}) == 4


def test_a_mesh_that_was_edited_is_another_world(mesh_file: str, tmp_path: Path, steps: list[int]) -> None:
    def one(name: str) -> Trial:
        return trial(mesh_file, tmp_path / name, duration=2.0, size=1)

    (before,) = run_trials([one("row")])
    run_mission(one("checkpoint"))
    assert len(steps) == 4
    write_mesh(Path(mesh_file), room(SHELF, box((7.5, 5.5, 0.1), (8.5, 6.5, 1.0))))
    (after,) = run_trials([one("row")])
    assert len(steps) == 6  # flown again
    assert after["observable_bits"] != before["observable_bits"]
    with pytest.raises(DataError, match=r"another mission \(mesh=\w+ there, \w+ here\)"):
        run_mission(one("checkpoint"))


def test_what_another_version_has_flown_is_flown_again(
    mesh_file: str, tmp_path: Path, steps: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    for version, n_steps in (("1.0", 2), ("1.0", 2), ("1.1", 4)):
        monkeypatch.setattr(trials_module, "__version__", version)
        run_trials([trial(mesh_file, tmp_path / "row", duration=2.0, size=1)])
        assert len(steps) == n_steps


def test_a_folder_that_cannot_be_written_to_is_found_before_the_first_step(
    mesh_file: str, tmp_path: Path, steps: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setattr(WorldOptions, "open", None)  # not even the world is worked out
    with pytest.raises(OutputError, match="file"):
        run_mission(trial(mesh_file, tmp_path / "file" / "kept"))
    assert steps == []


# -- several ------------------------------------------------------------------------------------------


def test_trials_that_are_done_are_not_run_again(mesh_file: str, tmp_path: Path, steps: list[int]) -> None:
    trials = [trial(mesh_file, tmp_path / str(seed), seed=seed, duration=2.0, size=1) for seed in range(2)]
    rows = run_trials(trials)
    assert (tmp_path / "0" / ROW).is_file()
    n_steps, heard, told = len(steps), [], []
    again = run_trials(trials, on_row=heard.append, on_event=lambda *event: told.append(event))
    assert again == heard == json.loads(json.dumps(rows))
    assert len(steps) == n_steps
    assert told == [(STAGE, 4, 4)]


def test_trials_in_two_processes_give_the_rows_of_one(mesh_file: str, tmp_path: Path) -> None:
    teams = [{"framework": name} for name in ("gmm_shared", "grid_shared")]
    found = []
    for workers in (2, 1):
        events: list[tuple[Any, ...]] = []
        paces: list[Pace] = []
        trials = [
            trial(mesh_file, tmp_path / f"{workers}_{i}", duration=3.0, sample_every=2.0, **team)
            for i, team in enumerate(teams)
        ]
        rows = run_trials(trials, workers, on_event=lambda *e, to=events: to.append(e), on_pace=paces.append)
        found.append([without_seconds(row) for row in rows])
        # All missions together, never back, from nothing to their end.
        assert {(stage, total) for stage, _, total in events} == {(STAGE, 6)}
        seconds = [done for _, done, _ in events]
        assert seconds[0] == 0
        assert seconds[-1] == 6
        assert all(one <= other for one, other in itertools.pairwise(seconds))
        assert {pace.now for pace in paces} <= {0.0, 2.0, 3.0}
        ends = [pace for pace in paces if pace.now == 3]
        assert sorted(pace.n_bytes for pace in ends) == sorted(row["bytes_sent"] for row in rows)
        for pace in ends:
            assert 0 < pace.entropy_left < 0.9
            assert pace.speed > 0
    assert found[0] == found[1]


def in_threads(
    monkeypatch: pytest.MonkeyPatch, run: Callable[[Trial, Callable[[Pace], None]], dict[str, Any]]
) -> None:
    """Trials of several workers run in threads, by a function that the test can see into."""

    monkeypatch.setattr(trials_module, "worker_pool", concurrent.futures.ThreadPoolExecutor)
    monkeypatch.setattr(trials_module, "_run_one", run)


def test_once_one_fails_no_other_begins_and_those_that_run_end(monkeypatch: pytest.MonkeyPatch) -> None:
    begun, ended = [], []
    other_runs, fails = threading.Event(), threading.Event()

    def run(one: Trial, on_pace: Callable[[Pace], None]) -> dict[str, Any]:
        begun.append(one.team.seed)
        if one.team.seed == 0:
            other_runs.wait(30)
            fails.set()
            raise OutputError("The disk is full.")
        other_runs.set()
        fails.wait(30)
        time.sleep(0.3)  # it outlives the failure
        ended.append(one.team.seed)
        return {"seed": one.team.seed}

    in_threads(monkeypatch, run)
    with pytest.raises(OutputError, match="disk is full"):
        run_trials([trial("room.ply", None, seed=seed) for seed in range(6)], workers=2)
    assert sorted(begun) == [0, 1]
    assert ended == [1]


def test_a_worker_that_is_killed_is_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(one: Trial, on_pace: Callable[[Pace], None]) -> dict[str, Any]:
        raise concurrent.futures.process.BrokenProcessPool

    in_threads(monkeypatch, run)
    with pytest.raises(GmmTorchError, match=r"ended from outside.*runtime\.workers=1"):
        run_trials([trial("room.ply", None, seed=seed) for seed in range(3)], workers=2)


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_once_it_is_interrupted_no_other_begins(workers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[int] = []
    lock = threading.Lock()

    def run(one: Trial, on_pace: Callable[[Pace], None]) -> dict[str, Any]:
        with lock:
            begun.append(one.team.seed)
        return {"seed": one.team.seed}

    def interrupt(row: dict[str, Any]) -> None:
        raise KeyboardInterrupt

    in_threads(monkeypatch, run)
    with pytest.raises(KeyboardInterrupt):
        run_trials([trial("room.ply", None, seed=seed) for seed in range(9)], workers, on_row=interrupt)
    assert sorted(begun) == list(range(workers))


def test_paces_are_those_noted_last_and_told_once(tmp_path: Path) -> None:
    paths = [tmp_path / "0", None, tmp_path / "2"]
    paths[0].write_text("of a run that was killed")
    paces = Paces(paths)
    elsewhere = pickle.loads(pickle.dumps(paces))
    assert paces.changes() == []
    early, late = Pace(0.0, 1.0, 0.0, 0.0), Pace(10.0, 0.7, 1200.0, 3.5)
    for number, pace in ((2, early), (0, early), (2, late)):
        elsewhere.note(number, pace)
    assert paces.changes() == [(0, early), (2, late)]
    assert paces.changes() == []
    elsewhere.note(0, late)
    elsewhere.note(1, late)
    assert paces.changes() == [(0, late)]
    paces.forget()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("every", [-1.0, float("nan"), float("inf")])
def test_times_that_cannot_be_are_refused(every: float) -> None:
    with pytest.raises(InvalidArgumentError, match=r"checkpoint\.every="):
        trial("room.ply", None, every)
