"""Trials: missions run to their end, checkpointed as they go, one after another or several at once."""

from __future__ import annotations

import concurrent.futures
import concurrent.futures.process
import contextlib
import functools
import hashlib
import itertools
import json
import math
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import torch

from gmmtorch import __version__
from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, check_whole
from gmmtorch.evaluation.events import Event, ignore
from gmmtorch.evaluation.worker_pool import worker_pool
from gmmtorch.exploration.mission.checkpoint import load_checkpoint, save_checkpoint
from gmmtorch.exploration.mission.mission import Mission
from gmmtorch.exploration.mission.mission_results import row_of
from gmmtorch.exploration.mission.options import TeamOptions
from gmmtorch.exploration.mission.pace import Pace, Paces, pace_of
from gmmtorch.exploration.mission.snapshots import Snapshots
from gmmtorch.exploration.mission.team_setup import assemble
from gmmtorch.exploration.world.world import World, open_world
from gmmtorch.files import check_writable, write_json, write_npz

CHECKPOINT = "mission.safetensors"
PACE = "pace.json"
ROW = "row.json"
STAGE = "simulated seconds"
TRAJECTORIES = "trajectories.npz"
_PATIENCE = 120.0  # simulated seconds after a mission, for maps to become the same
_GLANCE = 0.5  # seconds between looks at how far the missions of other processes are

OnSample = Callable[[Mission], None]
OnPace = Callable[[Pace], None]


@dataclass(frozen=True)
class WorldOptions:
    """Which world; see `world.open_world`. size (m), seed: of worlds drawn at random; path, bounds: of a
    mesh. cache: keep on disk what is worked out once."""

    name: str = "warehouse"
    path: str | None = None
    bounds: tuple[float, ...] | None = None
    size: tuple[float, ...] | None = None
    seed: int = 0
    resolution: float = 0.2
    cache: bool = True

    def open(self, team: TeamOptions, on_event: Event = ignore) -> World:
        """The world, as robots like these can see and fly it."""
        return open_world(
            self.name,
            path=self.path,
            bounds=self.bounds,
            seed=self.seed,
            size=self.size,
            resolution=self.resolution,
            vertical_fov=team.camera.vertical_fov,
            max_range=team.camera.max_range,
            robot_radius=team.dynamics.radius,
            cache=self.cache,
            on_event=on_event,
        )


@dataclass(frozen=True)
class Trial:
    """One mission in one world.

    folder: where its checkpoint and its row are kept; None: nowhere. checkpoint_every: simulated seconds
    between checkpoints, at least a tick; 0: none.
    """

    world: WorldOptions
    team: TeamOptions
    folder: Path | None = None
    checkpoint_every: float = 60.0

    def __post_init__(self) -> None:
        if not 0 <= self.checkpoint_every < math.inf:
            raise InvalidArgumentError(
                f"checkpoint.every={self.checkpoint_every} must be finite seconds, at least zero."
            )

    @property
    def ticks_per_checkpoint(self) -> int | None:
        """None: there are none."""
        every = self.checkpoint_every
        return max(1, round(every * self.team.rate)) if every > 0 else None

    def facts(self) -> dict[str, str | None]:
        """What a checkpoint must agree in to go on from it: the options of world and team, by the names of
        their fields, what lies at the path of a mesh, and the version."""
        return {**self._options, "mesh": self._mesh, "version": __version__}

    @property
    def digest(self) -> str:
        """Of the options, eight hexadecimal digits: missions that differ can have folders that do."""
        return f"{zlib.crc32(json.dumps(self._options).encode()):08x}"

    @property
    def _options(self) -> dict[str, str]:
        return {**_fields_of(replace(self.world, cache=True), "world."), **_fields_of(self.team)}

    @functools.cached_property
    def _mesh(self) -> str | None:
        """A hash of the mesh, if the world is one: what lies at its path may change."""
        if self.world.path is None or not (path := Path(self.world.path).expanduser()).is_file():
            return None
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:16]


def is_begun(folder: Path) -> bool:
    """Whether a trial in this folder was run to its end, or to a checkpoint."""
    return any((folder / name).is_file() for name in (CHECKPOINT, ROW))


def run_mission(
    trial: Trial,
    world: World | None = None,
    on_sample: OnSample | None = None,
    album: Snapshots | None = None,
) -> tuple[Mission, dict[str, Any]]:
    """Run a trial, from its checkpoint if there is one; returns the mission at its end and its row.

    A mission that was killed goes on from its last checkpoint to the same result, and to the same album.
    Raises `OutputError`, before anything is flown, for a folder that cannot be written to.

    Args:
        on_sample: hears of the mission where it begins or goes on, and whenever numbers are noted.
        album: is shown every step.
    """
    if trial.folder is not None:
        check_writable(trial.folder)
    world = trial.world.open(trial.team) if world is None else world
    mission = assemble(world, trial.team)
    path = None if trial.folder is None else trial.folder / CHECKPOINT
    wall = 0.0
    if path is not None and path.is_file():
        state = load_checkpoint(path, **trial.facts())
        mission.restore(state["mission"])
        wall = float(state["wall_seconds"])
        if album is not None and state["album"] is not None:
            album.restore(state["album"])
        elif album is not None:  # nobody had one before
            album.look(mission)
    begin, every = time.perf_counter() - wall, trial.ticks_per_checkpoint
    if on_sample is not None:
        on_sample(mission)
    while not mission.is_over:
        mission.step()
        if album is not None:
            album.look(mission)
        if on_sample is not None and mission.sampled_now:
            on_sample(mission)
        if path is not None and every is not None and (mission.tick % every == 0 or mission.is_over):
            state = {
                "mission": mission.state(),
                "album": None if album is None else album.state(),
                "wall_seconds": time.perf_counter() - begin,
            }
            save_checkpoint(path, state, **trial.facts())
    row = row_of(mission, time.perf_counter() - begin)
    repaired = (
        mission.converge(_PATIENCE) if any(agent.robot.mapper.digest() for agent in mission.agents) else None
    )
    return mission, {**row, "converged_after": repaired}


