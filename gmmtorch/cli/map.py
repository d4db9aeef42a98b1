"""gmmtorch-map: builds a map from a recording, and draws and exports it."""

from __future__ import annotations

import functools
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from omegaconf import MISSING, DictConfig

from gmmtorch.cli import app, common, schema
from gmmtorch.cli.view import ViewOptions, open_live_view, serve
from gmmtorch.declarations import group, option
from gmmtorch.errors import InvalidArgumentError, check_resolution
from gmmtorch.report import ProgressBars, byte_text

if TYPE_CHECKING:
    from gmmtorch.cli.reporting.map_outputs import Checkpoint
    from gmmtorch.live import LiveView
    from gmmtorch.mapping import MapBuilder

_STAGE = "mapping"
TABLE = (
    "dataset n_scans n_skipped n_points metres n_components nbytes bytes_per_metre seconds scans_per_second"
)


@dataclass
class MapOptions(ViewOptions):
    """Options of gmmtorch-map."""

    dataset: Any = option(MISSING, "where the scans come from")
    map: Any = option(MISSING, "how the map is built")
    seed: int = option(0, "seed of all random numbers")
    resolution: float = option(0.1, "side (m) of the cells of queries, pictures and exports")
    export: list[str] = option(
        [],
        "list of map_server (a 2D map for ROS), octomap, cloud (occupied cells), mesh (cells of half the "
        "resolution), distance_field",
    )
    z_min: float | None = option(
        None, "lowest height (m) of map_server in 3D; both null: between floor and ceiling"
    )
    z_max: float | None = option(None, "highest height (m) of map_server in 3D")
    checkpoint_seconds: float = option(30.0, "computing time between two checkpoints")
    check: bool = option(
        False, "only report what dataset.path contains, what would be mapped, and which options would help"
    )
    inputs: list[str] = option(
        [], "list of paths, globs and URLs of recordings, in place of dataset.path; maps are merged in tiles"
    )
    tile: float = option(
        100.0, "side (m) of the tiles of map.memory, and of those into which the maps of inputs are merged"
    )
    workers: int = option(1, "processes of this machine that map inputs; more than one needs Ray")
    cluster: str | None = option(
        None, "address of a Ray cluster that maps inputs, such as ray://head:10001; null: this machine"
    )
    report: common.Report = group(common.Report)
    runtime: common.Runtime = group(common.Runtime)


@functools.cache
def register() -> None:
    """Stores the options of the command."""
    schema.register()
    schema.store({"map": schema.schema_of(MapOptions)})


def main() -> None:
    """Entry point of the command."""
    app.start("map", run, register)


def run(config: DictConfig) -> None:
    """Run the command. A run directory that contains a checkpoint of the same run is continued."""
    from gmmtorch.cli import inputs, recordings
    from gmmtorch.cli.reporting import map_outputs
    from gmmtorch.mapping import GaussianMap, MapBuilder

    device, folder = common.set_up(config), common.run_dir()
    check_resolution(config.resolution)
    map_outputs.check_exports(config.export)
    if config.check:
        from gmmtorch.cli.reporting import recording_check

        sys.exit(0 if recording_check.check(config) else 1)
    if config.inputs:
        recordings.run(config)
        return
    dataset, poses, odometry = inputs.open_with_trajectory(config.dataset)
    if config.view and config.map.memory is not None:
        raise InvalidArgumentError(
            "view=true shows a map in memory; with map.memory, use gmmtorch-view afterwards."
        )
    place = folder / ("map.safetensors" if config.map.memory is None else "tiles")
    target = inputs.new_map(config, dataset, place, device, map_outputs.checkpoint_of(folder).exists())
    builder = MapBuilder(dataset, target, device)
    with ProgressBars(enabled=config.report.progress) as bars:
        view = open_live_view(config)
        checkpoint = map_outputs.Checkpoint(config, builder, "dataset", lambda: builder.record.seconds)
        _build(builder, checkpoint, bars, view)
        if isinstance(target, GaussianMap):
            target.save(place)
        trajectory = map_outputs.write_trajectory(builder, folder)
        row = map_outputs.result_row(dataset.name, builder, config, odometry)
        if poses is not None:
            map_outputs.write_estimated_poses(dataset, poses, folder)
        built, exported, errors = map_outputs.write_exports(config, target, folder, bars)
        common.write_results("map", config, [row], folder)
        paths = map_outputs.odometry_figure(dataset, poses, row) if config.report.figures else None
        if built is not None:
            map_outputs.draw(config, built, [trajectory], row, folder, paths)
    checkpoint.remove()
    common.print_table([row], TABLE.split(), f"{dataset.name}: {row['n_scans']} scans")
    map_outputs.print_skipped(builder.skipped)
    print("", f"map       {place}", *exported, sep="\n")
    common.print_files(folder)
    if view is not None:
        serve(view)
    map_outputs.check_exported(config, errors)


def _build(
    builder: MapBuilder[Any], checkpoint: Checkpoint, bars: ProgressBars, view: LiveView | None
) -> None:
    """Inserts all scans. If the user stops the run, writes the checkpoint and ends the command."""
    moments = None
    if view is not None:
        from gmmtorch.live import BuildMoments

        moments = BuildMoments(builder, lambda: builder.progress().nbytes)
    with app.stop_requests() as is_stopped:
        for now in builder.insert_all():
            bars(_STAGE, now.n_read, now.n_total)
            size = f"{now.n_components:,} components, {byte_text(now.nbytes)}"
            bars.note(_STAGE, f"{size}, {now.metres:,.0f} m")
            if moments is not None and view is not None:
                moments.note()
                if builder.map.n_pending == 0:
                    view.offer(moments)
            if now.n_read == now.n_total:
                checkpoint.save()
            elif is_stopped():
                checkpoint.save()
                bars.close()
                print(
                    f"gmmtorch: stopped after scan {now.n_read} of {now.n_total}; the same options with "
                    f"hydra.run.dir={common.run_dir()} continue.",
                    file=sys.stderr,
                )
                sys.exit(130)
            else:
                checkpoint.save_when_due()
    builder.finish()
    if moments is not None and view is not None:
        view.finish(moments)


if __name__ == "__main__":
    main()
