"""Views worth going to, and what a robot is about to do, as datagrams. See docs/messages.md."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mapping.codec.bitstream import BitReader, BitWriter, Ints
from gmmtorch.sharing.messages.envelope import MAX_BYTES, Kind, sealed, split
from gmmtorch.sharing.messages.fields import (
    check_ids,
    pose_steps,
    read_intervals,
    read_keys,
    read_number,
    read_path,
    read_poses,
    seconds_of,
    ticks,
    write_intervals,
    write_keys,
    write_number,
    write_path,
    write_poses,
)
from gmmtorch.sharing.replica.intervals import Intervals
from gmmtorch.sharing.replica.record_keys import END, ids_of, keys_of

MOST_POSES = 1000
"""Of a path, and of the views of a plan: a robot at rest takes no bits for its poses."""
_HALF_BITS = 16


@dataclass(frozen=True, eq=False)
class ViewsMessage:
    """Views that are new or changed, and those that are no longer worth a visit.

    ids (V, 2): (robot, sequence), as of records; poses (V, 4); values (V,); stamps (V,) s.
    removed: their keys, as in `record_ids`.
    """

    ids: Tensor
    poses: Tensor
    values: Tensor
    stamps: Tensor
    removed: Intervals


@dataclass(frozen=True, eq=False)
class PlanMessage:
    """What `sender` has committed to, its plan number `number`.

    path (S, 4): poses at time, time + step, time + 2 step, … (s), the last of them at rest;
    views (V, 4): poses that it means to look from.
    """

    sender: int
    number: int
    time: float
    step: float
    path: Tensor
    views: Tensor


def encode_views(message: ViewsMessage, max_bytes: int = MAX_BYTES) -> list[bytes]:
    """Datagrams of views, 9 to 11 bytes each, and of tombstones; none of none. Ids may be in any order.

    Poses go to 1 cm and 1/256 of a turn (`quantized_poses`), values as float16 (65504 at most), stamps to
    1 ms. Raises `InvalidArgumentError` for what is not finite, for ids that come twice, and for rows that
    do not match.
    """
    m = message
    sizes = (len(m.poses), len(m.values), len(m.stamps))
    if sizes != (len(m.ids),) * 3:
        raise InvalidArgumentError(
            f"{len(m.ids)} ids with {sizes[0]} poses, {sizes[1]} values and {sizes[2]} stamps: one each is "
            "needed."
        )
    if not Intervals.span(0, END).covers(m.removed):
        raise InvalidArgumentError(f"removed={m.removed!r} goes beyond the keys that robots give.")
    keys = _keys(m.ids)
    order, dead = np.argsort(keys), m.removed
    keys = keys[order]
    steps, halves = pose_steps("poses", m.poses)[order], _halves(m.values)[order]
    times = ticks("stamps", m.stamps)[order]

    def some(begin: int, end: int) -> bytes:
        """Views begin … end − 1 of the row of all views and all intervals of tombstones."""
        seen = slice(min(begin, len(keys)), min(end, len(keys)))
        gone = slice(2 * max(begin - len(keys), 0), 2 * max(end - len(keys), 0))
        writer = BitWriter()
        write_keys(writer, keys[seen])
        write_poses(writer, steps[seen])
        writer.fixed(halves[seen], _HALF_BITS)
        writer.column(times[seen])
        write_intervals(writer, Intervals(dead.edges[gone]), 0)
        return sealed(Kind.VIEWS, writer.to_bytes())

    return split(len(keys) + len(dead), some, "view", max_bytes)


def read_views(body: bytes) -> ViewsMessage:
    reader = BitReader(body)
    keys = read_keys(reader)
    poses = read_poses(reader, len(keys))
    values = _values(reader.fixed(len(keys), _HALF_BITS))
    stamps = seconds_of(reader.column(len(keys)))
    removed = read_intervals(reader, 0, END)
    reader.finish()
    return ViewsMessage(ids_of(keys), poses, values, stamps, removed)


def encode_plan(
    sender: int, number: int, time: float, step: float, path: Tensor, views: Tensor | None = None
) -> list[bytes]:
    """The datagram of a plan, 1 to 3 bytes a pose of the path, 5 a view.

    Poses go to 1 cm and 1/256 of a turn, times to 1 ms.

    Args:
        sender: the robot that speaks. number: rises with each of its plans.
        time: (s) of the first pose of the path. step: (s) from each to the next, above zero.
        path: (S, 4). views: (V, 4).

    Raises `InvalidArgumentError` where the plan does not fit into a datagram.
    """
    writer = BitWriter()
    write_number(writer, "sender", sender)
    write_number(writer, "number", number)
    writer.number(int(ticks("time", torch.tensor([time], dtype=torch.float64))[0]))
    pace = int(ticks("step", torch.tensor([step], dtype=torch.float64))[0])
    if pace < 1:
        raise InvalidArgumentError(f"step={step} must be at least a millisecond.")
    writer.number(pace)
    for name, poses, write in (
        ("path", path, write_path),
        ("views", path[:0] if views is None else views, write_poses),
    ):
        if len(poses) > MOST_POSES:
            raise InvalidArgumentError(f"{name} has {len(poses)} poses; {MOST_POSES} are the most.")
        writer.number(len(poses))
        write(writer, pose_steps(name, poses))
    datagram = sealed(Kind.PLAN, writer.to_bytes())
    if len(datagram) > MAX_BYTES:
        raise InvalidArgumentError(
            f"The plan of {len(path)} poses takes {len(datagram)} bytes; a datagram has room for "
            f"{MAX_BYTES}. Send every second pose, or fewer."
        )
    return [datagram]


def read_plan(body: bytes) -> PlanMessage:
    reader = BitReader(body)
    sender, number = read_number(reader), read_number(reader)
    time, step = seconds_of(np.array([reader.number(), reader.number()])).tolist()
    if not step > 0:
        raise DataError(f"The poses of a path are {step} s apart: it is damaged.")
    path = read_path(reader, _read_size(reader))
    views = read_poses(reader, _read_size(reader))
    reader.finish()
    return PlanMessage(sender, number, time, step, path, views)


def _read_size(reader: BitReader) -> int:
    n = reader.number()
    if not 0 <= n <= MOST_POSES:
        raise DataError(f"{n} poses are announced; {MOST_POSES} are the most: it is damaged.")
    return n


def _keys(ids: Tensor) -> Ints:
    try:
        return keys_of(check_ids("ids", ids))
    except DataError as error:
        raise InvalidArgumentError(f"ids: {error}") from error


def _halves(values: Tensor) -> Ints:
    """The bits (V,) of values as float16."""
    rows = values.detach().double().cpu().numpy()
    if rows.ndim != 1 or not (np.abs(rows) <= np.finfo(np.float16).max).all():
        raise InvalidArgumentError("values must be a row of numbers up to 65504, the most of float16.")
    return rows.astype(np.float16).view(np.uint16).astype(np.int64)


def _values(bits: Ints) -> Tensor:
    values = bits.astype(np.uint16).view(np.float16).astype(np.float64)
    if not np.isfinite(values).all():
        raise DataError("Values are NaN or infinite: it is damaged.")
    return torch.from_numpy(values)
