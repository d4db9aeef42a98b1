"""Processes that share one fit: each reads its own points, and all have the same parameters.

They exchange one sum of K × F sufficient statistics per iteration, independent of the number of points.
Processes started by torchrun form a group; a single process is a group of one.
"""

from __future__ import annotations

import datetime
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from gmmtorch.errors import GmmTorchError, InvalidArgumentError

_LAUNCHED = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
TIMEOUT = 600.0
"""Default time (s) that a process waits for the others."""


class LostProcessError(GmmTorchError, RuntimeError):
    """Another process of the group ended, or did not answer in time."""


class Processes:
    """The processes that share a fit. This base class is a single process with all points."""

    rank = 0
    size = 1

    def sum(self, tensor: Tensor) -> Tensor:
        """The sum of the tensors of all processes, of equal shape and dtype."""
        return tensor

    def gather(self, rows: Tensor) -> list[Tensor]:
        """The rows (n, C) of all processes, by rank; n may differ."""
        counts = torch.zeros(self.size, dtype=torch.int64)
        counts[self.rank] = rows.shape[0]
        lengths = self.sum(counts).tolist()
        padded = rows.new_zeros(self.size, max(lengths), rows.shape[1])
        padded[self.rank, : rows.shape[0]] = rows
        return [part[:n] for part, n in zip(self.sum(padded), lengths, strict=True)]

    def broadcast(self, vector: Tensor | None) -> Tensor:
        """The vector (n,), float64, of rank 0. Other ranks may pass None."""
        given = torch.zeros(0, dtype=torch.float64) if vector is None or self.rank else vector
        length = int(self.sum(torch.tensor(given.numel())))
        return self.sum(given if self.rank == 0 else given.new_zeros(length))


SINGLE_PROCESS = Processes()


class ProcessGroup(Processes):
    """The processes of torch.distributed, which `joined` initialises."""

    def __init__(self, timeout: float, device: torch.device) -> None:
        from torch import distributed

        self._distributed: Any = distributed
        self._timeout, self._device = timeout, device
        self.rank, self.size = distributed.get_rank(), distributed.get_world_size()

    def sum(self, tensor: Tensor) -> Tensor:
        total = tensor.to(self._device).contiguous()
        try:
            self._distributed.all_reduce(total)
        except RuntimeError as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise LostProcessError(
                f"rank {self.rank} of {self.size} lost another process, or got no answer within "
                f"{self._timeout:g} s ({reason})."
            ) from error
        return total.to(tensor.device)


def is_launched() -> bool:
    """Whether torchrun (or a similar launcher) started this process as one of several."""
    return all(name in os.environ for name in _LAUNCHED) and int(os.environ["WORLD_SIZE"]) > 1


@contextmanager
def joined(device: str | torch.device = "cpu", timeout: float = TIMEOUT) -> Iterator[Processes]:
    """The processes that torchrun started (gloo on CPU, nccl on CUDA), or this single process.

    `timeout` (s) limits how long one process waits for another. Raises `LostProcessError` if the processes
    do not connect, and `InvalidArgumentError` for an invalid timeout.
    """
    if not (math.isfinite(timeout) and timeout > 0):
        raise InvalidArgumentError(f"timeout={timeout} must be above zero seconds, and finite.")
    if not is_launched():
        yield SINGLE_PROCESS
        return
    from torch import distributed

    device = torch.device(device)
    if device.type == "cuda":
        torch.cuda.set_device(device)
        os.environ.setdefault("TORCH_NCCL_BLOCKING_WAIT", "1")  # otherwise nccl aborts the process
    try:
        distributed.init_process_group(
            "nccl" if device.type == "cuda" else "gloo", timeout=datetime.timedelta(seconds=timeout)
        )
    except RuntimeError as error:
        raise LostProcessError(
            f"rank {os.environ['RANK']} of {os.environ['WORLD_SIZE']} did not find the other processes at "
            f"{os.environ['MASTER_ADDR']}:{os.environ['MASTER_PORT']} within {timeout:g} s ({error})."
        ) from error
    try:
        yield ProcessGroup(timeout, device)
    finally:
        distributed.destroy_process_group()
