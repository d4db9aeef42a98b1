"""Components, and points that components gained, as datagrams. See docs/messages.md."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.linalg import pack_symmetric, unpack_symmetric
from gmmtorch.mapping import FARTHEST as THESIS_FARTHEST
from gmmtorch.mapping import (
    LARGEST_COUNT,
    LARGEST_VARIANCE,
    MOST_POINTS,
    NO_COUNT,
    ORIGIN_STEP,
    BitReader,
    BitWriter,
    Components,
    Ints,
    Quantized,
    count_steps,
    decode,
    decode_thesis,
    decode_thesis_updates,
    encode_quantized,
    encode_thesis,
    encode_thesis_updates,
    fits,
    points_of,
    quantize,
    scaled,
)
from gmmtorch.team.sharing.messages.datagrams import (
    FARTHEST,
    LARGEST_NUMBER,
    MAX_BYTES,
    Kind,
    check_codec,
    check_ids,
    check_places,
    check_range,
    id_order,
    make_datagram,
    read_ids,
    read_number,
    split,
    write_ids,
    write_number,
)

MOST_COMPONENTS_SENT = 1024
"""Components, and viewpoints of them, in a datagram, as a receiver may cast hundreds of rays for each. A
map's datagrams have about 200."""

_SIZES = struct.Struct("<BIII")  # dimensions, components, origins, viewpoints
_FIRST_GUESS = 128  # components that are likely to fit into a datagram
_FILL = 0.95  # share of a datagram to fill, as components differ in size


@dataclass(frozen=True, eq=False)
class ComponentsMessage:
    """Components, as the sender's decoder returns them."""

    components: Components


def encode_components(components: Components, codec: str = "quantized") -> list[bytes]:
    """Datagrams of components in order, each with the sensor origins that it needs; empty without components.

    codec: "quantized": 5 to 8 bytes per component, rounded as `mapping.codec.quantized` does, and about 4 for
    a colour. "float": float64, unchanged. "thesis": 57 bytes for each component and sensor origin. Both
    without attributes.

    Raises `InvalidArgumentError` for values that the codec cannot store, positions beyond
    `datagrams.FARTHEST`, and a component with so many sensor origins that it does not fit into a datagram.
    """
    viewpoints = torch.bincount(components.seen_by, minlength=len(components)).cpu()
    _check_viewpoints(viewpoints)
    so_far = torch.cat([viewpoints.new_zeros(1), viewpoints.cumsum(0)]).tolist()
    write = {"quantized": _quantized, "float": _float, "thesis": _thesis}[check_codec(codec)]

    def part(begin: int, end: int) -> bytes:
        rows = torch.arange(begin, end, device=components.means.device)
        return write(components.selected(rows).with_used_origins())

    def is_allowed(begin: int, end: int) -> bool:
        part = components.attributes.selected(slice(begin, end))
        n = max(end - begin, so_far[end] - so_far[begin])
        return n <= MOST_COMPONENTS_SENT and fits(part, MOST_COMPONENTS_SENT)

    return split(len(components), part, "component", is_allowed=is_allowed)


def fitted(
    values: Quantized, max_bytes: int = MAX_BYTES, channels: bool = False
) -> Iterator[tuple[bytes, Quantized]]:
    """Datagrams of quantised components in order, each with as many as fit; and the components of each. Their
    number is estimated from the datagram before, which takes fewer attempts than halving. channels: whether
    they have their attributes."""
    _check_viewpoints(values.n_viewpoints)
    check_quantized(values)
    so_far = values.n_viewpoints.cumsum(0)
    begin, n = 0, _FIRST_GUESS
    while begin < len(values):
        before = int(so_far[begin - 1]) if begin else 0
        n_allowed = int(torch.searchsorted(so_far, before + MOST_COMPONENTS_SENT, right=True)) - begin
        n = min(n, MOST_COMPONENTS_SENT, n_allowed)
        whole = begin == 0 and n >= len(values)
        part = values if whole else values.arranged(torch.arange(begin, min(begin + n, len(values))))
        datagram = make_datagram(Kind.COMPONENTS, encode_quantized(part, channels))
        room = int(_FILL * len(part) * max_bytes / len(datagram))
        if len(datagram) <= max_bytes and (not channels or fits(part.attributes, MOST_COMPONENTS_SENT)):
            yield datagram, part
            begin, n = begin + len(part), max(1, room)
        elif len(part) > 1:
            n = max(1, min(room, len(part) - 1))
        else:
            raise InvalidArgumentError(
                f"A single component takes {len(datagram)} bytes; a datagram has room for {max_bytes}. "
                "Give it fewer sensor origins."
            )


