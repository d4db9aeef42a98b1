"""gmmtorch-export: writes a map or a mixture in the format of another program."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from gmmtorch.cli import app, common
from gmmtorch.cli.options import schema
from gmmtorch.errors import InvalidArgumentError, check_choice
from gmmtorch.optional_packages import load_pyoctomap
from gmmtorch.report import ProgressBars

_OF_SPACE = ("map_server", "octomap", "ply", "pcd", "mesh", "distance_field")
_OF_COMPONENTS = ("csv", "npz", "mixture")
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
}
"""Formats by the endings of the output, if none is given."""


def main() -> None:
    """Entry point of the command."""
    app.start("export", run, schema.register)


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
