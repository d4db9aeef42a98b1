"""gmmtorch-fit with a streamed cloud, with several processes, or with checkpoints."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from gmmtorch.cli import common
from gmmtorch.cli.from_options.fit_data import fit_data

if TYPE_CHECKING:
    from gmmtorch.evaluation.fits.streamed_fit import Split, Streamed
    from gmmtorch.mixture.streaming.checkpoints import Checkpoint


def _is_worker() -> bool:
    """Whether torchrun started this process with a rank above 0; only rank 0 writes files."""
    return int(os.environ.get("WORLD_SIZE", "1")) > 1 and os.environ.get("RANK", "0") != "0"


@contextmanager
def quiet_worker() -> Iterator[None]:
    """Sends the files and messages that Hydra writes in a worker to a temporary folder."""
    if not _is_worker():
        yield
        return
    with tempfile.TemporaryDirectory(prefix="gmmtorch-") as folder:
        quiet = ["hydra.output_subdir=null", "hydra/job_logging=disabled", "hydra/hydra_logging=disabled"]
        sys.argv += [f"hydra.run.dir={folder}", f"hydra.sweep.dir={folder}", *quiet]
        yield


def is_wanted(config: DictConfig) -> bool:
    """Whether the options or torchrun request a streamed fit."""
    from gmmtorch.mixture.streaming.distributed import is_launched

    return config.points is not None or config.checkpoint is not None or config.resume or is_launched()


def run(config: DictConfig, folder: Path) -> Streamed | None:
    """Run a streamed fit, write its row and save its mixture. Returns None in workers."""
    from gmmtorch.evaluation.fits.streamed_fit import fit_streamed
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
        split = _split(config, device, bars)
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
            f"method={list(config.method)}: a streamed fit, or a fit by several processes, needs method=[em]."
        )
    if config.method_options:
        raise InvalidArgumentError(
            f"method_options={config.method_options}: a streamed fit has no method options; remove them."
        )
    if config.mixture.prune != "none":
        raise InvalidArgumentError(
            f"mixture.prune={config.mixture.prune}: a streamed fit does not prune; use none, and "
            "gmmtorch.mixture.prune."
        )
    if config.study is not None:
        raise InvalidArgumentError(
            f"study={config.study.name} runs in one process on a data set; remove points, checkpoint, resume "
            "and torchrun."
        )
    if config.points is not None and config.max_points is not None:
        raise InvalidArgumentError(
            f"max_points={config.max_points} is for scans, but points={config.points} is read completely: "
            "set max_points to null."
        )
    if config.resume and config.checkpoint is None:
        raise InvalidArgumentError("resume=true needs a checkpoint; give checkpoint=FILE.")
    if config.resume and not (path := Path(config.checkpoint).expanduser()).is_file():
        if not path.parent.is_dir():
            raise InvalidArgumentError(
                f"checkpoint={path}: the folder {path.parent} does not exist, so there is nothing to resume; "
                "correct the path, or remove resume=true."
            )
        common.logger.warning("checkpoint=%s does not exist: the fit starts from the beginning.", path)


def _checkpoint(config: DictConfig) -> Checkpoint | None:
    from gmmtorch.mixture.streaming.checkpoints import Checkpoint

    if config.checkpoint is None:
        return None
    stream = config.stream
    path = Path(config.checkpoint).expanduser()
    return Checkpoint(path, stream.checkpoint_every, stream.checkpoint_seconds, config.resume)


def _split(config: DictConfig, device: str, on_event: Any) -> Split:
    from gmmtorch.datasets.point_files.point_chunks import open_points
    from gmmtorch.evaluation.fits.streamed_fit import split_data, split_source

    stream = config.stream
    if config.points is None:
        return split_data(fit_data(config, device, on_event), stream.chunk_points)
    source = open_points(config.points, chunk_points=stream.chunk_points, max_range=stream.max_range)
    return split_source(source, config.test_share, config.seed, stream.sample_points)
