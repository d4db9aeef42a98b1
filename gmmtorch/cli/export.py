"""gmmtorch-export: writes a map or a mixture in the format of another program."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from gmmtorch.cli import app, common, schema
from gmmtorch.declarations import group, option
from gmmtorch.errors import InvalidArgumentError, check_choice
from gmmtorch.optional_packages import load_pyoctomap
from gmmtorch.report import ProgressBars

_OF_SPACE = ("map_server", "octomap", "ply", "pcd", "mesh", "distance_field")
_OF_COMPONENTS = ("csv", "npz", "mixture", "splats")
_OF_POSES = "kitti"
_OF_ENDINGS = {
    **dict.fromkeys((".yaml", ".pgm"), "map_server"),
    **dict.fromkeys((".bt", ".ot"), "octomap"),
    **dict.fromkeys((".obj", ".glb"), "mesh"),
    ".ply": "ply",
    ".pcd": "pcd",
    ".csv": "csv",
    ".npz": "npz",
    ".safetensors": "mixture",
    ".spz": "splats",
}
"""Formats by the endings of the output, if none is given."""


@dataclass
class ExportOptions:
    """Options of gmmtorch-export."""

    path: str | None = option(
        None,
        "run directory of gmmtorch-map, or map, grid or mixture of gmmtorch (.safetensors), GIRA .csv, .npz; "
        "for kitti a trajectory",
    )
    output: str | None = option(None, "file to write; for octomap its ending selects the format, .bt or .ot")
    format: str | None = option(
        None,
        "map_server, octomap, ply, pcd, mesh, distance_field, csv, npz, mixture, splats (.spz, .ply, .glb), "
        "kitti; null: by the ending of the output",
    )
    method: str | None = option(None, "form of evidence: point, flux, cone, monte_carlo; null: the map's own")
    resolution: float | None = option(None, "side (m) of the cells; null: the map's own")
    bounds: list[float] | None = option(
        None, "[x0,y0,x1,y1], in 3D [x0,y0,z0,x1,y1,z1] (m); null: around the components"
    )
    z_min: float | None = option(
        None, "lowest height (m); both null: for map_server, between the floor and the ceiling of a 3D map"
    )
    z_max: float | None = option(None, "highest height (m)")
    occupied_thresh: float = option(
        0.65, "cells above this probability are occupied; those below 0.196, as in ROS, are free"
    )
    report: common.Progress = group(common.Progress)
    runtime: common.Memory = group(common.Memory)


@functools.cache
def register() -> None:
    """Stores the options of the command."""
    schema.store({"export": schema.schema_of(ExportOptions)})


def main() -> None:
    """Entry point of the command."""
    app.start("export", run, register)


def run(config: DictConfig) -> None:
    """Run the command; prints the written files."""
    for name in ("path", "output"):
        if not config[name]:
            raise InvalidArgumentError(f"{name} is not set; give {name}=FILE.")
    config.format = _format(config)
    from gmmtorch.cli.reporting import exported_files  # takes seconds, so options are checked first

    if config.format == "octomap":
        load_pyoctomap()  # before the cells are computed
    common.use_runtime(config.runtime)
    with ProgressBars(enabled=config.report.progress) as bars:
        if config.format == _OF_POSES:
            message = exported_files.write_poses(Path(config.path), Path(config.output))
        elif config.format in _OF_COMPONENTS:
            message = exported_files.write_components(config)
        else:
            message = exported_files.write_space(config, exported_files.open_source(config), bars)
    print(message)


def _format(config: DictConfig) -> str:
    """The format that is given, or that of the output's ending."""
    known = (*_OF_SPACE, *_OF_COMPONENTS, _OF_POSES)
    if config.format is None:
        ending = Path(config.output).suffix.lower()
        if ending not in _OF_ENDINGS:
            raise InvalidArgumentError(
                f"output={config.output} has none of the endings {', '.join(_OF_ENDINGS)}; add one, or give "
                f"format={'|'.join(known)}."
            )
        return _OF_ENDINGS[ending]
    check_choice("format", config.format, known)
    return str(config.format)


if __name__ == "__main__":
    main()
