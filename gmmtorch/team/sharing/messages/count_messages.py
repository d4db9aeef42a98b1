"""Points that components gained, as datagrams. See docs/messages.md."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mapping import (
    LARGEST_COUNT,
    MOST_POINTS,
    NO_COUNT,
    BitReader,
    BitWriter,
    Ints,
    count_steps,
    decode_thesis_updates,
    encode_thesis_updates,
    points_of,
)
from gmmtorch.team.sharing.messages.envelope import LARGEST_NUMBER, Kind, check_codec, make_datagram, split
from gmmtorch.team.sharing.messages.fields import (
    check_ids,
    id_order,
    read_ids,
    read_number,
    write_ids,
    write_number,
)

_COUNT = np.dtype([("robot", "<i8"), ("number", "<i8"), ("count", "<f8")])


@dataclass(frozen=True, eq=False)
class CountsMessage:
    """Points that `sender` assigned to components since its last message, by (robot, sequence)."""

    sender: int
    counts: dict[tuple[int, int], float]


def encode_counts(
    sender: int, counts: Mapping[tuple[int, int], float], codec: str = "quantized"
) -> list[bytes]:
    """Datagrams of counts ≥ 0 that components (robot, sequence) gained; empty without counts.

    Args:
        codec: "quantized": 1 to 3 bytes a count, rounded by up to 9 %, as `mapping.codec.quantization` does.
            "float": 24 bytes. "thesis": 8 bytes, id and float32.
    """
    ids = torch.tensor(list(counts), dtype=torch.int64).reshape(-1, 2)
    values = torch.tensor(list(counts.values()), dtype=torch.float64)
    bad = ~((values >= 0) & (values <= MOST_POINTS))
    if bool(bad.any()):
        first = int(bad.nonzero()[0])
        raise InvalidArgumentError(
            f"counts[{tuple(ids[first].tolist())}]={float(values[first])} must be from 0 to {MOST_POINTS:g}."
        )
    order = torch.from_numpy(id_order(check_ids("counts", ids)))
    ids, values = ids[order], values[order]
    write = {"quantized": _quantized_counts, "float": _float_counts, "thesis": _thesis_counts}[
        check_codec(codec)
    ]
    return split(len(ids), lambda begin, end: write(sender, ids[begin:end], values[begin:end]), "count")


def _quantized_counts(sender: int, ids: Tensor, counts: Tensor) -> bytes:
    writer = BitWriter()
    write_number(writer, "sender", sender)
    write_ids(writer, ids.numpy())
    writer.column(count_steps(counts).numpy())
    return make_datagram(Kind.COUNTS, writer.to_bytes())


def read_quantized_counts(body: bytes) -> CountsMessage:
    reader = BitReader(body)
    sender, ids = read_number(reader), read_ids(reader)
    steps = reader.column(len(ids))
    reader.finish()
    return _counts(sender, ids, counts_of(steps))


def counts_of(steps: Ints) -> np.ndarray:
    """The numbers of points of `count_steps`. Raises `DataError` for steps out of range."""
    if len(steps) and not NO_COUNT <= int(steps.min()) <= int(steps.max()) <= LARGEST_COUNT:
        raise DataError(f"Counts reach from {steps.min()} to {steps.max()} steps: it is damaged.")
    return points_of(torch.from_numpy(steps)).numpy()


def _float_counts(sender: int, ids: Tensor, counts: Tensor) -> bytes:
    writer = BitWriter()
    write_number(writer, "sender", sender)
    rows = np.empty(len(ids), _COUNT)
    rows["robot"], rows["number"], rows["count"] = ids[:, 0], ids[:, 1], counts
    return make_datagram(Kind.FLOAT_COUNTS, writer.to_bytes() + rows.tobytes())


def read_float_counts(body: bytes) -> CountsMessage:
    sender, rest = _sender_of(body)
    if len(rest) % _COUNT.itemsize:
        raise DataError(f"{len(rest)} bytes are not whole counts of {_COUNT.itemsize} bytes: truncated?")
    rows = np.frombuffer(rest, _COUNT)
    return _counts(sender, np.stack([rows["robot"], rows["number"]], 1).astype(np.int64), rows["count"])


def _thesis_counts(sender: int, ids: Tensor, counts: Tensor) -> bytes:
    writer = BitWriter()
    write_number(writer, "sender", sender)
    return make_datagram(Kind.THESIS_COUNTS, writer.to_bytes() + encode_thesis_updates(ids, counts))


def read_thesis_counts(body: bytes) -> CountsMessage:
    sender, rest = _sender_of(body)
    ids, counts = decode_thesis_updates(rest)
    return _counts(sender, ids.numpy(), counts.numpy())


def _sender_of(body: bytes) -> tuple[int, bytes]:
    """The sender at the begin of a body, and the remaining bytes."""
    reader = BitReader(body)
    sender = read_number(reader)
    return sender, body[len(body) - reader.left // 8 :]


def _counts(sender: int, ids: Ints, values: np.ndarray) -> CountsMessage:
    counts = {
        (robot, number): count for (robot, number), count in zip(ids.tolist(), values.tolist(), strict=True)
    }
    if len(counts) != len(ids) or not all(0 <= count <= MOST_POINTS for count in counts.values()):
        raise DataError(f"An id comes twice, or a count is not from 0 to {MOST_POINTS:g}: it is damaged.")
    if not len(ids) or not 0 <= int(ids.min()) <= int(ids.max()) <= LARGEST_NUMBER:
        raise DataError(f"No ids, or ids outside 0 to {LARGEST_NUMBER}: it is damaged.")
    return CountsMessage(sender, counts)
