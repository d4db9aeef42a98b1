"""Trials: missions that run to their end, one after another or several in parallel, and keep their rows."""

from __future__ import annotations

import concurrent.futures.process
import functools
import hashlib
import json
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import torch

from gmmtorch import __version__
from gmmtorch.errors import DataError, GmmTorchError, check_whole
from gmmtorch.events import Event, ignore
from gmmtorch.files import check_writable, write_json, write_npz
from gmmtorch.processes import end_with_parent
from gmmtorch.team.exploration.mission.driver import SimulatedClock, drive
from gmmtorch.team.exploration.mission.mission import Mission
from gmmtorch.team.exploration.mission.options import TeamOptions, WorldOptions
from gmmtorch.team.exploration.mission.results import mission_row
from gmmtorch.team.exploration.mission.team_setup import assemble
from gmmtorch.team.exploration.world.world import World

ROW = "row.json"
STAGE = "simulated seconds"
TRAJECTORIES = "trajectories.npz"
_CONVERGENCE = 120.0
"""Simulated seconds after a mission in which the maps may become equal."""

OnMission = Callable[[Mission], object]


@dataclass(frozen=True)
class Trial:
    """One mission in one world. folder: where its row is kept; None: nowhere."""

    world: WorldOptions
    team: TeamOptions
    folder: Path | None = None

    def facts(self) -> dict[str, str | None]:
        """What must be equal for a kept row to count: the options of world and team by the names of their
        fields, a hash of the mesh, and the version."""
        return {**self._options, "mesh": self._mesh, "version": __version__}

    @property
    def digest(self) -> str:
        """Eight hexadecimal digits that depend on the options, for the name of a folder."""
        return f"{zlib.crc32(json.dumps(self._options).encode()):08x}"

    @property
    def _options(self) -> dict[str, str]:
        return {**_fields_of(replace(self.world, cache=True), "world."), **_fields_of(self.team)}

    @functools.cached_property
    def _mesh(self) -> str | None:
        """A hash of the mesh file, which may change; None for generated worlds."""
        if self.world.path is None or not (path := Path(self.world.path).expanduser()).is_file():
            return None
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:16]


def run_mission(
    trial: Trial, world: World | None = None, on_tick: OnMission = lambda mission: None
) -> tuple[Mission, dict[str, Any]]:
    """Runs a trial; returns the mission at its end, and its row. Keeps nothing.

    Raises `OutputError`, before anything is computed, if the trial's folder cannot be written to.

    Args:
        on_tick: called at the start and after every tick.
    """
    if trial.folder is not None:
        check_writable(trial.folder)
    world = trial.world.open(trial.team) if world is None else world
    mission = assemble(world, trial.team)
    begin = time.perf_counter()
    on_tick(mission)
    drive(mission, SimulatedClock(), on_step=functools.partial(on_tick, mission))
    row = mission_row(mission, time.perf_counter() - begin)
    # Only maps with a digest can be compared.
    has_digests = any(robot.mapper.shared.digest() for robot in mission.robots)
    row["converged_after"] = mission.converge(_CONVERGENCE) if has_digests else None
    return mission, row


def run_trials(
    trials: Sequence[Trial],
    workers: int = 1,
    on_row: Callable[[dict[str, Any]], object] = lambda row: None,
    on_event: Event = ignore,
    on_sample: OnMission = lambda mission: None,
) -> list[dict[str, Any]]:
    """The rows of trials in their order, run in `workers` processes; trials with a kept row are not run.

    Each trial uses one thread, so results do not depend on `workers`. If one trial fails, no other starts;
    those that are running end, keep their rows, and then the error is raised.

    Args:
        on_row: called with each row when it is there.
        on_event: called with the simulated seconds of all trials together (`STAGE`).
        on_sample: with one worker, then called with the running mission whenever its curves grow.
    """
    check_whole("workers", workers, 1)
    rows = [kept_row(trial) for trial in trials]
    missing = [i for i, row in enumerate(rows) if row is None]
    durations = [trial.team.duration for trial in trials]
    seconds = [0.0 if row is None else whole for whole, row in zip(durations, rows, strict=True)]

    def progress(i: int, now: float) -> None:
        seconds[i] = now
        on_event(STAGE, round(sum(seconds)), round(sum(durations)))

    def sampled(i: int, mission: Mission) -> None:
        if mission.has_sampled:
            progress(i, mission.elapsed)
            on_sample(mission)

    for row in rows:
        if row is not None:
            on_row(row)
    on_event(STAGE, round(sum(seconds)), round(sum(durations)))
    if workers == 1:
        finished: Iterator[tuple[int, dict[str, Any]]] = (
            (i, _run_and_keep(trials[i], functools.partial(sampled, i))) for i in missing
        )
    else:
        finished = _run_in_parallel({i: trials[i] for i in missing}, workers)
    for i, row in finished:
        rows[i] = row
        progress(i, durations[i])
        on_row(row)
    return [row for row in rows if row is not None]


