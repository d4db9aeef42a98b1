"""gmmtorch-explore runs one mission with pictures, or a study of many missions; and their pictures."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from gmmtorch.cli import (
    argument_names,
    as_options,
    chosen_options,
    logger,
    naming,
    print_table,
    run_dir,
    show,
    show_figures,
    surfaces_of,
    write_results,
)
from gmmtorch.errors import check_whole
from gmmtorch.files import write_bytes
from gmmtorch.live import LiveView
from gmmtorch.mapping import Components, GaussianMap
from gmmtorch.occupancy import Box
from gmmtorch.report import (
    Board,
    MapImage,
    ProgressBars,
    Row,
    first_viewpoints,
    highest_occupancy,
    mixture_scene_figure,
)
from gmmtorch.team import report
from gmmtorch.team.cli import from_options
from gmmtorch.team.exploration import (
    NETWORK,
    STAGE,
    THESIS,
    Mission,
    MissionMoments,
    Snapshot,
    Snapshots,
    TeamOptions,
    World,
    compared,
    differing,
    run_mission,
    run_trials,
    variant_of,
)

_NETWORK_TABLE = "wire_bytes bits_per_byte wire_ratio t90_ratio healed_after converged_after"
_TIME_TO_LEAVE = 30.0
"""Simulated seconds after which a robot that only looks around at first has left its start."""


def explore(config: DictConfig, bars: ProgressBars, view: LiveView | None) -> Row:
    """Runs one mission, with pictures; returns its row. In the folder of an equal mission nothing is run."""
    folder = run_dir()
    trial = from_options.trial_of(config, folder)
    shown = as_options(config.report)
    if (row := trial.kept_row(report=shown)) is not None:
        logger.info("%s has this mission already; nothing is run.", folder)
        write_results("explore", config, [row], folder)
        return row
    world = from_options.open_world(trial.world, trial.team, bars)
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
    trial.keep_row(row, report=shown)
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
    check_whole("workers", config.workers, 1)
    variants = from_options.variants_of(config)
    trials = [
        from_options.trial_of(config, folder, variant, seed)
        for seed in config.study.seeds
        for variant in variants
    ]
    # Fills the cache before several processes need the world.
    from_options.open_world(trials[0].world, trials[0].team, bars)
    done: list[Row] = []

    def on_row(row: Row) -> None:
        done.append(row)
        write_results("explore", config, compared(done), folder)

    def on_sample(mission: Mission) -> None:
        bars.note(STAGE, _status(mission))

    with naming(argument_names(TeamOptions)):
        rows = compared(run_trials(trials, config.workers, on_row, bars, on_sample))
    write_results("explore", config, rows, folder)
    save_comparison(config, rows, folder)
    return rows


def print_rows(rows: Sequence[Row], columns: Sequence[str]) -> None:
    """Prints the table. Rows of several variants have a name each, and the columns of networks if these
    differ."""
    title = f"{rows[0]['world']}: {rows[0]['n_robots']} robots"
    if fields := differing(rows):
        rows = [{"variant": name, **row} for name, group in report.by_variant(rows).items() for row in group]
        named = [name for name in columns if name not in ("framework", "planner")]
        columns = ["variant", *named, *(_NETWORK_TABLE.split() if {*fields} & {*NETWORK} else ())]
    print_table(rows, columns, title)


_HALF_BAND = 0.6  # metres above and below the first robot's start that maps from above show


class MissionRecorder:
    """Records what the pictures of one mission need while it runs, and draws them at its end.

    Scalars go to TensorBoard while the mission runs.

    Attributes:
        snapshots: of the team's map; to be updated after each tick.
    """

    def __init__(self, config: DictConfig, folder: Path, world: World) -> None:
        self._config, self._folder, self._world = config, folder, world
        self._board = Board(folder / "tensorboard") if config.report.tensorboard else None
        self._components: Components | None = None  # at the mission's end
        self.snapshots = Snapshots(self._content)

    def sample(self, mission: Mission) -> None:
        """Records a mission whose curves have just grown."""
        if self._board is not None:
            curves = dict(mission.score.samples)
            times, robots = curves.pop("times"), curves.pop("entropy_bits_per_robot")
            curves |= {f"robot_{number}/entropy_bits": curve for number, curve in enumerate(robots)}
            step = int(times[-1])
            self._board.scalars({name: curve[-1] for name, curve in curves.items()}, "mission", step=step)
            paths = {f"robot_{robot.number}/path_length": robot.path_length for robot in mission.robots}
            self._board.scalars(paths, "mission", step=step)
        if mission.is_over:
            self._components = mission.robots[0].mapper.components()

    def finish(self, mission: Mission, row: dict[str, Any]) -> None:
        """Draws everything, saves the mixture, and closes TensorBoard.

        The mixture is that of the mission's end, as in the row; robots may have exchanged more since then.
        """
        paths = [torch.stack(path) for path in mission.trajectories]

        mission.save_trajectories(self._folder)
        components = self._components
        if components is not None and len(components):
            made = GaussianMap.of(components, resolution=self._world.resolution, codec="quantized")
            made.save(self._folder / "map.safetensors")
        figures = self._figures(mission, row, paths, components)
        show_figures(self._config, figures, self._folder, self._board)
        if self._board is not None:
            for snapshot in self.snapshots.chosen():
                seconds = int(snapshot.tick * mission.tick_seconds)
                if "means" in snapshot.content:
                    mixture = (snapshot.content["means"], snapshot.content["covariances"])
                    self._board.ellipsoids("mixture", *mixture, step=seconds)
                self._board.paths("paths", [path[: snapshot.tick + 1] for path in paths], step=seconds)
            # The curves are there already; numbers of a curve's name are its last values.
            numbers = {k: v for k, v in row.items() if k not in mission.score.samples}
            self._board.scalars(numbers, "result", step=int(row["times"][-1]))
            numbers = {name: row[name] for name in ("entropy_reduction_bits", "auc", "bytes_sent")}
            self._board.hparams(chosen_options(self._config), numbers)
            self._board.close()
        if self._config.report.recording:
            period = mission.tick_seconds
            maps = {snapshot.tick * period: snapshot.content for snapshot in self.snapshots.taken}
            report.record_rerun(
                self._folder / "mission.rrd",
                paths,
                period=period,
                maps=maps,
                resolution=self._world.resolution,
                row=row,
            )

    def _content(self, mission: Mission) -> dict[str, Any]:
        """The team's map for pictures: seen from above, as components, and as cells for the recording."""
        content = {"image": _team_view(mission).image.float()}
        surfaces = _surfaces(mission.robots[0].mapper.components())
        if surfaces is not None:
            content["means"] = surfaces.means.float()
            content["covariances"] = surfaces.covariances.float()
            content["owners"] = surfaces.ids[:, 0]
        if self._config.report.recording:
            stored = mission.score.union.grid.cells()
            rule = mission.score.union.rule
            occupied = rule.probability(stored.hits, stored.misses) > rule.occupied
            content["cells"] = stored.cells[occupied].int().cpu()
        return content

    def _snapshot(self, mission: Mission, snapshot: Snapshot, paths: list[Tensor]) -> report.TeamSnapshot:
        """A snapshot for the picture of the team's map, with the components in the band of heights."""
        shown: dict[str, Any] = {}
        if "means" in snapshot.content:
            low, high = _band(mission)
            heights = snapshot.content["means"][:, 2]
            within = (heights > low) & (heights < high)
            shown = {name: snapshot.content[name][within] for name in ("means", "covariances", "owners")}
        return report.TeamSnapshot(
            snapshot.tick * mission.tick_seconds,
            _team_view(mission)._replace(image=snapshot.content["image"]),
            [path[: snapshot.tick + 1] for path in paths],
            caption=f"{100 * snapshot.bits / mission.score.union.observable_bits:.0f} % of entropy removed",
            **shown,
        )

    def _figures(
        self, mission: Mission, row: dict[str, Any], paths: list[Tensor], components: Components | None
    ) -> dict[str, Any]:
        if not (self._config.report.figures or self._config.report.tensorboard):
            return {}
        figures = {
            "entropy": report.entropy_figure([row]),
            "trajectories": report.trajectories_figure(_world_view(mission), paths, _coverage(mission)),
            "team_map": report.team_map_figure(
                [self._snapshot(mission, snapshot, paths) for snapshot in self.snapshots.chosen()],
                belief=mission.score.union.rule,
            ),
        }
        if row["bytes_sent"]:
            figures["bandwidth"] = report.bandwidth_figure([row], draco_error=mission.options.frame.noise)
        surfaces = _surfaces(components)
        if surfaces is not None:
            figures["mixture"] = mixture_scene_figure(
                surfaces.means, surfaces.covariances, seen_from=first_viewpoints(surfaces), trajectories=paths
            )
        return figures


