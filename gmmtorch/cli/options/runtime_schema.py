"""The options of the runtime and of reports, which commands share."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Report:
    """What a run shows and writes.

    progress: progress bars, or a status line.
    figures: figures as PNG.
    tensorboard: events for TensorBoard.
    """

    progress: bool = True
    figures: bool = True
    tensorboard: bool = True


@dataclass
class Runtime:
    """Where and how a run computes.

    device: cpu, cuda, cuda:1, …
    threads: CPU threads; null: torch chooses. The same number gives the same results.
    dtype: type of the exponentials in EM (float64 in fused exact EM); float64: all computations.
    compile: use torch.compile; faster for very large runs.
    kernels: fused kernels: auto, if the extra [fast] is installed; fused, an error if not; torch, never.
    memory_limit: bytes of a map's cells, at most.
    """

    device: str = "cpu"
    threads: int | None = 1
    kernels: str = "auto"
    dtype: str = "float32"
    compile: bool = False
    memory_limit: int = 4 << 30


@dataclass
class ExportReport:
    """progress: progress bars."""

    progress: bool = True


@dataclass
class ExportRuntime:
    """device: cpu, cuda, cuda:1, …
    threads: CPU threads; null: torch chooses.
    kernels: fused kernels: auto, fused or torch.
    memory_limit: bytes of the cells' evidence, at most.
    """

    device: str = "cpu"
    threads: int | None = 1
    kernels: str = "auto"
    memory_limit: int = 4 << 30
