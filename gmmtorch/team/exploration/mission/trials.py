"""Trials: missions that are built and run to their end, one by one or in parallel; their rows are kept."""

from __future__ import annotations

import concurrent.futures.process
import functools
import hashlib
import json
import math
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gmmtorch import __version__
from gmmtorch.errors import DAMAGED_CONTENT, DataError, GmmTorchError, InvalidArgumentError, check_whole
from gmmtorch.files import check_writable, write_json
from gmmtorch.occupancy import RollingWindow
from gmmtorch.processes import end_with_parent
from gmmtorch.report import Event, ignore
from gmmtorch.team.exploration.mission.driver import SimulatedClock, Stopwatch, drive
from gmmtorch.team.exploration.mission.mission import Mission, MissionScore
from gmmtorch.team.exploration.mission.options import TeamOptions, WorldOptions
from gmmtorch.team.exploration.mission.results import mission_row
from gmmtorch.team.exploration.planning.planners import PLANNERS
from gmmtorch.team.exploration.planning.primitives import Primitives
from gmmtorch.team.exploration.planning.view_evaluator import ViewEvaluator
from gmmtorch.team.exploration.robot.agent import Agent, Robot
from gmmtorch.team.exploration.robot.mapper import GmmMapper, GridMapper, Mapper, Memo
from gmmtorch.team.exploration.world import starts
from gmmtorch.team.exploration.world.scoring import BeliefMap
from gmmtorch.team.exploration.world.world import World
from gmmtorch.team.sharing import Broadcast, Network, Replica, Transport

_SLACK = 24
"""Cells by which the sliding map moves, once the robot is so far from its centre. Rays are long: a map that
is filled in wide slabs casts each ray far less often. Planners read a smaller window around the robot."""
_ROUNDING = 4  # cells by which the planner's window may be off the robot
_CACHED_MESSAGES = 4096
"""Decoded datagrams in the cache of a simulated team: more than are in flight together."""
_CACHED_MESSAGES_ALONE = 64
"""The same for a robot in its own process, where a stranger's messages may be large."""
_CACHED_EVIDENCE = 16
"""Batches of evidence in the cache, per robot. They are large; this covers the last dozen seconds."""


def assemble(world: World, options: TeamOptions, watch: Stopwatch | None = None) -> Mission:
    """A mission of a simulated team with its network and its score. Raises `InvalidArgumentError` for options
    that contradict each other or the world.

    watch: times the stages of all robots together; None: wall time.
    """
    poses = start_poses(world, options)
    network = Network(options.size, options, seed=options.seed)
    memo, evidence = Memo(_CACHED_MESSAGES), Memo(_CACHED_EVIDENCE * options.size)
    watch = Stopwatch() if watch is None else watch
    agents = [
        make_agent(number, poses[number], world, options, network, memo, evidence, watch)
        for number in range(options.size)
    ]
    score = MissionScore(world, agents, network, options)
    return Mission(world, agents, options, watch, network, score)


def start_poses(world: World, options: TeamOptions) -> Tensor:
    """The start poses (size, 4): x, y, z, yaw. Raises `InvalidArgumentError` where robots cannot start."""
    primitives = Primitives(options.dynamics)
    if options.start is None:
        return starts.start_poses(world, options.size, primitives)
    poses = torch.tensor(options.start, dtype=torch.float64)
    if poses.shape != (options.size, 4):
        raise InvalidArgumentError(
            f"‹start› has shape {tuple(poses.shape)}; expected a pose x, y, z, yaw for each of "
            f"{options.size} robots."
        )
    return starts.check_start(world, poses, primitives)


