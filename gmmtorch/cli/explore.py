"""gmmtorch-explore: a team of robots explores a simulated world and maps it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from gmmtorch.cli import app, common
from gmmtorch.cli.from_options import missions
from gmmtorch.cli.view import open_live_view, serve

if TYPE_CHECKING:
    from gmmtorch.exploration.mission.mission import Mission
    from gmmtorch.live.live_view import LiveView
    from gmmtorch.report.progress import ProgressBars

TABLE = (
    "framework seed planner t50 t90 entropy_reduction_bits bytes_sent bytes_raw_points auc "
    "cross_entropy_bits map_disagreement coverage_per_metre path_length collisions wall_seconds"
)
_NETWORK_TABLE = "wire_bytes bits_per_byte wire_ratio t90_ratio healed_after converged_after"
_TIME_TO_LEAVE = 30.0
"""Simulated seconds after which a robot that only looks around at first has left its start."""


def main() -> None:
    """Entry point of the command."""
    app.start("explore", run)


def run(config: DictConfig) -> float | None:
    """Runs a mission or a study; returns the entropy reduction (bits) of the last mission, for optimizers."""
    from gmmtorch.report.progress import ProgressBars

    _check_options(config)
    if config.report.recording:
        from gmmtorch.report.exploration.rerun_recording import load_rerun

        load_rerun()  # fails before the mission, not after it
    folder = common.run_dir()
    view = open_live_view(config)
    with ProgressBars(enabled=config.report.progress) as bars:
        rows = (
            _explore(config, folder, bars, view) if config.study is None else _compare(config, folder, bars)
        )
    _print_rows(rows)
    common.print_files(folder, folder / "results.json")
    if view is not None:
        serve(view)
    return float(rows[-1]["entropy_reduction_bits"])


def _check_options(config: DictConfig) -> None:
    from gmmtorch.errors import InvalidArgumentError

    common.set_up(config)
    if config.transport != "in_process":
        raise InvalidArgumentError(
            f"transport={config.transport!r} is not in_process, the only transport of gmmtorch-explore; "
            "gmmtorch-team has others."
        )
    if config.view and config.study is not None:
        raise InvalidArgumentError("view=true shows one mission, not those of a study; leave out experiment.")
    for name, value in config.checkpoint.items():
        if value is not None:
            raise InvalidArgumentError(
                f"checkpoint.{name}={value} was removed: missions have no checkpoints. A study that was "
                "killed continues with the missions that are missing if you run the same command with "
                "hydra.run.dir=RUN, the folder of the killed run."
            )


def _explore(
    config: DictConfig, folder: Path, bars: ProgressBars, view: LiveView | None
) -> list[dict[str, Any]]:
    """One mission, with pictures; it is not run again in the folder of an equal run."""
    from gmmtorch.cli.reporting.explore_pictures import MissionRecorder
    from gmmtorch.exploration.mission.results import compared
    from gmmtorch.exploration.mission.trials import STAGE, keep_row, kept_row, run_mission

    trial = missions.trial_of(config, folder)
    report = common.as_options(config.report)
    if (row := kept_row(trial, report=report)) is not None:
        common.logger.info("%s has this mission already; nothing is run.", folder)
        common.write_results("explore", config, [row], folder)
        return [row]
    world = missions.open_world(trial.world, trial.team, bars)
    recorder = MissionRecorder(config, folder, world)
    show = _shower(view)

    def on_tick(mission: Mission) -> None:
        if mission.n_ticks:
            recorder.snapshots.update(mission)
        if mission.has_sampled:
            bars.note(STAGE, _status(mission))
            bars(STAGE, round(mission.elapsed), round(trial.team.duration))
            recorder.sample(mission)
        show(mission)

    with common.naming(missions.NAMES):
        mission, row = run_mission(trial, world, on_tick)
    (row,) = compared([row])
    common.write_results("explore", config, [row], folder)
    recorder.finish(mission, row)
    keep_row(trial, row, report=report)
    warn_of_robots_at_their_start(mission)
    return [row]


def _shower(view: LiveView | None) -> Callable[[Mission], None]:
    """What shows a mission after each tick; without a view it does nothing."""
    if view is None:
        return lambda mission: None
    from gmmtorch.live.live_moments import MissionMoments

    known: list[MissionMoments] = []

    def show(mission: Mission) -> None:
        if not known:
            known.append(MissionMoments(mission))
        (moments,) = known
        if mission.has_sampled:
            moments.note()
        if mission.is_over:
            view.finish(moments)
        else:
            view.offer(moments)

    return show


def warn_of_robots_at_their_start(mission: Mission) -> None:
    """Warns of robots that never left their start though they had the time: nothing else shows it."""
    stayed = [str(robot.number) for robot in mission.robots if robot.path_length == 0]
    if stayed and mission.elapsed >= _TIME_TO_LEAVE:
        common.logger.warning(
            "Robots that never left their start: %s. No path away from there is safe. Move them by "
            "team.start, or use smaller cells (world.resolution) or a smaller robot.radius.",
            ", ".join(stayed),
        )


def _status(mission: Mission) -> str:
    """Entropy left, bytes sent and speed, for the progress bar."""
    union, seconds = mission.score.union, sum(mission.watch.seconds.values())
    left = union.entropy_bits / max(1.0, union.observable_bits)
    speed = f", {mission.elapsed / seconds:.1f}x real time" if mission.elapsed and seconds else ""
    return f"{left:.1%} of the entropy left, {mission.network.traffic().bytes / 1e3:,.0f} kB sent{speed}"


def _compare(config: DictConfig, folder: Path, bars: ProgressBars) -> list[dict[str, Any]]:
    """A study: every variant with every seed."""
    from gmmtorch.cli.reporting.explore_pictures import save_comparison
    from gmmtorch.errors import check_whole
    from gmmtorch.exploration.mission.results import compared
    from gmmtorch.exploration.mission.trials import STAGE, run_trials

    check_whole("runtime.workers", config.runtime.workers, 1)
    variants = missions.variants_of(config)
    trials = [
        missions.trial_of(config, folder, variant, seed)
        for seed in config.study.seeds
        for variant in variants
    ]
    # Fills the cache before several processes need the world.
    missions.open_world(trials[0].world, trials[0].team, bars)
    done: list[dict[str, Any]] = []

    def on_row(row: dict[str, Any]) -> None:
        done.append(row)
        common.write_results("explore", config, compared(done), folder)

    def on_sample(mission: Mission) -> None:
        bars.note(STAGE, _status(mission))

    with common.naming(missions.NAMES):
        rows = compared(run_trials(trials, config.runtime.workers, on_row, bars, on_sample))
    common.write_results("explore", config, rows, folder)
    save_comparison(config, rows, folder)
    return rows


def _print_rows(rows: list[dict[str, Any]]) -> None:
    """Prints the table. Rows of several variants have a name each, and the columns of networks if these
    differ."""
    from gmmtorch.exploration.mission.results import NETWORK, differing

    columns = TABLE.split()
    title = f"{rows[0]['world']}: {rows[0]['n_robots']} robots"
    if fields := differing(rows):
        from gmmtorch.report.exploration.trial_groups import by_variant

        rows = [{"variant": name, **row} for name, group in by_variant(rows).items() for row in group]
        named = [name for name in columns if name not in ("framework", "planner")]
        columns = ["variant", *named, *(_NETWORK_TABLE.split() if {*fields} & {*NETWORK} else ())]
    common.print_table(rows, columns, title)


if __name__ == "__main__":
    main()
