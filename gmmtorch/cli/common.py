"""What several commands share: their options, the configuration folder, the set-up of a run, its results."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from gmmtorch.cli.schema import naming
from gmmtorch.declarations import option
from gmmtorch.errors import InvalidArgumentError, MissingDataError, check_whole
from gmmtorch.report import Row, format_table

if TYPE_CHECKING:
    from gmmtorch.report import Board

logger = logging.getLogger("gmmtorch")


@dataclass
class Progress:
    """What a run shows."""

    progress: bool = option(True, "progress bars, or a status line")


@dataclass
class Report(Progress):
    """What a run shows and writes."""

    figures: bool = option(True, "figures as PNG")
    tensorboard: bool = option(True, "events for TensorBoard")


@dataclass
class Device:
    """Where a run computes."""

    device: str = option("cpu", "cpu, cuda, cuda:1, …")
    threads: int | None = option(
        1, "CPU threads; null: torch chooses. The same number gives the same results"
    )
    kernels: str = option(
        "auto", "fused kernels: auto, if the extra [fast] is installed; fused: an error if not; torch: never"
    )


@dataclass
class Memory(Device):
    """Where a run computes, and how much memory cells may take."""

    memory_limit: int = option(4 << 30, "bytes of a map's cells, at most")


@dataclass
class Runtime(Memory):
    """Where and how a run learns."""

    dtype: str = option(
        "float32",
        "type of the exponentials in EM; fused EM in up to three dimensions computes them in float64 (on a "
        "GPU exact EM in float32, where that errs by less than 0.001 nats). float64: all computations, "
        "except those of map=incremental",
    )
    compile: bool = option(False, "without effect: fused kernels are compiled anyway")


def conf_dir() -> str:
    """The folder of configuration files: in the package if it is installed, next to the package in a
    checkout."""
    package = Path(__file__).resolve().parent.parent
    for candidate in (package / "conf", package.parent / "conf"):
        if (candidate / "occupancy.yaml").is_file():
            return str(candidate)
    raise FileNotFoundError(
        f"conf/ is neither in {package} nor next to it; install gmmtorch again, or use a complete checkout."
    )


def as_options(node: DictConfig) -> dict[str, Any]:
    """The values of a configuration node by name."""
    plain: Any = OmegaConf.to_container(node, resolve=True)
    return {str(key): value for key, value in plain.items()}


def run_dir() -> Path:
    """The folder of this run: `hydra.run.dir`, or the sweep's folder of this job."""
    return Path(HydraConfig.get().runtime.output_dir)


def is_job_of_sweep() -> bool:
    """Whether this run is one of several with folders of their own; their results are in one table."""
    if not HydraConfig.initialized():
        return False
    config = HydraConfig.get()
    return config.mode == RunMode.MULTIRUN and config.output_subdir is not None


def print_start() -> None:
    """Print the folder of the run, before the imports that take seconds; not in a sweep, or without files."""
    config = HydraConfig.get()
    if config.mode == RunMode.RUN and config.output_subdir is not None:
        print(f"gmmtorch-{config.job.config_name} writes to {run_dir()}", flush=True)


def drop_unwritable() -> None:
    """Drops text that standard error does not take, as on a full disk, and all later text.

    It would stay in a buffer, so that each later write fails, and Python exits with status 120.
    """
    try:
        sys.stderr.flush()
    except OSError:
        if sys.__stderr__ is not None and sys.stderr is sys.__stderr__:
            with Path(os.devnull).open("wb") as nothing:
                os.dup2(nothing.fileno(), sys.__stderr__.fileno())


def check_inputs(config: DictConfig) -> None:
    """Raises the error of an input that does not exist, before a command imports what takes seconds."""
    points = OmegaConf.select(config, "points")
    if points is not None:
        from gmmtorch.datasets import point_path

        point_path(points)
    for name in ("path", "map.path", "world.path"):
        path = OmegaConf.select(config, name)
        if path and not Path(path).expanduser().exists():
            raise MissingDataError(f"{name}={path} does not exist; give a file or folder that exists.")
    path = OmegaConf.select(config, "dataset.path")
    is_read = points is None and not OmegaConf.select(config, "inputs")
    if is_read and path and not Path(path).expanduser().exists():
        from gmmtorch import datasets

        with naming({"path": "dataset.path"}):
            datasets.load(config.dataset.name, path)  # its error describes the files it needs


