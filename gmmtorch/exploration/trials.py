"""Trials: missions run to their end, checkpointed as they go, one after another or several at once."""

from __future__ import annotations

import concurrent.futures
import json
import math
import multiprocessing
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from gmmtorch.errors import DataError, InvalidArgumentError, check_whole
from gmmtorch.evaluation.events import Event, ignore
from gmmtorch.exploration.checkpoint import load_checkpoint, save_checkpoint
from gmmtorch.exploration.mission import Mission
from gmmtorch.exploration.options import TeamOptions
from gmmtorch.exploration.outcome import row_of
from gmmtorch.exploration.team import assemble
from gmmtorch.exploration.world import World, open_world
from gmmtorch.files import write_json, write_npz

CHECKPOINT = "mission.safetensors"
ROW = "row.json"
_PATIENCE = 120.0  # simulated seconds after a mission, for maps to become the same
TRAJECTORIES = "trajectories.npz"

OnSample = Callable[[Mission], None]


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
    between checkpoints; 0: none.
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

    def facts(self) -> dict[str, Any]:
        """What a checkpoint must agree in to go on from it."""
        return {"world": repr(replace(self.world, cache=True)), "team": repr(self.team)}


def run_mission(
    trial: Trial, world: World | None = None, on_sample: OnSample | None = None
) -> tuple[Mission, dict[str, Any]]:
    """Run a trial, from its checkpoint if there is one; returns the mission at its end and its row.

    A mission that was killed goes on from its last checkpoint to the same result.
    """
    world = trial.world.open(trial.team) if world is None else world
    mission = assemble(world, trial.team)
    path = None if trial.folder is None else trial.folder / CHECKPOINT
    wall = 0.0
    if path is not None and path.is_file():
        state = load_checkpoint(path, **trial.facts())
        mission.restore(state["mission"])
        wall = float(state["wall_seconds"])
    begin, every = time.perf_counter() - wall, round(trial.checkpoint_every * trial.team.rate)
    if on_sample is not None:
        on_sample(mission)
    while not mission.is_over:
        mission.step()
        if on_sample is not None and mission.sampled_now:
            on_sample(mission)
        if path is not None and every > 0 and (mission.tick % every == 0 or mission.is_over):
            state = {"mission": mission.state(), "wall_seconds": time.perf_counter() - begin}
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
) -> list[dict[str, Any]]:
    """The rows of trials in their order, run in `workers` processes; those done already are read.

    Every trial has one thread, so that its result does not depend on how many run.
    """
    check_whole("workers", workers, 1)
    rows: list[dict[str, Any] | None] = [_kept_row(trial) for trial in trials]
    missing = [i for i, row in enumerate(rows) if row is None]

    def done(i: int, row: dict[str, Any]) -> None:
        rows[i] = row
        if on_row is not None:
            on_row(row)
        on_event("trials", sum(r is not None for r in rows), len(rows))

    for row in rows:
        if row is not None and on_row is not None:
            on_row(row)
    on_event("trials", len(rows) - len(missing), len(rows))
    if workers == 1:
        for i in missing:
            done(i, _run_one(trials[i]))
    else:
        context = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
        with concurrent.futures.ProcessPoolExecutor(workers, mp_context=context) as pool:
            waiting = {pool.submit(_run_one, trials[i]): i for i in missing}
            for future in concurrent.futures.as_completed(waiting):
                done(waiting[future], future.result())
    return [row for row in rows if row is not None]


def save_trajectories(mission: Mission, path: Path) -> None:
    """Poses (T, 4) of every robot, one a tick, as arrays robot_0, robot_1, … of an npz file."""
    paths = {f"robot_{n}": torch.stack(path).numpy() for n, path in enumerate(mission.trajectories)}
    write_npz(path, **paths)


def _run_one(trial: Trial) -> dict[str, Any]:
    torch.set_num_threads(1)
    mission, row = run_mission(trial)
    if trial.folder is not None:
        save_trajectories(mission, trial.folder / TRAJECTORIES)
        write_json(trial.folder / ROW, {"facts": trial.facts(), "row": row})
        (trial.folder / CHECKPOINT).unlink(missing_ok=True)  # the row says it all
    return row


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
