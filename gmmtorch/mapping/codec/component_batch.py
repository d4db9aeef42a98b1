"""Batches: components as bytes, any number of them; see docs/formats.md.

A component takes about 10 bytes in 3D and 7 in 2D. Its rounding error is bounded in its own standard
deviations (see `lattice`), and its covariance stays positive definite. A component decodes to the same values
in every batch: `decode(encode(c))` is `quantized(c)`, and encoding decoded components again, in any grouping,
changes nothing.
"""

from __future__ import annotations

import zlib
from dataclasses import replace

import torch
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.linalg import argsort
from gmmtorch.mapping.codec import lattice
from gmmtorch.mapping.codec.batch_stream import order_of, read_values, write_values
from gmmtorch.mapping.codec.bitstream import BitCounter, BitReader, BitWriter
from gmmtorch.mapping.codec.quantization import Quantized, quantize
from gmmtorch.mapping.components import Components

BATCH_VERSION = 1
_VERSION_BYTES, _CHECKSUM_BYTES = 1, 4


def encode(components: Components) -> bytes:
    """A batch of components. Raises `InvalidArgumentError` for values that are too large to be stored."""
    return encode_quantized(quantize(components))


def encode_quantized(values: Quantized) -> bytes:
    """A batch of components that `quantize` has rounded. The values are not checked again."""
    writer = BitWriter()
    write_values(writer, values)
    body = bytes([BATCH_VERSION]) + writer.to_bytes()
    return body + zlib.crc32(body).to_bytes(_CHECKSUM_BYTES, "little")


def batch_bytes(values: Quantized) -> int:
    """The length of `encode_quantized(values)`, without writing it."""
    counter = BitCounter()
    write_values(counter, values)
    return _VERSION_BYTES + -(-counter.n_bits // 8) + _CHECKSUM_BYTES


def decode(data: bytes) -> Components:
    """The components of a batch, on the CPU.

    Raises `DataError`, with the reason, for data that `encode` did not write. Memory is bounded in proportion
    to the length of the data, for any numbers in them.
    """
    body, checksum = data[:-_CHECKSUM_BYTES], data[-_CHECKSUM_BYTES:]
    if len(data) <= _CHECKSUM_BYTES:
        raise DataError(f"{len(data)} bytes are too few for a batch of components: it is truncated.")
    if body[0] != BATCH_VERSION:
        raise DataError(
            f"The batch of components is version {body[0]}; this gmmtorch reads version {BATCH_VERSION}. "
            "It is foreign or damaged, or gmmtorch needs an update."
        )
    if zlib.crc32(body) != int.from_bytes(checksum, "little"):
        raise DataError("The batch of components does not match its checksum: it is truncated or damaged.")
    try:
        return read_values(BitReader(body[1:])).restored().checked()
    except DataError:
        raise
    except GmmTorchError as error:
        raise DataError(f"The batch of components is damaged: {error}") from error


def quantized(components: Components) -> Components:
    """The result of `decode(encode(components))`, on the components' device, without writing bits."""
    restored = quantize(components).restored()
    device = components.means.device
    return Components(**{name: value.to(device) for name, value in vars(restored).items()})


# -- order and numbers -----------------------------------------------------------------------------------


def spatial_order(components: Components) -> Tensor:
    """An order (K,) of components by place, which saves log₂ K! bits in all, about a byte a component.

    Use it before components are numbered: ids take few bits only if they are consecutive.
    """
    places = lattice.nearest(components.means.double().cpu(), components.covariances.double().cpu())
    return order_of(places).to(components.means.device)


def numbered(components: Components, robot: int, first: int) -> Components:
    """Components with ids for those that have none: (robot, first), (robot, first + 1), …

    New components come last, in their spatial order.
    """
    ids, order = _numbering(components.ids, spatial_order(components), robot, first)
    return replace(components.rearranged(order), ids=ids)


def quantize_numbered(components: Components, robot: int, first: int) -> Quantized:
    """The same as `quantize(numbered(components, robot, first))`, rounding every component once."""
    values = quantize(components)
    ids, order = _numbering(values.ids, order_of(values.places), robot, first)
    return replace(values.reordered(order), ids=ids)


def _numbering(ids: Tensor, by_place: Tensor, robot: int, first: int) -> tuple[Tensor, Tensor]:
    """Ids (K, 2) after numbering, and the order (K,) of the components: numbered ones, then new ones."""
    is_new = ids[:, 1] < 0
    rank = torch.zeros_like(ids[:, 0])
    rank[by_place] = torch.arange(len(ids), device=ids.device)
    order = argsort(torch.where(is_new, len(ids) + rank, 0))
    ids = ids[order].clone()
    numbers = first + torch.arange(int(is_new.sum()), device=ids.device)
    ids[len(ids) - len(numbers) :] = torch.stack([torch.full_like(numbers, robot), numbers], 1)
    return ids, order
