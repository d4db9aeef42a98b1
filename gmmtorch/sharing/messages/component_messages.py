"""Components as datagrams. See docs/messages.md."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.linalg import pack_symmetric, unpack_symmetric
from gmmtorch.mapping.codec import component_batch as batches
from gmmtorch.mapping.codec.lattice import LARGEST_VARIANCE, scaled
from gmmtorch.mapping.codec.quantization import MOST_POINTS, ORIGIN_STEP, Quantized, quantize
from gmmtorch.mapping.codec.thesis_message import FARTHEST as THESIS_FARTHEST
from gmmtorch.mapping.codec.thesis_message import decode_thesis, encode_thesis
from gmmtorch.mapping.components import Components
from gmmtorch.sharing.messages.envelope import FARTHEST, MAX_BYTES, Kind, check_codec, sealed, split
from gmmtorch.sharing.messages.fields import LARGEST_NUMBER, check_places

LARGEST_BATCH = 1024
"""Components, and sightings of them, in a datagram: for each a receiver may have to cast hundreds of rays. Of
a map there are some 170."""

_SIZES = struct.Struct("<BIII")  # dimensions, components, origins, sightings
_TRIED = 128
"""Components that are likely to fit into a datagram."""
_FILL = 0.95
"""Of a datagram, as components are not all of the same size."""


@dataclass(frozen=True, eq=False)
class ComponentsMessage:
    """Components as whoever sent them holds them."""

    components: Components


def encode_components(
    components: Components, codec: str = "quantized", max_bytes: int = MAX_BYTES
) -> list[bytes]:
    """Datagrams of components in order, each with the sensor positions that it needs; none of none.

    Args:
        codec: "quantized": 8 to 10 bytes a component, and `mapping.codec.quantized` says what comes out.
            "float": float64, as they are. "thesis": 57 bytes for each component and sensor position.
        max_bytes: of each datagram.

    Raises `InvalidArgumentError` for what the codec cannot store, or lies farther out than
    `envelope.FARTHEST`, and for a component of so many sensor positions that it does not fit into a datagram.
    """
    sightings = torch.bincount(components.seen_by, minlength=len(components)).cpu()
    _check_sightings(sightings)
    so_far = torch.cat([sightings.new_zeros(1), sightings.cumsum(0)]).tolist()
    write = {"quantized": _quantized, "float": _float, "thesis": _thesis}[check_codec(codec)]

    def part(begin: int, end: int) -> bytes:
        return write(_part(components, begin, end))

    def may_go(begin: int, end: int) -> bool:
        return max(end - begin, so_far[end] - so_far[begin]) <= LARGEST_BATCH

    return split(len(components), part, "component", max_bytes, may_go)


def fitted(values: Quantized, max_bytes: int = MAX_BYTES) -> Iterator[tuple[bytes, Quantized]]:
    """Quantised components in order, as datagrams of as many as fit, and what each of these holds.

    As many are tried as the datagram before lets expect to fit, rather than halves of all.
    """
    _check_sightings(values.sightings)
    _check_quantized(values)
    so_far = values.sightings.cumsum(0)
    begin, n = 0, _TRIED
    while begin < len(values):
        told = int(so_far[begin - 1]) if begin else 0
        n_seen = int(torch.searchsorted(so_far, told + LARGEST_BATCH, right=True)) - begin
        n = min(n, LARGEST_BATCH, n_seen)
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
    values = quantize(components)
    _check_quantized(values)
    return sealed(Kind.COMPONENTS, batches.encode_quantized(values))


def read_quantized(body: bytes) -> ComponentsMessage:
    return _message(read_batch(body))


def read_batch(data: bytes) -> Components:
    """A codec batch of any size, with positions and ids that a message can have. Raises `DataError`."""
    components = batches.decode(data)
    try:
        _check_range(components.means, components.origins, components.ids)
    except InvalidArgumentError as error:
        raise DataError(f"The batch is out of range: {error}") from error
    return components


def _float(components: Components) -> bytes:
    c = _checked(components)
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
    if max(k, s, e) > len(body) or not k:
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
    return _message(_checked(Components(**values)))


def _thesis(components: Components) -> bytes:
    if components.dim != 3:
        raise InvalidArgumentError(
            f"The thesis's messages are of 3D components, not {components.dim}D; use codec=quantized."
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
    return sealed(Kind.THESIS_COMPONENTS, encode_thesis(components))


def read_thesis(body: bytes) -> ComponentsMessage:
    return _message(_checked(decode_thesis(body, 3), THESIS_FARTHEST))


def _message(components: Components) -> ComponentsMessage:
    """Of components in range, if they are as many as a datagram may have."""
    k, e = len(components), len(components.seen_by)
    if k == 0 or max(k, e) > LARGEST_BATCH:
        raise DataError(
            f"{k} components and {e} sightings; a datagram has a component, and {LARGEST_BATCH} of either "
            "at most: it is damaged."
        )
    return ComponentsMessage(components)


# Who writes asks the same as who reads, so that nobody says what nobody takes.


def _check_sightings(sightings: Tensor) -> None:
    """Raises `InvalidArgumentError` where one of components (K,) was seen from too many places."""
    most = int(sightings.max()) if len(sightings) else 0
    if most > LARGEST_BATCH:
        raise InvalidArgumentError(
            f"A single component was seen from {most} places; a datagram may have {LARGEST_BATCH}. Let it "
            "have fewer sensor positions: mapping.sightings.limit_origins."
        )


def _check_quantized(values: Quantized) -> None:
    means = scaled(values.places.mean, values.places.mean_exponents())
    _check_range(means, values.origins.double() * ORIGIN_STEP, values.ids)


def _check_range(means: Tensor, origins: Tensor, ids: Tensor, farthest: float = FARTHEST) -> None:
    check_places("means", means, farthest)
    check_places("origins", origins, farthest)
    if len(ids) and not 0 <= int(ids.min()) <= int(ids.max()) <= LARGEST_NUMBER:
        raise InvalidArgumentError(
            f"ids reach from {int(ids.min())} to {int(ids.max())}; robots and numbers go from 0 to "
            f"{LARGEST_NUMBER}."
        )


def _checked(components: Components, farthest: float = FARTHEST) -> Components:
    """Itself, if it is as the lattice of `quantized` would have it: definite, and nothing absurd."""
    c = components.checked()
    _check_range(c.means, c.origins, c.ids, farthest)
    for name, value, limit in (
        ("covariances", c.covariances.diagonal(dim1=1, dim2=2), LARGEST_VARIANCE),
        ("support", c.support, MOST_POINTS),
        ("seen_count", c.seen_count, MOST_POINTS),
    ):
        if value.numel() and float(value.max()) > limit:
            raise InvalidArgumentError(f"{name} reach {float(value.max()):g}; {limit:g} is the most. Metres?")
    _check_definite(unpack_symmetric(pack_symmetric(c.covariances), c.dim))  # its lower half is not sent
    return c


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
