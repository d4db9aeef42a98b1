"""Functions that several commands use: configuration folder, set-up of a run, errors, data sets, results."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

if TYPE_CHECKING:
    from gmmtorch.datasets import Dataset
    from gmmtorch.datasets.recordings.reposed import Reposed
    from gmmtorch.evaluation.events import Event, Row
    from gmmtorch.evaluation.protocol_options import FitOptions
    from gmmtorch.localization.odometry.odometry import Trajectory
    from gmmtorch.scan import Scan

logger = logging.getLogger("gmmtorch")
_WITHOUT_POSES = ("scan_folder", "rosbag")  # data sets that `dataset.poses=standing` reads without poses
_ARGUMENT = re.compile(r"(?<![\w.])[\w.]+(?==| is not set)")


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


@contextmanager
def naming(options: Mapping[str, str]) -> Iterator[None]:
    """Renames arguments in errors to the options that the user gave: `noise=-1` becomes `sensor.noise=-1`.

    options: the option for each argument.
    """
    from gmmtorch.errors import InvalidArgumentError, MissingDataError

    def renamed(error: Exception) -> str:
        return re.sub(_ARGUMENT, lambda name: options.get(name[0], name[0]), str(error))

    try:
        yield
    except InvalidArgumentError as error:
        raise InvalidArgumentError(renamed(error)) from error
    except MissingDataError as error:
        raise MissingDataError(renamed(error)) from error


def as_options(node: DictConfig) -> dict[str, Any]:
    """The values of a configuration node by name."""
    plain: Any = OmegaConf.to_container(node, resolve=True)
    return {str(key): value for key, value in plain.items()}


def fit_options(config: DictConfig) -> FitOptions:
    """The options of a fit from `mixture.*` and `runtime.*`."""
    from gmmtorch.evaluation.protocol_options import FitOptions

    runtime, mixture = config.runtime, as_options(config.mixture)
    known = {item.name for item in fields(FitOptions)}
    chosen = {name: value for name, value in mixture.items() if name in known}
    return FitOptions(**chosen, dtype=runtime.dtype, compiled=runtime.compile)


def run_dir() -> Path:
    """The folder of this run: `hydra.run.dir`, or the sweep's folder of this job."""
    from hydra.core.hydra_config import HydraConfig

    return Path(HydraConfig.get().runtime.output_dir)


def is_job_of_sweep() -> bool:
    """Whether this run is one of several with folders of their own; their results are in one table."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    if not HydraConfig.initialized():
        return False
    config = HydraConfig.get()
    return config.mode == RunMode.MULTIRUN and config.output_subdir is not None


def set_up(config: DictConfig) -> str:
    """Check the seed and apply `runtime.*`; returns the device."""
    from gmmtorch.errors import check_whole

    check_whole("seed", config.seed, 0)
    return use_runtime(config.runtime)


def use_runtime(runtime: DictConfig) -> str:
    """Apply `runtime.*`; returns the device. Raises `InvalidArgumentError` for an invalid option."""
    import torch

    from gmmtorch.errors import InvalidArgumentError
    from gmmtorch.kernels import use_kernels

    if runtime.threads is not None:
        if runtime.threads < 1:
            raise InvalidArgumentError(f"runtime.threads={runtime.threads} must be at least 1, or null.")
        torch.set_num_threads(runtime.threads)
    if runtime.get("memory_limit", 1) < 1:  # some commands have no memory limit
        raise InvalidArgumentError(f"runtime.memory_limit={runtime.memory_limit} must be above zero bytes.")
    with naming({"kernels": "runtime.kernels"}):
        use_kernels(runtime.kernels)
    try:
        torch.zeros(1, device=runtime.device).item()  # item() also refuses the device "meta"
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise InvalidArgumentError(
            f"runtime.device={runtime.device} is not available ({reason}); use cpu, or install a torch build "
            "for this device."
        ) from error
    return str(runtime.device)


class OpenedDataset(NamedTuple):
    """A data set; with `dataset.odometry`, also its trajectory, and the facts of it for results.json."""

    dataset: Dataset
    trajectory: Trajectory | None
    odometry: Row | None


def open_dataset(config: DictConfig) -> Dataset:
    """The data set that the options `dataset.*` describe."""
    return open_with_trajectory(config).dataset


def open_with_trajectory(config: DictConfig) -> OpenedDataset:
    """The data set of the options `dataset.*`, with the trajectory that `dataset.odometry` gives."""
    from gmmtorch import datasets
    from gmmtorch.errors import DataError, check_choice

    options = {
        str(key): config[key]
        for key in config
        # If a path is missing, the reader raises an error that describes the files it needs.
        if not OmegaConf.is_missing(config, key) and config[key] is not None
    }
    method, name = options.pop("odometry", "none"), options.pop("name")
    motion = options.pop("motion", "constant")
    check_choice("dataset.odometry", method, ("none", "auto", "kiss_icp", "mixture"))
    try:
        found = datasets.load(name, options.pop("path", None), **options)
        if method == "none" or (method == "auto" and found.pose(0) is not None):
            return OpenedDataset(found, None, None)
        has_truth = options.get("poses") != "standing"
    except DataError:
        if method == "none" or name not in _WITHOUT_POSES:
            raise
        found = datasets.load(name, config.path, **{**options, "poses": "standing"})
        has_truth = False
    return _with_odometry(found, "mixture" if method == "auto" else method, motion, has_truth)


def _with_odometry(source: Dataset, method: str, motion: str, has_truth: bool) -> OpenedDataset:
    """The data set with estimated poses. Prints the errors against its own poses, if it has some."""
    from gmmtorch.localization.odometry.recorded_poses import with_odometry

    with naming({"odometry": "dataset.odometry", "motion": "dataset.motion"}):
        posed, trajectory = with_odometry(source, method, motion=motion)
    facts: Row = {
        "method": method,
        "n_lost": int((~trajectory.found).sum()),
        "n_closures": trajectory.n_closures,
        **_trajectory_scores(posed, trajectory, has_truth and motion == "constant"),
    }
    text = f"odometry  {len(posed)} poses estimated, {facts['n_lost']} scans lost, "
    text += f"{trajectory.n_closures} loop closures"
    if facts["ate"] is not None:
        text += f"; ATE {facts['ate']:.3f} m, RPE {facts['rpe']:.3f} m against the poses of the data set"
    print(text)
    return OpenedDataset(posed, trajectory, facts)


def _trajectory_scores(posed: Reposed, trajectory: Trajectory, has_truth: bool) -> Row:
    """ATE and RPE against the data set's own poses; None where they cannot be computed."""
    import torch

    from gmmtorch.errors import InvalidArgumentError
    from gmmtorch.evaluation.trajectories import absolute_trajectory_error, relative_pose_error

    names = [f"{kind}{part}" for kind in ("ate", "rpe") for part in ("", "_median", "_max", "_degrees")]
    scores: Row = {"align": None, **dict.fromkeys(names)}
    if not has_truth or len(posed) < 3:
        return scores
    true = torch.stack([posed.own_pose(index) for index in range(len(posed))])
    scores |= relative_pose_error(trajectory.poses, true).scores("rpe")
    try:
        ate = absolute_trajectory_error(trajectory.poses, true, "rigid").scores("ate")
        return scores | ate | {"align": "rigid"}
    except InvalidArgumentError:  # positions on a line determine no rotation
        ate = absolute_trajectory_error(trajectory.poses, true, "first").scores("ate")
        return scores | ate | {"align": "first"}


