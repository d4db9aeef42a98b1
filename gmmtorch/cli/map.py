"""gmmtorch-map: builds a map from a recording, and draws and exports it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from gmmtorch.cli import app, common
from gmmtorch.cli.from_options import maps
from gmmtorch.cli.recordings import map_recordings
from gmmtorch.cli.reporting import map_outputs
from gmmtorch.cli.view import open_live_view, serve

if TYPE_CHECKING:
    from gmmtorch.live.live_view import LiveView
    from gmmtorch.mapping.map_builder import MapBuilder
    from gmmtorch.report.progress import ProgressBars

_STAGE = "mapping"
_CHECKPOINT = "checkpoint.safetensors"
TABLE = (
    "dataset n_scans n_skipped n_points metres n_components nbytes bytes_per_metre seconds scans_per_second"
)


def main() -> None:
    """Entry point of the command."""
    app.start("map", run)


def run(config: DictConfig) -> None:
    """Run the command. A run directory that contains a checkpoint of the same run is continued."""
    from gmmtorch.errors import GmmTorchError
    from gmmtorch.mapping.map_builder import MapBuilder
    from gmmtorch.occupancy.grid import check_resolution
    from gmmtorch.report.progress import ProgressBars

    device, folder = common.set_up(config), common.run_dir()
    check_resolution(config.resolution)
    map_outputs.check_exports(config)
    if config.inputs:
        map_recordings.run(config)
        return
    dataset, poses, odometry = common.open_with_trajectory(config.dataset)
    target = maps.map_factory(config, resolution=config.resolution)()
    builder = MapBuilder(dataset, target, device)
    with ProgressBars(enabled=config.report.progress) as bars:
        view = open_live_view(config)
        _build(config, builder, folder / _CHECKPOINT, bars, view)
        target.save(folder / "map.safetensors")
        trajectory = map_outputs.write_trajectory(builder, folder)
        row = map_outputs.result_row(dataset.name, builder, config, odometry)
        if poses is not None:
            map_outputs.write_pose_table(dataset, poses, folder)
        exported, errors = map_outputs.write_exports(config, target, folder, bars)
        common.write_results("map", config, [row], folder)
        map_outputs.draw(config, target, [trajectory], row, folder)
    (folder / _CHECKPOINT).unlink(missing_ok=True)
    common.print_table([row], TABLE.split(), f"{dataset.name}: {row['n_scans']} scans")
    for reason, count in builder.skipped.items():
        print(f"skipped   {count} scans: {reason}")
    print(f"\nmap       {folder / 'map.safetensors'}")
    print(*exported, sep="\n", end="\n" if exported else "")
    common.print_files(folder, folder / "results.json")
    if view is not None:
        serve(view)
    if errors:
        raise GmmTorchError(f"not all of export={list(config.export)} was written: {' '.join(errors)}")


def _build(
    config: DictConfig,
    builder: MapBuilder,
    checkpoint: Path,
    bars: ProgressBars,
    view: LiveView | None,
) -> None:
    """Inserts all scans. If the user stops the run, writes the checkpoint and ends the command."""
    import gmmtorch
    from gmmtorch.errors import check_number
    from gmmtorch.report.table import byte_text

    check_number("checkpoint_seconds", config.checkpoint_seconds)
    run_facts = {
        "version": gmmtorch.__version__,
        "dataset": common.as_options(config.dataset),
        "map": common.as_options(config.map),
        "seed": config.seed,
        "dtype": config.runtime.dtype,
    }
    if checkpoint.exists():
        builder.load(checkpoint, run_facts)
        print(f"continues after scan {builder.record.n_read} of {checkpoint}")
    saved = builder.record.seconds
    moments = map_outputs.moments_of(builder) if view is not None else None
    with app.stop_requests() as is_stopped:
        for now in builder.insert_all():
            bars(_STAGE, now.n_read, now.n_total)
            size = f"{now.n_components:,} components, {byte_text(now.nbytes)}"
            bars.note(_STAGE, f"{size}, {now.metres:,.0f} m")
            if moments is not None and view is not None:
                moments.note()
                if builder.map.n_pending == 0:
                    view.offer(moments)
            is_over = now.n_read == now.n_total
            if is_stopped() or is_over or now.seconds - saved >= config.checkpoint_seconds:
                builder.save(checkpoint, run_facts)
                saved = now.seconds
            if is_stopped() and not is_over:
                bars.close()
                print(
                    f"gmmtorch: stopped after scan {now.n_read} of {now.n_total}; the same options with "
                    f"hydra.run.dir={checkpoint.parent} continue.",
                    file=sys.stderr,
                )
                sys.exit(130)
    builder.finish()
    if moments is not None and view is not None:
        view.finish(moments)


if __name__ == "__main__":
    main()