def make_agent(
    number: int,
    pose: Tensor,
    world: World,
    options: TeamOptions,
    transport: Transport,
    memo: Memo | None = None,
    evidence: Memo | None = None,
    watch: Stopwatch | None = None,
    incarnation: int = 0,
) -> Agent:
    """A robot at its start pose (4,).

    memo, evidence: caches of decoded datagrams and of evidence, and watch: the robots of a simulation share
    them; None: its own. incarnation: of its replica and view library. A robot that may be restarted needs
    another one in each session (`record_keys.drawn_incarnation`).

    Raises `InvalidArgumentError` for options that contradict each other or the world.
    """
    options = _with_window(options, world.resolution)
    memo = Memo(_CACHED_MESSAGES_ALONE) if memo is None else memo
    evidence = Memo(_CACHED_EVIDENCE) if evidence is None else evidence
    camera = options.camera
    evaluator = ViewEvaluator(
        camera.horizontal_fov,
        camera.vertical_fov,
        camera.max_range,
        world.resolution,
        information=options.information,
        n_beams=options.n_beams,
        device=options.device,
    )
    primitives = Primitives(options.dynamics)
    start = starts.initial_free_space(world, pose[:3].double(), primitives)
    if start is None:
        raise InvalidArgumentError(
            f"pose={pose.tolist()} is a place from which a robot cannot take off; choose another."
        )
    robot = Robot(
        number,
        pose,
        _mapper(number, world, options, memo, evidence, incarnation),
        PLANNERS[options.planner](primitives, evaluator),
        start,
        options.rest,
        incarnation,
    )
    watch = Stopwatch() if watch is None else watch
    return Agent(robot, transport, evaluator, primitives, options, memo, watch)


def _with_window(options: TeamOptions, resolution: float) -> TeamOptions:
    """The options with a window that contains the camera's whole field of view."""
    camera = options.camera
    far = (camera.max_range, camera.max_range, camera.max_range * math.sin(camera.vertical_fov / 2))
    x, y, z = (
        max(n, 2 * (math.ceil(sight / resolution) + _ROUNDING))
        for n, sight in zip(options.window, far, strict=True)
    )
    return replace(options, window=(x, y, z))


def _mapper(
    number: int, world: World, options: TeamOptions, memo: Memo, evidence: Memo, incarnation: int
) -> Mapper:
    x, y, z = (n + 2 * (_SLACK + _ROUNDING) for n in options.window)
    local = RollingWindow(world.resolution, (x, y, z), _SLACK, options.device)
    belief = BeliefMap(world.resolution, world.box, world.observable, options.belief, options.device)
    if not options.has_mixtures:
        return GridMapper(number, local, belief, options, evidence, memo.decoded)
    if options.codec == "quantized":
        replica = Replica(number, dim=3, incarnation=incarnation)
        return GmmMapper(local, belief, options, evidence, replica)
    return GmmMapper(local, belief, options, evidence, Broadcast(number, options.codec))


ROW = "row.json"
STAGE = "simulated seconds"
_CONVERGENCE = 120.0  # simulated seconds after a mission in which the maps may become equal

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

    def kept_row(self, **more: Any) -> dict[str, Any] | None:
        """The row that `keep_row` kept for an equal trial with the same `more` facts; None: there is none."""
        if self.folder is None or not (self.folder / ROW).is_file():
            return None
        path = self.folder / ROW
        try:
            kept = json.loads(path.read_text("utf-8"))
            row: dict[str, Any] = kept["row"]
            is_same = kept["facts"] == {**self.facts(), **more}
        except DAMAGED_CONTENT as error:
            raise DataError(f"{path} is damaged ({error!r}); delete it to run the trial again.") from error
        return row if is_same else None

    def keep_row(self, row: dict[str, Any], **more: Any) -> None:
        """Keeps the row of the finished trial in its folder, if it has one."""
        if self.folder is not None:
            write_json(self.folder / ROW, {"facts": {**self.facts(), **more}, "row": row})


def run_mission(
    trial: Trial, world: World | None = None, on_tick: OnMission = lambda mission: None
) -> tuple[Mission, dict[str, Any]]:
    """Runs a trial; returns the mission at its end, and its row. Keeps nothing.

    Raises `OutputError`, before anything is computed, if the trial's folder cannot be written to.

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

    on_row: called with each row when it is there. on_event: called with the simulated seconds of all trials
    together (`STAGE`). on_sample: with one worker, then called with the running mission whenever its curves
    grow.
    """
    check_whole("workers", workers, 1)
    rows = [trial.kept_row() for trial in trials]
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


def _run_and_keep(trial: Trial, on_tick: OnMission = lambda mission: None) -> dict[str, Any]:
    torch.set_num_threads(1)
    mission, row = run_mission(trial, on_tick=on_tick)
    if trial.folder is not None:
        mission.save_trajectories(trial.folder)
    trial.keep_row(row)
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
