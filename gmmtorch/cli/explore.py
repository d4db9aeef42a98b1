"""gmmtorch-explore: a team of robots explores a simulated world and maps it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from omegaconf import DictConfig

from gmmtorch.cli import common, missions, schema

if TYPE_CHECKING:
    from gmmtorch.exploration.mission.mission import Mission
    from gmmtorch.exploration.mission.pace import Pace
    from gmmtorch.report.progress import ProgressBars

_TABLE = (
    "framework seed planner t50 t90 entropy_reduction_bits bytes_sent bytes_raw_points auc "
    "cross_entropy_bits map_disagreement coverage_per_metre path_length collisions wall_seconds"
)
_TIME_TO_LEAVE = 30.0  # simulated seconds: one that looks around first has long gone by then
_NETWORK_TABLE = "wire_bytes bits_per_byte wire_ratio t90_ratio healed_after converged_after"


def main() -> None:
    """Entry point of the command."""
    schema.register()
    hydra.main(version_base="1.3", config_path=common.conf_dir(), config_name="explore")(_guarded)()


def _guarded(config: DictConfig) -> float | None:
    return common.run_guarded(run, config)


def run(config: DictConfig) -> float | None:
    """One run; returns the entropy reduction (bits) of the last mission, to be optimised over."""
    from gmmtorch.errors import InvalidArgumentError
    from gmmtorch.report.progress import ProgressBars

    if common.set_up(config) != "cpu":
        raise InvalidArgumentError(
            f"runtime.device={config.runtime.device} is not for exploring, which runs on the cpu."
        )
    if config.transport != "in_process":
        raise InvalidArgumentError(
            f"transport={config.transport!r} is not one of in_process; gmmtorch-team has the others."
        )
    if config.report.recording:
        from gmmtorch.report.exploration.rerun_recording import load_rerun

        load_rerun()  # before there is anything to record
    folder = common.run_dir()
    with ProgressBars(enabled=config.report.progress) as bars:
        work = _explore if config.study is None else _compare
        rows = work(config, folder, bars)
    _print_rows(rows)
    common.print_files(folder, folder / "results.json")
    return float(rows[-1]["entropy_reduction_bits"])


def _explore(config: DictConfig, folder: Path, bars: ProgressBars) -> list[dict[str, Any]]:
    """One mission, shown as it goes."""
    from gmmtorch.cli.explore_pictures import MissionRecorder
    from gmmtorch.exploration.mission.pace import pace_of
    from gmmtorch.exploration.mission.trials import STAGE, run_mission

    trial = missions.trial_of(config, folder)
    missions.tell_what_begins_anew(config, [trial])
    world = missions.open_world(trial.world, trial.team, bars)
    recorder = MissionRecorder(config, folder, world)

    def on_sample(mission: Mission) -> None:
        bars.note(STAGE, _status(pace_of(mission)))
        bars(STAGE, round(mission.now), round(trial.team.duration))
        recorder.sample(mission)

    with common.naming(missions.NAMES):
        mission, row = run_mission(trial, world, on_sample, recorder.album)
    rows = _compared([row])
    common.write_results("explore", config, rows, folder)
    recorder.finish(mission, rows[0])
    tell_who_stayed(mission)
    return rows


def tell_who_stayed(mission: Mission) -> None:
    """In the log, which robots never left their start though they had the time: there is no other sign."""
    stayed = [str(robot.number) for robot in mission.robots if robot.path_length == 0]
    if stayed and mission.now >= _TIME_TO_LEAVE:
        common.logger.warning(
            "Robots that never left where they started: %s. Nothing that led anywhere looked safe there. "
            "Move them by team.start, or take finer cells (world.resolution) or a smaller robot.radius.",
            ", ".join(stayed),
        )


def _status(pace: Pace) -> str:
    """Entropy left, bytes sent and how fast it goes, for the progress bar."""
    speed = f", {pace.speed:.1f}x real time" if pace.speed > 0 else ""
    return f"{pace.entropy_left:.1%} of the entropy left, {pace.n_bytes / 1e3:,.0f} kB sent{speed}"


def _compare(config: DictConfig, folder: Path, bars: ProgressBars) -> list[dict[str, Any]]:
    """Every variant of a study with every seed."""
    from gmmtorch.cli.explore_pictures import save_comparison
    from gmmtorch.errors import check_whole
    from gmmtorch.exploration.mission.trials import STAGE, run_trials

    check_whole("runtime.workers", config.runtime.workers, 1)
    variants = missions.variants_of(config)
    trials = [
        missions.trial_of(config, folder, variant, seed)
        for seed in config.study.seeds
        for variant in variants
    ]
    missions.tell_what_begins_anew(config, trials)
    # Into the cache, before several ask for it at once.
    missions.open_world(trials[0].world, trials[0].team, bars)
    done: list[dict[str, Any]] = []

    def keep(row: dict[str, Any]) -> None:
        done.append(row)
        common.write_results("explore", config, _compared(done), folder)

    def show(pace: Pace) -> None:
        bars.note(STAGE, _status(pace))

    with common.naming(missions.NAMES):
        rows = _compared(run_trials(trials, config.runtime.workers, keep, bars, show))
    common.write_results("explore", config, rows, folder)
    save_comparison(config, rows, folder)
    return rows


def _print_rows(rows: list[dict[str, Any]]) -> None:
    """The table; of several variants each has a name, and what networks cost is told where they differ."""
    from gmmtorch.exploration.mission.variants import NETWORK, differing

    columns = _TABLE.split()
    title = f"{rows[0]['world']}: {rows[0]['n_robots']} robots"
    if fields := differing(rows):
        from gmmtorch.report.exploration.trial_groups import by_variant

        rows = [{"variant": name, **row} for name, group in by_variant(rows).items() for row in group]
        named = [name for name in columns if name not in ("framework", "planner")]
        columns = ["variant", *named, *(_NETWORK_TABLE.split() if {*fields} & {*NETWORK} else ())]
    common.print_table(rows, columns, title)


def _compared(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with what only those beside them tell."""
    from gmmtorch.exploration.mission.mission_results import with_times
    from gmmtorch.exploration.mission.network_results import with_network_costs

    return with_network_costs(with_times(rows))


if __name__ == "__main__":
    main()