def _quantized(components: Components) -> bytes:
    values = quantize(components)
    check_quantized(values)
    return make_datagram(Kind.COMPONENTS, encode_quantized(values, bool(values.attributes.present())))


def read_quantized(body: bytes) -> ComponentsMessage:
    return _message(read_batch(body, MOST_COMPONENTS_SENT))


def read_batch(data: bytes, most: int | None = None) -> Components:
    """The components of a codec batch of any size, or of `most` components and viewpoints. Raises `DataError`
    if they are damaged or out of range."""
    components = decode(data, most)
    try:
        _check_range(components.means, components.origins, components.ids)
    except InvalidArgumentError as error:
        raise DataError(f"The batch is out of range: {error}") from error
    return components


def _float_layout(dim: int, k: int, s: int, e: int) -> np.dtype:
    """The fields of k components with s origins and e viewpoints, in order."""
    return np.dtype(
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


def _float(components: Components) -> bytes:
    c = _checked(components)
    sizes = (c.dim, len(c), len(c.origins), len(c.seen_by))  # indices beyond 16 bits do not fit anyway
    row = np.zeros((), _float_layout(*sizes))
    for name, value in {**c.tensors(), "covariances": pack_symmetric(c.covariances)}.items():
        row[name] = value.detach().cpu().numpy()
    return make_datagram(Kind.FLOAT_COMPONENTS, _SIZES.pack(*sizes) + row.tobytes())


def read_float(body: bytes) -> ComponentsMessage:
    if len(body) < _SIZES.size:
        raise DataError(f"{len(body)} bytes are too few for components.")
    dim, k, s, e = _SIZES.unpack_from(body)
    if dim not in (2, 3):
        raise DataError(f"The components are {dim}-dimensional; a map has 2 or 3 dimensions.")
    if max(k, s, e) > len(body) or not k:
        raise DataError(f"{k} components, {s} origins and {e} viewpoints do not fit: it is damaged.")
    layout = _float_layout(dim, k, s, e)
    if len(body) != _SIZES.size + layout.itemsize:
        raise DataError(f"{len(body)} bytes do not match {k} components, {s} origins, {e} viewpoints.")
    row = np.frombuffer(body, layout, offset=_SIZES.size)[0]
    if (row["max_range"] > 1).any() or (row["ids"] < 0).any():
        raise DataError("A max_range flag or an id is out of range: it is damaged.")
    values: dict[str, Any] = {
        name: torch.from_numpy(row[name].astype(np.float64 if layout[name].base.kind == "f" else np.int64))
        for name in layout.names or ()
    }
    values["covariances"] = unpack_symmetric(values["covariances"], dim)
    values["max_range"] = values["max_range"] != 0
    return _message(_checked(Components(**values)))


def _thesis(components: Components) -> bytes:
    if components.dim != 3:
        raise InvalidArgumentError(
            f"codec=thesis stores 3D components, not {components.dim}D; use codec=quantized."
        )
    c = components
    count = c.seen_count.float().double()
    sent = replace(
        c,
        means=c.means.float().double(),
        covariances=c.covariances.float().double(),
        origins=c.origins.float().double(),
        support=count.new_zeros(len(c)).index_add_(0, c.seen_by, count),
        seen_count=count,
    )
    _checked(sent, THESIS_FARTHEST)
    return make_datagram(Kind.THESIS_COMPONENTS, encode_thesis(components))


def read_thesis(body: bytes) -> ComponentsMessage:
    return _message(_checked(decode_thesis(body, 3), THESIS_FARTHEST))


def _message(components: Components) -> ComponentsMessage:
    """The message of components; raises `DataError` if there are none, or more than a datagram may have."""
    k, e = len(components), len(components.seen_by)
    if k == 0 or max(k, e) > MOST_COMPONENTS_SENT:
        raise DataError(
            f"{k} components and {e} viewpoints; a datagram has from 1 to {MOST_COMPONENTS_SENT} of each: "
            "it is damaged."
        )
    return ComponentsMessage(components)


# Encoders apply the decoder's checks, so that an encoded message is always accepted.


def _check_viewpoints(viewpoints: Tensor) -> None:
    """Raise `InvalidArgumentError` if one of the components (K,) has too many viewpoints."""
    most = int(viewpoints.max()) if len(viewpoints) else 0
    if most > MOST_COMPONENTS_SENT:
        raise InvalidArgumentError(
            f"A single component has {most} viewpoints; a datagram may have {MOST_COMPONENTS_SENT}. Keep "
            "fewer of its origins: mapping.learning.merging.limit_origins."
        )


def check_quantized(values: Quantized) -> None:
    """Raise `InvalidArgumentError` if positions or ids are out of range."""
    means = scaled(values.places.mean, values.places.mean_exponents())
    _check_range(means, values.origins.double() * ORIGIN_STEP, values.ids)


def _check_range(means: Tensor, origins: Tensor, ids: Tensor, farthest: float = FARTHEST) -> None:
    check_places("means", means, farthest)
    check_places("origins", origins, farthest)
    check_range("ids", ids)


def _checked(components: Components, farthest: float = FARTHEST) -> Components:
    """The components, if they are in range and their covariances positive definite, as for "quantized"."""
    c = components.checked()
    _check_range(c.means, c.origins, c.ids, farthest)
    for name, value, limit in (
        ("covariances", c.covariances.diagonal(dim1=1, dim2=2), LARGEST_VARIANCE),
        ("support", c.support, MOST_POINTS),
        ("seen_count", c.seen_count, MOST_POINTS),
    ):
        if value.numel() and float(value.max()) > limit:
            raise InvalidArgumentError(
                f"{name} go up to {float(value.max()):g}; {limit:g} is the most. Are they in metres?"
            )
    sent = unpack_symmetric(pack_symmetric(c.covariances), c.dim)  # only the upper half is
    info = torch.linalg.cholesky_ex(sent).info
    if bool((info != 0).any()):
        first = int((info != 0).nonzero()[0])
        raise InvalidArgumentError(
            f"covariances[{first}] is not positive definite after rounding by this codec; use "
            "codec=quantized, which keeps it positive definite, or a larger least variance."
        )
    return c


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
    check_codec(codec)
    order = torch.from_numpy(id_order(check_ids("counts", ids)))
    ids, values = ids[order], values[order]

    def part(begin: int, end: int) -> bytes:
        some, gained = ids[begin:end], values[begin:end]
        writer = BitWriter()
        write_number(writer, "sender", sender)
        if codec == "quantized":
            write_ids(writer, some.numpy())
            writer.column(count_steps(gained))
            return make_datagram(Kind.COUNTS, writer.to_bytes())
        if codec == "thesis":
            return make_datagram(Kind.THESIS_COUNTS, writer.to_bytes() + encode_thesis_updates(some, gained))
        rows = np.empty(len(some), _COUNT)
        rows["robot"], rows["number"], rows["count"] = some[:, 0], some[:, 1], gained
        return make_datagram(Kind.FLOAT_COUNTS, writer.to_bytes() + rows.tobytes())

    return split(len(ids), part, "count")


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


def read_float_counts(body: bytes) -> CountsMessage:
    sender, rest = _sender_of(body)
    if len(rest) % _COUNT.itemsize:
        raise DataError(f"{len(rest)} bytes are not whole counts of {_COUNT.itemsize} bytes: truncated?")
    rows = np.frombuffer(rest, _COUNT)
    return _counts(sender, np.stack([rows["robot"], rows["number"]], 1).astype(np.int64), rows["count"])


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
