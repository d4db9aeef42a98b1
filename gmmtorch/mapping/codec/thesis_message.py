"""The thesis's message (4.2): one for each component and sensor position, 57 bytes in 3D, 37 in 2D.

Little-endian: id (uint32: robot · 2²⁴ + sequence), num_points (float32), sensor_loc (D float32), mean
(D float32), covariance (D(D+1)/2 float32, upper triangle by rows), max_range (uint8). A component with
several viewpoints takes a message for each. An update of a count is 8 bytes: id, num_points.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError
from gmmtorch.linalg import pack_symmetric, unpack_symmetric
from gmmtorch.mapping.components import Components

FARTHEST = 2.0**14
"""Metres from the origin: beyond it, steps of float32 exceed a millimetre."""
_ROBOT_BITS, _SEQUENCE_BITS = 8, 24


def message_type(dim: int) -> np.dtype[Any]:
    """Fields of a message in `dim` dimensions."""
    return np.dtype(
        [
            ("id", "<u4"),
            ("num_points", "<f4"),
            ("sensor_loc", "<f4", (dim,)),
            ("mean", "<f4", (dim,)),
            ("covariance", "<f4", (dim * (dim + 1) // 2,)),
            ("max_range", "u1"),
        ]
    )


UPDATE_TYPE = np.dtype([("id", "<u4"), ("num_points", "<f4")])


def encode_thesis(components: Components) -> bytes:
    """Messages of the components, one for each viewpoint.

    Raises `InvalidArgumentError` for ids that do not fit into 8 bits of robot and 24 of sequence, and
    for positions beyond `FARTHEST`.
    """
    c = components
    for name, value in (("means", c.means), ("origins", c.origins)):
        if value.numel() and not float(value.abs().max()) <= FARTHEST:
            raise InvalidArgumentError(
                f"{name} reach {float(value.abs().max()):g} m from the origin, where float32 is coarser "
                "than a millimetre; move the map nearer to the origin, or use the codec."
            )
    messages = np.zeros(len(c.seen_by), message_type(c.dim))
    messages["id"] = _id_numbers(c.ids)[c.seen_by.cpu().numpy()]
    messages["num_points"] = c.seen_count.cpu().numpy()
    messages["sensor_loc"] = c.origins[c.seen_from].cpu().numpy()
    messages["mean"] = c.means[c.seen_by].cpu().numpy()
    messages["covariance"] = pack_symmetric(c.covariances)[c.seen_by].cpu().numpy()
    messages["max_range"] = c.max_range[c.seen_by].cpu().numpy()
    return messages.tobytes()


def decode_thesis(data: bytes, dim: int) -> Components:
    """Components of messages; those with the same id are one component, described by the first message.

    Raises `DataError` when the length is not that of whole messages, or the numbers are no components.
    """
    messages = _messages(data, message_type(dim))
    numbers = torch.from_numpy(messages["id"].astype(np.int64))
    distinct, seen_by = torch.unique(numbers, return_inverse=True)
    rows = torch.arange(len(numbers))
    first = torch.full((len(distinct),), len(rows)).scatter_reduce_(0, seen_by, rows, "amin")
    count = _doubles(messages["num_points"])
    try:
        return Components(
            means=_doubles(messages["mean"])[first],
            covariances=unpack_symmetric(_doubles(messages["covariance"])[first], dim),
            support=count.new_zeros(len(distinct)).index_add_(0, seen_by, count),
            max_range=torch.from_numpy(messages["max_range"] != 0)[first],
            ids=_ids(distinct),
            origins=_doubles(messages["sensor_loc"]),
            seen_by=seen_by,
            seen_from=rows,
            seen_count=count,
        ).checked()
    except GmmTorchError as error:
        raise DataError(f"The messages are damaged: {error}") from error


def encode_thesis_updates(ids: Tensor, counts: Tensor) -> bytes:
    """Updates: the current counts (J,) of components with these ids (J, 2)."""
    updates = np.zeros(len(ids), UPDATE_TYPE)
    updates["id"] = _id_numbers(ids)
    updates["num_points"] = counts.cpu().numpy()
    return updates.tobytes()


def decode_thesis_updates(data: bytes) -> tuple[Tensor, Tensor]:
    """Ids (J, 2) and counts (J,) of updates."""
    updates = _messages(data, UPDATE_TYPE)
    counts = _doubles(updates["num_points"])
    if not bool((torch.isfinite(counts) & (counts >= 0)).all()):
        raise DataError("The updates hold counts that are negative, infinite or NaN: they are damaged.")
    return _ids(torch.from_numpy(updates["id"].astype(np.int64))), counts


def _messages(data: bytes, layout: np.dtype[Any]) -> NDArray[Any]:
    if len(data) % layout.itemsize:
        raise DataError(f"{len(data)} bytes are not whole messages of {layout.itemsize} bytes: truncated?")
    return np.frombuffer(data, layout)


def _id_numbers(ids: Tensor) -> NDArray[np.int64]:
    limits = ids.new_tensor([1 << _ROBOT_BITS, 1 << _SEQUENCE_BITS])
    bad = ((ids < 0) | (ids >= limits)).any(1)
    if bool(bad.any()):
        first = ids[bad][0].tolist()
        raise InvalidArgumentError(
            f"id {first} does not fit into a message: robots go to {(1 << _ROBOT_BITS) - 1}, sequences to "
            f"{(1 << _SEQUENCE_BITS) - 1}."
        )
    return (ids[:, 0] << _SEQUENCE_BITS | ids[:, 1]).cpu().numpy()


def _ids(numbers: Tensor) -> Tensor:
    return torch.stack([numbers >> _SEQUENCE_BITS, numbers & ((1 << _SEQUENCE_BITS) - 1)], 1)


def _doubles(values: NDArray[Any]) -> Tensor:
    with np.errstate(invalid="ignore"):  # signalling NaNs warn when cast; NaNs are refused later
        return torch.from_numpy(values.astype(np.float64))