def set_up(config: DictConfig) -> str:
    """Check the seed and apply `runtime.*`; returns the device."""
    check_whole("seed", config.seed, 0)
    return use_runtime(config.runtime)


def use_runtime(runtime: DictConfig) -> str:
    """Apply `runtime.*`; returns the device.

    Raises `InvalidArgumentError` for an invalid option, and `GmmTorchError` for `runtime.kernels=fused` if
    the kernel compiler is missing or broken.
    """
    import torch

    from gmmtorch.arrays import check_device
    from gmmtorch.kernels import use_kernels

    if runtime.threads is not None:
        if runtime.threads < 1:
            raise InvalidArgumentError(f"runtime.threads={runtime.threads} must be at least 1, or null.")
        torch.set_num_threads(runtime.threads)
    if runtime.get("memory_limit", 1) < 1:  # some commands have no memory limit
        raise InvalidArgumentError(f"runtime.memory_limit={runtime.memory_limit} must be above zero bytes.")
    with naming({"kernels": "runtime.kernels"}):
        use_kernels(runtime.kernels)
    check_device("runtime.device", runtime.device)
    return str(runtime.device)


def write_results(command: str, config: DictConfig, rows: list[Row], folder: Path) -> Path:
    """Write results.json of a run atomically: command, version, seed, config and rows."""
    import gmmtorch
    from gmmtorch.files import write_json

    results = {
        "command": command,
        "version": gmmtorch.__version__,
        "seed": config.seed if "seed" in config else None,
        "config": OmegaConf.to_container(config, resolve=True),
        "rows": rows,
    }
    return write_json(folder / "results.json", results)


def show_figures(config: DictConfig, figures: Mapping[str, Any], folder: Path, board: Board | None) -> None:
    """Write every figure as NAME.png if `report.figures` is set, and to TensorBoard if there is a board."""
    if not config.report.figures and board is None:
        return
    from gmmtorch.files import write_bytes
    from gmmtorch.report import picture

    for name, figure in figures.items():
        png = picture(figure)
        if config.report.figures:
            write_bytes(folder / f"{name}.png", png)
        if board is not None:
            board.figure(f"figures/{name}", png)


def show(
    config: DictConfig,
    folder: Path,
    figures: Callable[[], Mapping[str, Any]],
    write: Callable[[Board], object],
) -> None:
    """Write figures as NAME.png if `report.figures` is set, and to TensorBoard if `report.tensorboard` is.

    Args:
        figures: makes the figures, by name, if one of the two is set.
        write: writes more to TensorBoard.
    """
    if not (config.report.figures or config.report.tensorboard):
        return
    from gmmtorch.report import Board

    made = figures()
    with Board(folder / "tensorboard") if config.report.tensorboard else nullcontext() as board:
        show_figures(config, made, folder, board)  # first: pictures are kept on a disk that fills up
        if board is not None:
            write(board)


def print_table(rows: Sequence[Row], columns: Sequence[str], title: str) -> None:
    """Print the rows as a table on standard output; not in a sweep, whose table has all rows."""
    if is_job_of_sweep():
        return
    print(f"\n{title}\n{format_table(list(rows), columns)}")


def print_files(folder: Path) -> None:
    """Print the places of the run's files on standard output; not in a sweep."""
    if is_job_of_sweep():
        return
    pictures = sorted(path.name for path in folder.glob("*.png"))
    print(f"\nresults   {folder / 'results.json'}")
    if pictures:
        print(f"pictures  {folder}/{{{', '.join(pictures)}}}")
    if (folder / "tensorboard").is_dir():
        print(f"browse    tensorboard --logdir {folder / 'tensorboard'}")


def chosen_options(config: DictConfig) -> dict[str, Any]:
    """The options that the command line sets, by name, for TensorBoard's table of hyperparameters.

    In a sweep these are the swept options and those that all jobs share.
    """
    found: dict[str, Any] = {"seed": config.seed} if "seed" in config else {}
    for override in HydraConfig.get().overrides.task:
        name, _, text = str(override).lstrip("+~").partition("=")
        value = OmegaConf.select(config, name, throw_on_missing=False)
        found[name] = value if isinstance(value, bool | int | float | str) else text
    return found
