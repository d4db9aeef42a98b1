"""Attributes as an adaptive binary code, written and read; the twin is `mapping.codec.number_model`."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.kernels.codes.context_coding import ChanceTables
from gmmtorch.kernels.compiler import FusedKernel

_CODINGS = {
    writes: FusedKernel("codes/number_coding.h", f"number_coding<{str(writes).lower()}>", rounds_each=True)
    for writes in (True, False)
}


def number_coding(
    rows: Tensor, width: int, power: Tensor, tables: ChanceTables, stream: Tensor, writes: bool
) -> int:
    """Write rows (K, n) of whole numbers, with `width` columns of the channel, to the stream (B,), uint8, or
    read them into zeros; returns the number of bytes used; −1 if the stream is damaged or too short.

    power (2 M + 1,): √2 to the powers −M … M, of which deviations are. All tensors are on the CPU.
    """
    result = torch.zeros(1, dtype=torch.int64)
    level, height = torch.zeros(width, dtype=torch.int64), torch.zeros(width, dtype=torch.float64)
    sizes = (len(rows), rows.shape[1], width)
    slots = (*tables[:3], len(tables.rates) - 1, tables.first_slot)
    scratch = (rows, power, len(power) // 2, level, height, *slots)
    _CODINGS[writes](1, *sizes, *scratch, stream, len(stream), 0, result)
    return int(result)