def all_scans(config: DictConfig, device: str, on_event: Event) -> tuple[str, list[Scan]]:
    """The name and all scans of the data set `dataset.*`, on the device."""
    dataset = open_dataset(config.dataset)
    return dataset.name, read_scans(dataset, range(len(dataset)), device, on_event)


def read_scans(dataset: Dataset, indices: Sequence[int], device: str, on_event: Event) -> list[Scan]:
    """The scans with these indices, on the device."""
    scans = []
    on_event("reading scans", 0, len(indices))
    for done, index in enumerate(indices, 1):
        scans.append(dataset[index].to(device))
        on_event("reading scans", done, len(indices))
    return scans


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


def headline(rows: Sequence[Row]) -> str:
    """The title of a table of fits."""
    return f"{rows[0]['dataset']}: {rows[0]['n_points']:,} points"


def log_likelihood(row: Row) -> float:
    """The log-likelihood of a fit's held-out points, or of its training points if none are held out."""
    held_out = row["held_out_log_likelihood"]
    return float(row["log_likelihood"] if held_out is None else held_out)


def save_figures(config: DictConfig, figures: dict[str, Any], folder: Path) -> None:
    """Write every figure as NAME.png if `report.figures` is set."""
    if not config.report.figures:
        return
    from gmmtorch.report.style import save_figure

    for name, figure in figures.items():
        save_figure(figure, folder / f"{name}.png")


def print_table(rows: Sequence[Row], columns: Sequence[str], title: str) -> None:
    """Print the rows as a table on standard output; not in a sweep, whose table has all rows."""
    if is_job_of_sweep():
        return
    from gmmtorch.report.table import format_table

    print(f"\n{title}\n{format_table(list(rows), columns)}")


def print_files(folder: Path, results: Path) -> None:
    """Print the places of the run's files on standard output; not in a sweep."""
    if is_job_of_sweep():
        return
    pictures = sorted(path.name for path in folder.glob("*.png"))
    print(f"\nresults   {results}")
    if pictures:
        print(f"pictures  {folder}/{{{', '.join(pictures)}}}")
    if (folder / "tensorboard").is_dir():
        print(f"browse    tensorboard --logdir {folder / 'tensorboard'}")


def chosen_options(config: DictConfig) -> dict[str, Any]:
    """The options that the command line sets, by name, for TensorBoard's table of hyperparameters.

    In a sweep these are the swept options and those that all jobs share.
    """
    from hydra.core.hydra_config import HydraConfig

    found: dict[str, Any] = {"seed": config.seed} if "seed" in config else {}
    for override in HydraConfig.get().overrides.task:
        name, _, text = str(override).lstrip("+~").partition("=")
        value = OmegaConf.select(config, name, throw_on_missing=False)
        found[name] = value if isinstance(value, bool | int | float | str) else text
    return found
