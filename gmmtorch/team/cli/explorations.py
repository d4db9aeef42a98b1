"""gmmtorch-explore runs one mission with pictures, or a study of many missions."""

from __future__ import annotations

from collections.abc import Sequence

from omegaconf import DictConfig

from gmmtorch.cli import argument_names, as_options, logger, naming, print_table, run_dir, write_results
from gmmtorch.errors import check_whole
from gmmtorch.live import LiveView
from gmmtorch.report import ProgressBars, Row
from gmmtorch.team.cli.explore_pictures import MissionRecorder, save_comparison
from gmmtorch.team.cli.from_options import missions
from gmmtorch.team.exploration import (
    NETWORK,
    STAGE,
    Mission,
    MissionMoments,
    TeamOptions,
    compared,
    differing,
    run_mission,
    run_trials,
)
from gmmtorch.team.report import by_variant

_NETWORK_TABLE = "wire_bytes bits_per_byte wire_ratio t90_ratio healed_after converged_after"
_TIME_TO_LEAVE = 30.0
"""Simulated seconds after which a robot that only looks around at first has left its start."""


def explore(config: DictConfig, bars: ProgressBars, view: LiveView | None) -> Row:
    """Runs one mission, with pictures; returns its row. In the folder of an equal mission nothing is run."""
    folder = run_dir()
    trial = missions.trial_of(config, folder)
    report = as_options(config.report)
    if (row := trial.kept_row(report=report)) is not None:
        logger.info("%s has this mission already; nothing is run.", folder)
        write_results("explore", config, [row], folder)
        return row
    world = missions.open_world(trial.world, trial.team, bars)
    recorder = MissionRecorder(config, folder, world)
    moments: MissionMoments | None = None

    def on_tick(mission: Mission) -> None:
        nonlocal moments
        if mission.n_ticks:
            recorder.snapshots.update(mission)
        if mission.has_sampled:
            bars.note(STAGE, _status(mission))
            bars(STAGE, round(mission.elapsed), round(trial.team.duration))
            recorder.sample(mission)
        if view is not None:
            moments = moments or MissionMoments(mission)
            if mission.has_sampled:
                moments.note()
            (view.finish if mission.is_over else view.offer)(moments)

    with naming(argument_names(TeamOptions)):
        mission, row = run_mission(trial, world, on_tick)
    (row,) = compared([row])
    write_results("explore", config, [row], folder)
    recorder.finish(mission, row)
    trial.keep_row(row, report=report)
    warn_of_robots_at_their_start(mission)
    return row


def warn_of_robots_at_their_start(mission: Mission) -> None:
    """Warns of robots that never left their start though they had the time: nothing else shows it."""
    stayed = [str(robot.number) for robot in mission.robots if robot.path_length == 0]
    if stayed and mission.elapsed >= _TIME_TO_LEAVE:
        logger.warning(
            "Robots that never left their start: %s. No path away from there is safe. Move them by "
            "team.start, or use smaller cells (world.resolution).",
            ", ".join(stayed),
        )


def _status(mission: Mission) -> str:
    """Entropy left, bytes sent and speed, for the progress bar."""
    union, seconds = mission.score.union, sum(mission.watch.seconds.values())
    left = union.entropy_bits / max(1.0, union.observable_bits)
    speed = f", {mission.elapsed / seconds:.1f}x real time" if mission.elapsed and seconds else ""
    return f"{left:.1%} of the entropy left, {mission.network.traffic().bytes / 1e3:,.0f} kB sent{speed}"


def compare(config: DictConfig, bars: ProgressBars) -> list[Row]:
    """Runs a study, every variant with every seed; returns its rows."""
    folder = run_dir()
    check_whole("runtime.workers", config.runtime.workers, 1)
    variants = missions.variants_of(config)
    trials = [
        missions.trial_of(config, folder, variant, seed)
        for seed in config.study.seeds
        for variant in variants
    ]
    # Fills the cache before several processes need the world.
    missions.open_world(trials[0].world, trials[0].team, bars)
    done: list[Row] = []

    def on_row(row: Row) -> None:
        done.append(row)
        write_results("explore", config, compared(done), folder)

    def on_sample(mission: Mission) -> None:
        bars.note(STAGE, _status(mission))

    with naming(argument_names(TeamOptions)):
        rows = compared(run_trials(trials, config.runtime.workers, on_row, bars, on_sample))
    write_results("explore", config, rows, folder)
    save_comparison(config, rows, folder)
    return rows


def print_rows(rows: Sequence[Row], columns: Sequence[str]) -> None:
    """Prints the table. Rows of several variants have a name each, and the columns of networks if these
    differ."""
    title = f"{rows[0]['world']}: {rows[0]['n_robots']} robots"
    if fields := differing(rows):
        rows = [{"variant": name, **row} for name, group in by_variant(rows).items() for row in group]
        named = [name for name in columns if name not in ("framework", "planner")]
        columns = ["variant", *named, *(_NETWORK_TABLE.split() if {*fields} & {*NETWORK} else ())]
    print_table(rows, columns, title)
