"""Attributes of components as bytes, a block beside the batch of their geometry; see docs/formats.md.

Errors are measured in a component's own deviations, as in `lattice`. Of a channel of numbers: a step, a power
of √2, which is half the deviation from its plane; the mean, and the slopes along the component's axes, in
these steps, so that each has the same share in the error of a prediction. Colours are written as
lightness and two differences, whose deviations are independent, with one step for all three, because an error
of each counts alike. Of a channel of classes: the most likely label, the next one, and their shares in
eighths. Every component is rounded by itself, and rounding again changes nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError
from gmmtorch.mapping.attributes.moments import Attributes, Channel, Labels, Numbers
from gmmtorch.mapping.codec.bitstream import BitReader, BitWriter, within
from gmmtorch.mapping.codec.number_model import LARGEST_POWER, MOST_STEPS, WHOLE, read_rows, write_rows
from gmmtorch.scan import COLOUR, LARGEST_LABEL, LONGEST_NAME, MOST_CHANNELS, MOST_COLUMNS

BLOCK_VERSION = 2
_MOST_REST = 3  # eighths of the second label
_LEAST_COLOUR = 2.0**-8  # deviation
_LEAST_RELATIVE = 2.0**-36  # deviation of other numbers, relative to the mean
_MOST_SHARES = 1 << 28  # of labels in components, 2 GiB in memory
_LIGHTNESS = torch.tensor([[1.0, 1.0, 1.0], [1.0, 0.0, -1.0], [1.0, -2.0, 1.0]], dtype=torch.float64)
_LIGHTNESS = _LIGHTNESS / _LIGHTNESS.norm(dim=1, keepdim=True)


class _LabelSteps(NamedTuple):
    """share (K,) in eighths; of the components with labels, the rows of the first and the second label (J,),
    and the share of the second in eighths; labels (C,)."""

    share: Tensor
    first: Tensor
    second: Tensor
    rest: Tensor
    labels: Tensor


def moved(attributes: Attributes, shift: Tensor) -> Attributes:
    """The attributes of components whose means move by `shift` (K, D): numbers follow their slopes."""
    return attributes.with_numbers(lambda c: c._replace(mean=c.mean + (c.slope @ shift[:, :, None])[:, :, 0]))


def rounded(attributes: Attributes, covariances: Tensor) -> Attributes:
    """The attributes after writing and reading them, for components with these rounded covariances (K, D, D),
    on the CPU."""
    return Attributes(
        {
            name: _numbers_of(name, _number_steps(name, c, covariances), covariances)
            if isinstance(c, Numbers)
            else _labels_of(_label_steps(c))
            for name, c in attributes.channels.items()
        }
    )


def encode_attributes(attributes: Attributes, covariances: Tensor) -> bytes:
    """The block of the attributes of components with these rounded covariances (K, D, D)."""
    n = len(attributes.channels)
    if n > MOST_CHANNELS:
        raise InvalidArgumentError(f"The map has {n} channels of attributes; {MOST_CHANNELS} can be stored.")
    writer = BitWriter()
    writer.number(n)
    for name, channel in attributes.channels.items():
        _write_name(writer, name)
        if isinstance(channel, Numbers):
            width = channel.mean.shape[1]
            data = write_rows(_number_steps(name, channel, covariances), width)
            writer.number(width)
            writer.number(len(data))
            writer.fixed(np.frombuffer(data, np.uint8).astype(np.int64), 8)
        else:
            steps = _label_steps(channel)
            if channel.share.numel() > _MOST_SHARES:
                raise InvalidArgumentError(
                    f"attributes[{name!r}]: {len(steps.share)} components with {len(steps.labels)} labels "
                    "are too many to be stored; give fewer labels."
                )
            writer.number(0)
            writer.number(len(steps.labels))
            for column in (steps.labels, steps.share, steps.first, steps.rest, steps.second[steps.rest > 0]):
                writer.column(column.numpy())
    return bytes([BLOCK_VERSION]) + writer.to_bytes()


def rows_of(attributes: Attributes, covariances: Tensor) -> dict[str, Tensor]:
    """The numbers that are written of each of K components, by channel: (K, n) int64, the share first; those
    of a component do not depend on the others."""
    found = {}
    for name, channel in sorted(attributes.channels.items()):
        if isinstance(channel, Numbers):
            found[name] = _number_steps(name, channel, covariances)
        else:
            steps = _label_steps(channel)
            second = torch.where(steps.rest > 0, steps.labels[steps.second], 0)
            own = torch.stack([steps.labels[steps.first], steps.rest, second], 1)
            found[name] = _spread(steps.share, own)
    return found


def _spread(share: Tensor, own: Tensor) -> Tensor:
    """Rows (K, 1 + n): the share (K,), and the numbers (J, n) of the components that have one."""
    rows = own.new_zeros(len(share), 1 + own.shape[1])
    rows[:, 0] = share
    rows[share > 0, 1:] = own
    return rows


def decode_attributes(data: bytes, covariances: Tensor, most: int | None = None) -> Attributes:
    """The attributes of components with these covariances (K, D, D). Raises `DataError` for data that
    `encode_attributes` did not write for K components. most: largest number of values in memory."""
    if not data or data[0] != BLOCK_VERSION:
        raise DataError(
            f"The attributes are version {data[0] if data else 'none'}; this gmmtorch reads {BLOCK_VERSION}."
        )
    reader = BitReader(data[1:])
    k, dim = covariances.shape[:2]
    left = _MOST_SHARES if most is None else most
    found: dict[str, Channel] = {}
    for _ in range(_bounded(reader.number(), "channels", 0, MOST_CHANNELS)):
        name = _read_name(reader)
        width = _bounded(reader.number(), "columns", 0, MOST_COLUMNS)
        if not width:
            found[name] = _labels_of(_read_labels(reader, k, left))
            left -= 0 if most is None else sum(value.numel() for value in found[name])
            continue
        if most is not None:
            left -= k * (1 + width * (1 + dim + width))
            _bounded(most - left, "values", 0, most)
        packed = reader.fixed(_bounded(reader.number(), "bytes", 0, reader.left // 8), 8)
        rows = read_rows(packed.astype(np.uint8).tobytes(), k, 1 + width * (dim + 2), width)
        found[name] = _numbers_of(name, rows, covariances)
    reader.finish()
    try:
        return Attributes(found).checked(k, dim)
    except GmmTorchError as error:
        raise DataError(f"The attributes are damaged: {error}") from error


def _write_name(writer: BitWriter, name: str) -> None:
    letters = np.frombuffer(name.encode(), np.uint8).astype(np.int64)
    if not 0 < len(letters) <= LONGEST_NAME:
        raise InvalidArgumentError(f"attributes[{name!r}]: a name has 1 to {LONGEST_NAME} bytes.")
    writer.number(len(letters))
    writer.fixed(letters, 8)


def _read_name(reader: BitReader) -> str:
    letters = reader.fixed(_bounded(reader.number(), "letters", 1, LONGEST_NAME), 8)
    return letters.astype(np.uint8).tobytes().decode("utf-8", errors="replace")


def _read_labels(reader: BitReader, k: int, most: int) -> _LabelSteps:
    n_labels = _bounded(reader.number(), "labels", 0, LARGEST_LABEL + 1)
    if k * n_labels > most:
        raise DataError(f"{k} components with {n_labels} labels are too many to read.")
    labels = _column(reader, n_labels, "labels", 0, LARGEST_LABEL)
    share = _column(reader, k, "shares", 0, WHOLE)
    n = int((share > 0).sum())
    if n and not n_labels:
        raise DataError("Components have labels, but there are none: the attributes are damaged.")
    first = _column(reader, n, "labels", 0, n_labels - 1)
    rest = _column(reader, n, "shares", 0, _MOST_REST)
    second = torch.zeros_like(first)
    second[rest > 0] = _column(reader, int((rest > 0).sum()), "labels", 0, n_labels - 1)
    return _LabelSteps(share, first, second, rest, labels)


def _column(reader: BitReader, n: int, name: str, least: int, largest: int) -> Tensor:
    return torch.from_numpy(within(reader.column(n), f"{name} of the attributes", least, largest))


def _bounded(value: int, name: str, least: int, largest: int) -> int:
    if not least <= value <= largest:
        raise DataError(f"The {name} of the attributes reach {value}, not {least} to {largest}: damaged.")
    return value


def _number_steps(name: str, channel: Numbers, covariances: Tensor) -> Tensor:
    """Rows (K, n) of `number_model`: the share in eighths; steps and means (A), slopes (A, D)."""
    share = _share_steps(channel.share)
    rows = share > 0
    basis = _basis(name, channel.mean)
    given = channel.mean[rows] @ basis.T
    variance = channel.covariance[rows].diagonal(dim1=1, dim2=2)
    if name == COLOUR:  # the same in every basis
        variance = variance.mean(1, keepdim=True).expand_as(variance)
    size, mean = _log(variance / 4), given
    # More than once, as the least step follows the rounded mean: so rounding again changes nothing.
    for _ in range(1 if name == COLOUR else 3):
        least = torch.full_like(mean, _LEAST_COLOUR) if name == COLOUR else _LEAST_RELATIVE * mean.abs()
        least = _log(least.square() / 4)
        size = torch.where(size < least - 2, least, size).clamp_min(-LARGEST_POWER)
        mean = (given / _power(size)).round() * _power(size)
    if bool((size > LARGEST_POWER).any()):
        raise InvalidArgumentError(
            f"attributes {name!r} reach {float(given.abs().max()):g}, too large to be stored."
        )
    step = _power(size)
    along = ((channel.slope[rows] @ _factors(covariances[rows])).mT @ basis.T).mT
    values = torch.cat([given / step, (along / step[:, :, None]).flatten(1)], 1)
    return _spread(share, torch.cat([size, values.round().clamp(-MOST_STEPS, MOST_STEPS).long()], 1))


def _share_steps(share: Tensor) -> Tensor:
    """Shares (K,) in eighths; 0 only for none."""
    return torch.where(share > 0, (share * WHOLE).round().long().clamp(1, WHOLE), 0)


def _log(variance: Tensor) -> Tensor:
    """Deviations, of which the variance is given, as whole powers of √2."""
    return variance.clamp_min(1e-60).log2().round().long()


def _label_steps(channel: Labels) -> _LabelSteps:
    share = _share_steps(channel.share.sum(1))
    rows = share > 0
    own = channel.share[rows]
    own = own / own.sum(1, keepdim=True).clamp_min(torch.finfo(own.dtype).tiny)
    if own.shape[1] < 2:
        first = second = own.new_zeros(len(own), dtype=torch.int64)
        return _LabelSteps(share, first, second, torch.zeros_like(first), channel.labels)
    (largest, next_one), (first, second) = (part.unbind(1) for part in own.topk(2, 1))
    pair = next_one / (largest + next_one)
    rest = (pair * WHOLE).round().long().clamp(0, _MOST_REST)
    return _LabelSteps(share, first, second, rest, channel.labels)


def _labels_of(steps: _LabelSteps) -> Labels:
    share, rows = steps.share.double() / WHOLE, (steps.share > 0).nonzero().squeeze(1)
    rest, table = steps.rest.double() / WHOLE, share.new_zeros(len(share), len(steps.labels))
    table.index_put_((rows, steps.second), share[rows] * rest, accumulate=True)
    table.index_put_((rows, steps.first), share[rows] * (1 - rest), accumulate=True)
    return Labels(table, steps.labels)


def _numbers_of(name: str, steps: Tensor, covariances: Tensor) -> Numbers:
    k, dim = covariances.shape[:2]
    width, rows = (steps.shape[1] - 1) // (dim + 2), (steps[:, 0] > 0).nonzero().squeeze(1)
    size, mean, slope = steps[rows, 1:].split([width, width, width * dim], 1)
    step = _power(size)
    along = slope.reshape(len(rows), width, dim) * step[:, :, None]
    basis = _basis(name, step)
    own_slope = basis.T @ torch.linalg.solve(_factors(covariances[rows]), along, left=False)
    own = (mean * step) @ basis, own_slope, basis.T @ torch.diag_embed(4 * step.square()) @ basis
    share = steps[:, 0].double() / WHOLE
    found = Numbers(share, *(share.new_zeros(k, *values.shape[1:]) for values in own))
    for whole, values in zip(found[1:], own, strict=True):
        whole[rows] = values
    return found


def _power(size: Tensor) -> Tensor:
    """√2 to the power of whole numbers."""
    return torch.exp2(size.double() / 2)


def _basis(name: str, like: Tensor) -> Tensor:
    """The directions (A, A), orthonormal, in which a channel is written."""
    return _LIGHTNESS if name == COLOUR else torch.eye(like.shape[1], dtype=torch.float64)


def _factors(covariances: Tensor) -> Tensor:
    """F (K, D, D) with Σ = F Fᵀ, whose columns are axes of falling length (Cholesky with pivoting)."""
    left, columns = covariances, []
    for _ in range(covariances.shape[1]):
        variance, pivot = left.diagonal(dim1=1, dim2=2).max(1)
        column = left.gather(2, pivot.view(-1, 1, 1).expand(-1, left.shape[1], 1))[:, :, 0]
        column = column / variance.clamp_min(1e-300).sqrt()[:, None]
        left = left - column[:, :, None] * column[:, None]
        columns.append(column)
    return torch.stack(columns, 2)