def save_comparison(config: DictConfig, rows: list[dict[str, Any]], folder: Path) -> None:
    """Writes a study's summary and pictures: curves with bands over seeds, and bars.

    If teams ran on several networks, one picture compares these, and all others show the first network. If
    they learned in several ways, one picture compares these, and all others show the first way.
    """
    write_bytes(folder / "summary.md", report.study_summary(rows).encode())
    on_first, on_several = _by_first(rows, NETWORK)
    shown, _ = _by_first(on_first, THESIS)

    def figures() -> dict[str, Any]:
        found: dict[str, Any] = {}
        if on_several:
            found["loss"] = report.loss_figure(on_several)
        if len(shown) < len(on_first):
            found["deviations"] = report.deviations_figure(on_first)
        if len({row["framework"] for row in rows}) > 1:
            found |= {
                "entropy": report.entropy_figure(shown),
                "bandwidth": report.bandwidth_figure(shown),
                "summary": report.summary_bars(shown),
            }
        elif len(shown) == len(rows) or differing(on_first, without=[*NETWORK, *THESIS]):
            found["planners"] = report.planner_comparison_figure(on_first)
        return found

    show(config, folder, figures, lambda board: report.write_exploration_board(board, rows))


def _by_first(
    rows: list[dict[str, Any]], fields: Collection[str]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The rows of each framework with the first values of `fields`; and all rows of the frameworks that have
    several."""
    values: dict[str, dict[Any, None]] = {}  # as an ordered set
    for row in rows:
        values.setdefault(row["framework"], {})[variant_of(row, tuple(fields))] = None
    first = [row for row in rows if variant_of(row, tuple(fields)) == next(iter(values[row["framework"]]))]
    return first, [row for row in rows if len(values[row["framework"]]) > 1]


def _surfaces(components: Components | None) -> Components | None:
    """The components of surfaces; None if there are none."""
    found = None if components is None else surfaces_of(components)
    return found if found is not None and len(found) else None


def _band(mission: Mission) -> tuple[float, float]:
    """Heights (m) that maps from above show, around the first robot's start."""
    height = float(mission.trajectories[0][0][2])
    return height - _HALF_BAND, height + _HALF_BAND


def _layers(mission: Mission) -> tuple[int, int]:
    """The same as a range of layers of the world's box; the end is exclusive."""
    world = mission.world
    first, last = (round(z / world.resolution - float(world.box.low[2])) for z in _band(mission))
    return max(0, first), min(world.box.shape[2], max(first + 1, last))


def _view(mission: Mission, probability: Any) -> MapImage:
    low = mission.world.box.low.clone()
    low[2] += _layers(mission)[0]
    return highest_occupancy(probability, low.double() * mission.world.resolution, mission.world.resolution)


def _team_view(mission: Mission) -> MapImage:
    """The team's map from above, in the band of heights."""
    box, (first, last) = mission.world.box, _layers(mission)
    low, high = box.low.clone(), box.high.clone()
    low[2], high[2] = box.low[2] + first, box.low[2] + last
    hits, misses = (counts.cpu() for counts in mission.score.union.grid.dense(Box(low, high)))
    return _view(mission, mission.score.union.rule.probability(hits, misses))


def _world_view(mission: Mission) -> MapImage:
    """The true world from above, in the same band: occupied, free, or not observable."""
    first, last = _layers(mission)
    world = mission.world
    truth = world.occupied[:, :, first:last].float()
    return _view(mission, truth.masked_fill(~world.observable[:, :, first:last], 0.5))


def _coverage(mission: Mission) -> Any:
    """The number of robots that saw each column (nx, ny) in the band."""
    first, last = _layers(mission)
    seen = mission.score.seen_by.cpu().view(mission.world.box.shape)[:, :, first:last]
    bits = torch.zeros(seen.shape[:2], dtype=torch.int64)
    for robot in mission.robots:
        bits += ((seen >> robot.number) & 1).any(2)
    return bits