def run_trials(
    trials: Sequence[Trial],
    workers: int = 1,
    on_row: Callable[[dict[str, Any]], None] | None = None,
    on_event: Event = ignore,
    on_pace: OnPace | None = None,
) -> list[dict[str, Any]]:
    """The rows of trials in their order, run in `workers` processes; those done already are read.

    Every trial has one thread, so that its result does not depend on how many run. Once one fails, no other
    begins; those that run end, and their rows are kept in their folders.

    Args:
        on_row: hears each row as it is there. on_event: hears of the simulated seconds of all trials
            together (`STAGE`). on_pace: then hears how far the trial is that has got further.
    """
    check_whole("workers", workers, 1)
    rows = [_kept_row(trial) for trial in trials]
    missing = [i for i, row in enumerate(rows) if row is None]
    durations = [trial.team.duration for trial in trials]
    seconds = [0.0 if row is None else whole for whole, row in zip(durations, rows, strict=True)]

    def reached(i: int, now: float) -> None:
        seconds[i] = now
        on_event(STAGE, round(sum(seconds)), round(sum(durations)))

    def got_further(i: int, pace: Pace) -> None:
        reached(i, pace.now)
        if on_pace is not None:
            on_pace(pace)

    def done(i: int, row: dict[str, Any]) -> None:
        rows[i] = row
        reached(i, durations[i])
        if on_row is not None:
            on_row(row)

    for row in rows:
        if row is not None and on_row is not None:
            on_row(row)
    on_event(STAGE, round(sum(seconds)), round(sum(durations)))
    if workers == 1:
        for i in missing:
            done(i, _run_one(trials[i], functools.partial(got_further, i)))
    else:
        _run_several(trials, missing, workers, done, got_further)
    return [row for row in rows if row is not None]


def save_trajectories(mission: Mission, path: Path) -> None:
    """Poses (T, 4) of every robot, one a tick, as arrays robot_0, robot_1, … of an npz file."""
    paths = {f"robot_{n}": torch.stack(path).numpy() for n, path in enumerate(mission.trajectories)}
    write_npz(path, **paths)


def _run_several(
    trials: Sequence[Trial],
    missing: Sequence[int],
    workers: int,
    done: Callable[[int, dict[str, Any]], None],
    got_further: Callable[[int, Pace], None],
) -> None:
    """Run those that are missing, so many at once."""
    waiting = iter(missing)
    running: dict[concurrent.futures.Future[dict[str, Any]], int] = {}
    paces = Paces([None if trial.folder is None else trial.folder / PACE for trial in trials])
    with contextlib.ExitStack() as stack:
        stack.callback(paces.forget)  # once the pool is no more
        pool = stack.enter_context(worker_pool(workers))
        while True:
            # No more than there are workers: what the pool has been given cannot be taken back.
            for i in itertools.islice(waiting, workers - len(running)):
                running[pool.submit(_run_apart, trials[i], paces, i)] = i
            if not running:
                return
            ended, _ = concurrent.futures.wait(
                running, _GLANCE, return_when=concurrent.futures.FIRST_COMPLETED
            )
            for i, pace in paces.changes():
                got_further(i, pace)
            for future in ended:
                done(running.pop(future), _row_in(future))


def _row_in(future: concurrent.futures.Future[dict[str, Any]]) -> dict[str, Any]:
    try:
        return future.result()
    except concurrent.futures.process.BrokenProcessPool as error:
        raise GmmTorchError(
            "A process that flew a mission was ended from outside, perhaps for want of memory. Missions go "
            "on from their last checkpoints with checkpoint.folder=RUN; runtime.workers=1 takes least memory."
        ) from error


def _run_apart(trial: Trial, paces: Paces, number: int) -> dict[str, Any]:
    """Run a trial in a process of its own."""
    return _run_one(trial, functools.partial(paces.note, number))


def _run_one(trial: Trial, on_pace: OnPace) -> dict[str, Any]:
    torch.set_num_threads(1)
    mission, row = run_mission(trial, on_sample=lambda mission: on_pace(pace_of(mission)))
    if trial.folder is not None:
        save_trajectories(mission, trial.folder / TRAJECTORIES)
        write_json(trial.folder / ROW, {"facts": trial.facts(), "row": row})
        (trial.folder / CHECKPOINT).unlink(missing_ok=True)  # the row says it all
    return row


def _fields_of(value: Any, prefix: str = "") -> dict[str, str]:
    """The fields of a dataclass, and of those in it, by dotted names, as text."""
    flat: dict[str, str] = {}
    for field in fields(value):
        held, name = getattr(value, field.name), prefix + field.name
        flat |= _fields_of(held, f"{name}.") if is_dataclass(held) else {name: repr(held)}
    return flat


def _kept_row(trial: Trial) -> dict[str, Any] | None:
    """The row of a trial that was run to its end before."""
    if trial.folder is None or not (trial.folder / ROW).is_file():
        return None
    path = trial.folder / ROW
    try:
        kept = json.loads(path.read_text())
        row: dict[str, Any] = kept["row"]
        same = kept["facts"] == trial.facts()
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} is damaged ({error!r}); delete it to run the trial again.") from error
    return row if same else None
