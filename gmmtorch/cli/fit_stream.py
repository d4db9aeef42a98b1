"""gmmtorch-fit on a cloud that is streamed, shared by several processes, or kept in checkpoints."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from gmmtorch.cli import common

if TYPE_CHECKING:
    from gmmtorch.evaluation.studies.fitting import Material
    from gmmtorch.evaluation.studies.streamed_fit import Split, Streamed
    from gmmtorch.mixture.streaming.checkpoints import Checkpoint

MaterialOf = Callable[[DictConfig, str, Any], "Material"]
"""(config, device, on_event) → the points of the data set."""


def _is_follower() -> bool:
    """Whether torchrun started this process beside a first one, which does all the writing."""
    return int(os.environ.get("WORLD_SIZE", "1")) > 1 and os.environ.get("RANK", "0") != "0"


@contextmanager
def quiet_follower() -> Iterator[None]:
    """Keeps what Hydra writes and says for a follower out of the run's folder and off the screen."""
    if not _is_follower():
        yield
        return
    with tempfile.TemporaryDirectory(prefix="gmmtorch-") as folder:
        quiet = ["hydra.output_subdir=null", "hydra/job_logging=disabled", "hydra/hydra_logging=disabled"]
        sys.argv += [f"hydra.run.dir={folder}", f"hydra.sweep.dir={folder}", *quiet]
        yield


def is_wanted(config: DictConfig) -> bool:
    """Whether the options, or torchrun, ask for a streamed fit."""
    from gmmtorch.mixture.streaming.distributed import is_launched

    return config.points is not None or config.checkpoint is not None or config.resume or is_launched()


def run(config: DictConfig, material_of: MaterialOf, folder: Path) -> Streamed | None:
    """One streamed fit: its row is written, its mixture saved. None in a process other than the first."""
    from gmmtorch.evaluation.studies.streamed_fit import fit_streamed
    from gmmtorch.mixture.streaming.distributed import joined
    from gmmtorch.report.progress import ProgressBars

    device = common.set_up(config)
    if device == "cuda":
        device = f"cuda:{os.environ.get('LOCAL_RANK', '0')}"
    _check(config)
    options = common.fit_options(config)
    checkpoint = _checkpoint(config)
    with (
        joined(device, config.stream.timeout) as processes,
        ProgressBars(enabled=config.report.progress and processes.rank == 0) as bars,
    ):
        split = _split(config, material_of, device, bars)
        streamed = fit_streamed(
            split,
            options,
            config.seed,
            device=device,
            processes=processes,
            checkpoint=checkpoint,
            on_event=bars,
        )
    if processes.rank != 0:
        return None
    streamed.mixture.save(folder / "em.safetensors")
    common.write_results("fit", config, [streamed.row], folder)
    return streamed


def _check(config: DictConfig) -> None:
    from gmmtorch.errors import InvalidArgumentError

    if list(config.method) != ["em"]:
        raise InvalidArgumentError(
            f"method={list(config.method)}: a fit that is streamed, or shared by processes, is by [em] only."
        )
    if config.method_options:
        raise InvalidArgumentError(
            f"method_options={config.method_options} are not for a fit that is streamed."
        )
    if config.study is not None:
        raise InvalidArgumentError("An experiment is run by one process, on a data set: leave out points.")
    if config.points is not None and config.max_points is not None:
        raise InvalidArgumentError(
            f"max_points={config.max_points} thins scans, but points={config.points} is read whole; leave it "
            "null."
        )
    if config.resume and config.checkpoint is None:
        raise InvalidArgumentError("resume=true goes on from a checkpoint; name it by checkpoint=FILE.")


def _checkpoint(config: DictConfig) -> Checkpoint | None:
    from gmmtorch.mixture.streaming.checkpoints import Checkpoint

    if config.checkpoint is None:
        return None
    stream = config.stream
    path = Path(config.checkpoint).expanduser()
    return Checkpoint(path, stream.checkpoint_every, stream.checkpoint_seconds, config.resume)


def _split(config: DictConfig, material_of: MaterialOf, device: str, on_event: Any) -> Split:
    from gmmtorch.datasets.point_files.point_chunks import open_points
    from gmmtorch.evaluation.studies.streamed_fit import split_material, split_source

    stream = config.stream
    if config.points is None:
        return split_material(material_of(config, device, on_event), stream.chunk_points)
    source = open_points(config.points, chunk_points=stream.chunk_points, max_range=stream.max_range)
    return split_source(source, config.test_share, config.seed, stream.sample_points)