def kept_row(trial: Trial, **more: Any) -> dict[str, Any] | None:
    """The row that `keep_row` kept for an equal trial with the same `more` facts; None: there is none."""
    if trial.folder is None or not (trial.folder / ROW).is_file():
        return None
    path = trial.folder / ROW
    try:
        kept = json.loads(path.read_text("utf-8"))
        row: dict[str, Any] = kept["row"]
        is_same = kept["facts"] == {**trial.facts(), **more}
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} is damaged ({error!r}); delete it to run the trial again.") from error
    return row if is_same else None


def keep_row(trial: Trial, row: dict[str, Any], **more: Any) -> None:
    """Keeps the row of a finished trial in its folder, if it has one."""
    if trial.folder is not None:
        write_json(trial.folder / ROW, {"facts": {**trial.facts(), **more}, "row": row})


def save_trajectories(mission: Mission, path: Path) -> None:
    """Writes poses (T, 4) of each robot, one per tick, as arrays robot_0, robot_1, … of an npz file."""
    poses = {f"robot_{n}": torch.stack(path).numpy() for n, path in enumerate(mission.trajectories)}
    write_npz(path, **poses)


def _run_and_keep(trial: Trial, on_tick: OnMission = lambda mission: None) -> dict[str, Any]:
    torch.set_num_threads(1)
    mission, row = run_mission(trial, on_tick=on_tick)
    if trial.folder is not None:
        save_trajectories(mission, trial.folder / TRAJECTORIES)
    keep_row(trial, row)
    return row


def _run_in_parallel(trials: dict[int, Trial], workers: int) -> Iterator[tuple[int, dict[str, Any]]]:
    """Keys and rows of trials, in the order in which they finish."""
    import joblib

    error: Exception | None = None
    with tempfile.TemporaryDirectory(prefix="gmmtorch-") as folder:
        # Processes start the next trial before this one sees a failure, so they look for this file.
        failed = Path(folder) / "failed"
        parallel = joblib.Parallel(
            n_jobs=workers, pre_dispatch=workers, batch_size=1, return_as="generator_unordered"
        )
        tasks = (joblib.delayed(_run_apart)(i, trial, failed) for i, trial in trials.items())
        try:
            for i, outcome in parallel(tasks):
                if isinstance(outcome, Exception):
                    error = error or outcome
                elif outcome is not None:
                    yield i, outcome
        except concurrent.futures.process.BrokenProcessPool as broken:
            raise GmmTorchError(
                "A process that ran a mission was killed, perhaps because memory ran out. The same trials in "
                "the same folders continue with the missions that are missing; ‹workers›=1 takes least "
                "memory."
            ) from broken
    if error is not None:
        raise error


def _run_apart(i: int, trial: Trial, failed: Path) -> tuple[int, dict[str, Any] | Exception | None]:
    """Runs a trial in a worker process, unless another has failed. Returns errors, which would end joblib."""
    end_with_parent()
    if failed.exists():
        return i, None
    try:
        return i, _run_and_keep(trial)
    except Exception as error:
        failed.touch()
        return i, error


def _fields_of(value: Any, prefix: str = "") -> dict[str, str]:
    """The fields of a dataclass and of nested dataclasses, by dotted names, as text."""
    flat: dict[str, str] = {}
    for field in fields(value):
        held, name = getattr(value, field.name), prefix + field.name
        flat |= _fields_of(held, f"{name}.") if is_dataclass(held) else {name: repr(held)}
    return flat
