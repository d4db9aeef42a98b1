"""Components, and counts of points that they gained, as datagrams. See docs/messages.md."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.linalg import pack_symmetric, unpack_symmetric
from gmmtorch.mapping import codec as batches
from gmmtorch.mapping.bitstream import BitReader, BitWriter, Ints
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.lattice import PER_OCTAVE, power
from gmmtorch.mapping.quantization import LARGEST_COUNT, LEAST_COUNT, NO_COUNT, Quantized
from gmmtorch.mapping.thesis_message import (
    decode_thesis,
    decode_thesis_updates,
    encode_thesis,
    encode_thesis_updates,
)
from gmmtorch.sharing.envelope import MAX_BYTES, Kind, check_codec, sealed, split
from gmmtorch.sharing.fields import check_ids, id_order, read_ids, read_number, write_ids, write_number

_SIZES = struct.Struct("<BIII")  # dimensions, components, origins, sightings
_TRIED = 128
"""Components that are likely to fit into a datagram."""
_FILL = 0.95
"""Of a datagram, as components are not all of the same size."""
_COUNT = np.dtype([("robot", "<i8"), ("number", "<i8"), ("count", "<f8")])


@dataclass(frozen=True, eq=False)
class ComponentsMessage:
    """Components as whoever sent them holds them."""

    components: Components


@dataclass(frozen=True, eq=False)
class CountsMessage:
    """Points that `sender` has found to belong to components since it last said so, by (robot, sequence)."""

    sender: int
    counts: dict[tuple[int, int], float]


def encode_components(
    components: Components, codec: str = "quantized", max_bytes: int = MAX_BYTES
) -> list[bytes]:
    """Datagrams of components in order, each with the sensor positions that it needs; none of none.

    Args:
        codec: "quantized": 8 to 10 bytes a component, and `mapping.codec.quantized` says what comes out.
            "float": float64, as they are. "thesis": 57 bytes for each component and sensor position.
        max_bytes: of each datagram.

    Raises `InvalidArgumentError` for what the codec cannot store, and for a component of so many sensor
    positions that it does not fit into a datagram.
    """
    write = {"quantized": _quantized, "float": _float, "thesis": _thesis}[check_codec(codec)]

    def part(begin: int, end: int) -> bytes:
        return write(_part(components, begin, end))

    return split(len(components), part, "component", max_bytes)


def fitted(values: Quantized, max_bytes: int = MAX_BYTES) -> Iterator[tuple[bytes, Quantized]]:
    """Quantised components in order, as datagrams of as many as fit, and what each of these holds.

    As many are tried as the datagram before lets expect to fit, rather than halves of all.
    """
    begin, n = 0, _TRIED
    while begin < len(values):
        whole = begin == 0 and n >= len(values)
        part = values if whole else values.arranged(torch.arange(begin, min(begin + n, len(values))))
        datagram = sealed(Kind.COMPONENTS, batches.encode_quantized(part))
        room = int(_FILL * len(part) * max_bytes / len(datagram))
        if len(datagram) <= max_bytes:
            yield datagram, part
            begin, n = begin + len(part), max(1, room)
        elif len(part) > 1:
            n = max(1, min(room, len(part) - 1))
        else:
            raise InvalidArgumentError(
                f"A single component takes {len(datagram)} bytes; a datagram has room for {max_bytes}. "
                "Let it have fewer sensor positions."
            )


def encode_counts(
    sender: int, counts: Mapping[tuple[int, int], float], codec: str = "quantized"
) -> list[bytes]:
    """Datagrams of counts ≥ 0 that components (robot, sequence) gained; none of none.

    Args:
        codec: "quantized": 1 to 3 bytes a count, to 9 %, as in `mapping.quantization`. "float": 24
            bytes. "thesis": 8 bytes, id and float32.
    """
    ids = torch.tensor(list(counts), dtype=torch.int64).reshape(-1, 2)
    values = torch.tensor(list(counts.values()), dtype=torch.float64)
    most = 2.0 ** (LARGEST_COUNT / PER_OCTAVE)
    bad = ~((values >= 0) & (values <= most))
    if bool(bad.any()):
        first = int(bad.nonzero()[0])
        raise InvalidArgumentError(
            f"counts[{tuple(ids[first].tolist())}]={float(values[first])} must be from 0 to {most:g}."
        )
    order = torch.from_numpy(id_order(check_ids("counts", ids)))
    ids, values = ids[order], values[order]
    write = {"quantized": _quantized_counts, "float": _float_counts, "thesis": _thesis_counts}[
        check_codec(codec)
    ]
    return split(len(ids), lambda begin, end: write(sender, ids[begin:end], values[begin:end]), "count")


# -- components --------------------------------------------------------------------------------------------


def _part(components: Components, begin: int, end: int) -> Components:
    """Components begin … end − 1, sightings in their order, and the origins that they use."""
    c = components
    kept = ((c.seen_by >= begin) & (c.seen_by < end)).nonzero().squeeze(1)
    kept = kept[torch.argsort(c.seen_by[kept], stable=True)]
    used, seen_from = torch.unique(c.seen_from[kept], return_inverse=True)
    rows = {n: getattr(c, n)[begin:end] for n in ("means", "covariances", "support", "max_range", "ids")}
    return replace(
        c,
        **rows,
        origins=c.origins[used],
        seen_by=c.seen_by[kept] - begin,
        seen_from=seen_from,
        seen_count=c.seen_count[kept],
    )


def _quantized(components: Components) -> bytes:
    return sealed(Kind.COMPONENTS, batches.encode(components))


def read_quantized(body: bytes) -> ComponentsMessage:
    return ComponentsMessage(batches.decode(body))


def _float(components: Components) -> bytes:
    c = components.checked()
    _check_definite(c.covariances)
    fields = [
        _doubles(c.means),
        _doubles(pack_symmetric(c.covariances)),
        _doubles(c.support),
        c.max_range.cpu().numpy().astype("u1"),
        c.ids.cpu().numpy().astype("<i8"),
        _doubles(c.origins),
        c.seen_by.cpu().numpy().astype("<u2"),
        c.seen_from.cpu().numpy().astype("<u2"),
        _doubles(c.seen_count),
    ]
    sizes = (c.dim, len(c), len(c.origins), len(c.seen_by))  # indices beyond 16 bits do not fit anyway
    return sealed(Kind.FLOAT_COMPONENTS, _SIZES.pack(*sizes) + b"".join(f.tobytes() for f in fields))


def read_float(body: bytes) -> ComponentsMessage:
    if len(body) < _SIZES.size:
        raise DataError(f"{len(body)} bytes are too few for components.")
    dim, k, s, e = _SIZES.unpack_from(body)
    if dim not in (2, 3):
        raise DataError(f"The components are {dim}-dimensional; a map has 2 or 3 dimensions.")
    if max(k, s, e) > len(body):
        raise DataError(f"{k} components, {s} positions and {e} sightings are announced: it is damaged.")
    layout = np.dtype(
        [
            ("means", "<f8", (k, dim)),
            ("covariances", "<f8", (k, dim * (dim + 1) // 2)),
            ("support", "<f8", (k,)),
            ("max_range", "u1", (k,)),
            ("ids", "<i8", (k, 2)),
            ("origins", "<f8", (s, dim)),
            ("seen_by", "<u2", (e,)),
            ("seen_from", "<u2", (e,)),
            ("seen_count", "<f8", (e,)),
        ]
    )
    if len(body) != _SIZES.size + layout.itemsize:
        raise DataError(f"{len(body)} bytes are not those of {k} components, {s} positions, {e} sightings.")
    row = np.frombuffer(body, layout, offset=_SIZES.size)[0]
    if (row["max_range"] > 1).any() or (row["ids"] < 0).any():
        raise DataError("A max_range flag or an id is out of range: it is damaged.")
    values = {
        name: torch.from_numpy(row[name].astype(_wide(layout[name].base))) for name in layout.names or ()
    }
    values["covariances"] = unpack_symmetric(values["covariances"], dim)
    values["max_range"] = values["max_range"] != 0
    components = Components(**values).checked()
    _check_definite(components.covariances)
    return ComponentsMessage(components)


def _thesis(components: Components) -> bytes:
    if components.dim != 3:
        raise InvalidArgumentError(
            f"The thesis's messages are of 3D components, not {components.dim}D; use codec=quantized."
        )
    _check_definite(components.covariances.float().double())
    return sealed(Kind.THESIS_COMPONENTS, encode_thesis(components))


def read_thesis(body: bytes) -> ComponentsMessage:
    components = decode_thesis(body, 3)
    _check_definite(components.covariances)
    return ComponentsMessage(components)


def _check_definite(covariances: Tensor) -> None:
    info = torch.linalg.cholesky_ex(covariances).info
    if bool((info != 0).any()):
        first = int((info != 0).nonzero()[0])
        raise InvalidArgumentError(
            f"covariances[{first}] is not positive definite in the numbers of this codec; use "
            "codec=quantized, which keeps it so, or give it a larger least variance."
        )


def _doubles(values: Tensor) -> np.ndarray:
    return values.detach().cpu().numpy().astype("<f8")


def _wide(kind: np.dtype) -> type:
    return np.float64 if kind.kind == "f" else np.int64


# -- counts ------------------------------------------------------------------------------------------------


def _quantized_counts(sender: int, ids: Tensor, counts: Tensor) -> bytes:
    writer = BitWriter()
    write_number(writer, "sender", sender)
    write_ids(writer, ids.numpy())
    writer.column(count_steps(counts))
    return sealed(Kind.COUNTS, writer.to_bytes())


def read_quantized_counts(body: bytes) -> CountsMessage:
    reader = BitReader(body)
    sender, ids = read_number(reader), read_ids(reader)
    steps = reader.column(len(ids))
    reader.finish()
    return _counts(sender, ids, counts_of(steps))


def count_steps(counts: Tensor) -> Ints:
    """log2 of the counts in steps, as `mapping.quantization` has the support of components."""
    least = 2.0 ** (LEAST_COUNT / PER_OCTAVE)
    steps = (torch.log2(counts.clamp_min(least)) * PER_OCTAVE).round().long()
    return torch.where(counts < least / 2, NO_COUNT, steps).numpy()


def counts_of(steps: Ints) -> np.ndarray:
    """The counts that steps stand for. Raises `DataError` for what `count_steps` does not give."""
    if len(steps) and not NO_COUNT <= int(steps.min()) <= int(steps.max()) <= LARGEST_COUNT:
        raise DataError(f"Counts reach from {steps.min()} to {steps.max()} steps: it is damaged.")
    told = power(torch.from_numpy(np.maximum(steps, LEAST_COUNT))).numpy()
    return np.where(steps == NO_COUNT, 0.0, told)


def _float_counts(sender: int, ids: Tensor, counts: Tensor) -> bytes:
    writer = BitWriter()
    write_number(writer, "sender", sender)
    rows = np.empty(len(ids), _COUNT)
    rows["robot"], rows["number"], rows["count"] = ids[:, 0], ids[:, 1], counts
    return sealed(Kind.FLOAT_COUNTS, writer.to_bytes() + rows.tobytes())


def read_float_counts(body: bytes) -> CountsMessage:
    sender, rest = _sender_of(body)
    if len(rest) % _COUNT.itemsize:
        raise DataError(f"{len(rest)} bytes are not whole counts of {_COUNT.itemsize} bytes: truncated?")
    rows = np.frombuffer(rest, _COUNT)
    return _counts(sender, np.stack([rows["robot"], rows["number"]], 1).astype(np.int64), rows["count"])


def _thesis_counts(sender: int, ids: Tensor, counts: Tensor) -> bytes:
    writer = BitWriter()
    write_number(writer, "sender", sender)
    return sealed(Kind.THESIS_COUNTS, writer.to_bytes() + encode_thesis_updates(ids, counts))


def read_thesis_counts(body: bytes) -> CountsMessage:
    sender, rest = _sender_of(body)
    ids, counts = decode_thesis_updates(rest)
    return _counts(sender, ids.numpy(), counts.numpy())


def _sender_of(body: bytes) -> tuple[int, bytes]:
    """The number that a body of whole bytes begins with, and the rest."""
    reader = BitReader(body)
    sender = read_number(reader)
    return sender, body[len(body) - reader.left // 8 :]


def _counts(sender: int, ids: Ints, values: np.ndarray) -> CountsMessage:
    counts = {
        (robot, number): count for (robot, number), count in zip(ids.tolist(), values.tolist(), strict=True)
    }
    most = 2.0 ** (LARGEST_COUNT / PER_OCTAVE)
    if len(counts) != len(ids) or not all(0 <= count <= most for count in counts.values()):
        raise DataError(f"An id comes twice, or a count is not from 0 to {most:g}: it is damaged.")
    if len(ids) and int(ids.min()) < 0:
        raise DataError("An id is negative: it is damaged.")
    return CountsMessage(sender, counts)
