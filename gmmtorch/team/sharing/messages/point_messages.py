"""Novel points of a frame as datagrams, for teams that share grids. See docs/messages.md."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, check_whole
from gmmtorch.team.sharing.messages.envelope import MAX_BYTES, Kind, check_places, make_datagram

_HEADER = struct.Struct("<HI3dHHH")  # sender, frame, origin, part, parts, points
_POINT_BYTES = 12
_OVERHEAD = len(make_datagram(Kind.POINTS, b""))
POINTS_PER_DATAGRAM = (MAX_BYTES - _OVERHEAD - _HEADER.size) * 8 // (8 * _POINT_BYTES + 1)
LARGEST_ROBOT, LARGEST_FRAME, MOST_PARTS = (1 << 16) - 1, (1 << 32) - 1, (1 << 16) - 1


@dataclass(frozen=True, eq=False)
class PointsMessage:
    """Part `part` of `n_parts` of the novel beams of a robot's frame.

    origin (3,) of all beams, ends (N, 3), float64, metres, world frame; is_hit (N,) bool: the others are
    no-return beams, which end at the range where they are cut off.
    """

    sender: int
    frame: int
    part: int
    n_parts: int
    origin: Tensor
    ends: Tensor
    is_hit: Tensor


def encode_points(sender: int, frame: int, origin: Tensor, ends: Tensor, is_hit: Tensor) -> list[bytes]:
    """Datagrams of beams in order, 12 1/8 bytes each; empty without beams.

    Ends are stored as float32 offsets from the origin, so that they are equally exact anywhere in the world.

    Args:
        sender: id of the robot, up to 65535. frame: its number, up to 2³² − 1.
        origin: (3,), metres. ends: (N, 3), metres. is_hit: (N,) bool.

    Raises `InvalidArgumentError` for values out of range, and for positions beyond `envelope.FARTHEST`.
    """
    check_whole("sender", sender, 0, LARGEST_ROBOT)
    check_whole("frame", frame, 0, LARGEST_FRAME)
    if ends.shape[1:] != (3,) or origin.shape != (3,) or is_hit.shape != ends.shape[:1]:
        raise InvalidArgumentError(
            f"origin {tuple(origin.shape)}, ends {tuple(ends.shape)} and is_hit {tuple(is_hit.shape)} must "
            "be (3,), (N, 3) and (N,)."
        )
    place = origin.detach().double().cpu()
    check_places("origin", place[None])
    rounded = (ends.detach().double().cpu() - place).float()
    check_places("ends", place + rounded.double())
    offsets = rounded.numpy()
    hits = is_hit.cpu().numpy().astype(bool)
    starts = range(0, len(offsets), POINTS_PER_DATAGRAM)
    if len(starts) > MOST_PARTS:
        raise InvalidArgumentError(
            f"{len(offsets)} points of one frame; at most {MOST_PARTS * POINTS_PER_DATAGRAM} can be sent."
        )
    datagrams = []
    for part, begin in enumerate(starts):
        chosen = slice(begin, begin + POINTS_PER_DATAGRAM)
        rows, bits = offsets[chosen], np.packbits(hits[chosen])
        header = _HEADER.pack(sender, frame, *place.tolist(), part, len(starts), len(rows))
        datagrams.append(make_datagram(Kind.POINTS, header + rows.astype("<f4").tobytes() + bits.tobytes()))
    return datagrams


def read_points(body: bytes) -> PointsMessage:
    if len(body) < _HEADER.size:
        raise DataError(f"{len(body)} bytes are too few for points.")
    sender, frame, x, y, z, part, n_parts, n = _HEADER.unpack_from(body)
    if len(body) != _HEADER.size + _POINT_BYTES * n + (n + 7) // 8 or not part < n_parts or n == 0:
        raise DataError(f"{len(body)} bytes with {n} points, part {part} of {n_parts}: it is damaged.")
    offsets = np.frombuffer(body, "<f4", 3 * n, _HEADER.size).reshape(n, 3)
    bits = np.unpackbits(np.frombuffer(body, np.uint8, offset=_HEADER.size + _POINT_BYTES * n))
    if bits[n:].any() or not np.isfinite(offsets).all():
        raise DataError("Points are NaN or infinite, or padding bits are set: it is damaged.")
    offsets = offsets.astype(np.float64)  # after the check, as casting some NaNs raises a warning
    origin = torch.tensor([x, y, z], dtype=torch.float64)
    check_places("origin", origin[None])
    return PointsMessage(
        sender=sender,
        frame=frame,
        part=part,
        n_parts=n_parts,
        origin=origin,
        ends=check_places("ends", origin + torch.from_numpy(offsets)),
        is_hit=torch.from_numpy(bits[:n] != 0),
    )
