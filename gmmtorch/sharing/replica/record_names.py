"""Which records a datagram holds: their names, for which it need not be read to the end."""

from __future__ import annotations

import numpy as np
import torch

from gmmtorch.errors import DataError
from gmmtorch.mapping.codec.bitstream import BitReader
from gmmtorch.mapping.codec.lattice import AXIS_ORDERS
from gmmtorch.sharing.messages.envelope import Kind, parse_datagram
from gmmtorch.sharing.replica.intervals import Intervals, Ints
from gmmtorch.sharing.replica.record_keys import keys_of

RECORDS = frozenset({Kind.COMPONENTS, Kind.SUPERSESSION, Kind.COUNTERS, Kind.CORRECTION})


def keys_in(datagram: bytes) -> Intervals:
    """The keys of the records in a datagram of one of the kinds `RECORDS`, as a replica wrote or merged it.

    Of its content it looks at nothing else. Raises `DataError` where it cannot be a record.
    """
    kind, body = parse_datagram(datagram)
    if kind is Kind.COMPONENTS:
        return Intervals.of(_component_keys(BitReader(body[1:])))
    if kind not in RECORDS:
        raise DataError(f"A datagram of kind {int(kind)} is no record.")
    key = BitReader(body).number()
    return Intervals.span(key, key + 1)


def _component_keys(batch: BitReader) -> Ints:
    """Of a batch, see docs/formats.md: before the ids come three numbers, and the order of the axes."""
    dim, k, _ = batch.number(), batch.number(), batch.number()
    if dim not in AXIS_ORDERS or k < 0:
        raise DataError(f"{k} components in {dim}D: it is damaged.")
    n_bits = (len(AXIS_ORDERS[dim]) - 1).bit_length()
    batch.require(k * n_bits)
    batch.fixed(k, n_bits)
    robots, numbers = batch.column(k), batch.column(k) + np.arange(k)
    return keys_of(torch.from_numpy(np.stack([robots, numbers], 1)))
