"""Points of sensor messages: PointCloud2, LaserScan, depth images, lists of points.

Input are messages as `MessageDecoder` returns them. Every size in them is checked against their data.
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.depth_images import MAX_PIXELS, metric, read_png
from gmmtorch.datasets.point_files.channels import channel_of, fields_of
from gmmtorch.datasets.point_files.point_rows import PACKED
from gmmtorch.errors import DataError

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_TIME_FIELDS = frozenset(
    {"t", "ts", "time", "times", "timestamp", "timestamps", "stamp", "stamps", "offsettime", "timeoffset"}
    | {"timeoffsetns", "offsetns", "pointtime", "pointtimeoffset", "deltatime", "reltime", "relativetime"}
)
"""Names of fields with times of points, in lower case and without underscores."""
_LONGEST_LASER_SWEEP = 2.0  # s
_MILLIMETRE = 0.001
_ALIGNMENT = 8  # bytes; a row of points is padded by less
_COMPRESSED_DEPTH_BYTES = 12
_PNG = b"\x89PNG"


class Reading(NamedTuple):
    """The points of one message.

    points: (N, 3) float64, sensor frame, metres; finite and not at the sensor. no_return: (N,) whether the
    beam met nothing. times: (N,) as the message states them, see `PointTimes`; None without times of points.
    doubt: why the times that the message states cannot be used, if so. channels: of the points, see `Scan`.
    """

    points: np.ndarray
    no_return: np.ndarray
    times: np.ndarray | None
    doubt: str = ""
    channels: Mapping[str, Tensor] = MappingProxyType({})

    def where(self, kept: np.ndarray) -> Reading:
        """The points of a mask (N,)."""
        times = None if self.times is None else self.times[kept]
        channels = {name: values[torch.from_numpy(kept)] for name, values in self.channels.items()}
        return Reading(self.points[kept], self.no_return[kept], times, self.doubt, channels)


def reading(
    points: np.ndarray,
    no_return: np.ndarray | None = None,
    times: np.ndarray | None = None,
    channels: Mapping[str, Tensor] = MappingProxyType({}),
) -> Reading:
    """The valid ones of some points: finite, and not at the sensor."""
    empty = np.zeros(len(points), bool) if no_return is None else no_return
    found = Reading(points, empty, times, channels=channels)
    return found.where(np.isfinite(points).all(1) & (points != 0).any(1))


def cloud_points(message: dict[str, Any], wanted: Sequence[str] = ()) -> Reading:
    """The points of a PointCloud2 with any layout of fields and either byte order, with the wanted channels
    that it has."""
    width, height, step = int(message["width"]), int(message["height"]), int(message["point_step"])
    data = message["data"]
    if width * height == 0:
        return reading(np.empty((0, 3)))
    row = _row_bytes((height, width), step, int(message["row_step"]), _ALIGNMENT, len(data))
    _check_fields(message["fields"])
    order = ">" if message["is_bigendian"] else "<"
    fields = {f["name"]: f for f in message["fields"]}
    missing = [axis for axis in "xyz" if axis not in fields]
    if missing:
        raise DataError(f"the cloud has no field {missing[0]}, only {', '.join(fields) or 'none'}")
    time = _time_field(fields)
    of_channels = {name: fields_of(name, fields) for name in wanted}
    names = list(dict.fromkeys([*"xyz", *([time] if time else []), *itertools.chain(*of_channels.values())]))
    layout: dict[str, Any] = {"names": names, "formats": [], "offsets": [], "itemsize": step}
    for name in names:
        offset, kind = int(fields[name]["offset"]), _TYPES.get(int(fields[name]["datatype"]))
        if kind is None or offset + np.dtype(kind).itemsize > step:
            raise DataError(f"field {name} does not fit into a point of {step} bytes")
        layout["formats"].append(order + ("u4" if name in PACKED else kind))
        layout["offsets"].append(offset)
    table = np.ndarray((height, width), np.dtype(cast(Any, layout)), bytes(data), 0, (row, step)).ravel()
    channels = {}
    for name, chosen in of_channels.items():
        if chosen:
            columns = [table[field] for field in chosen]
            channels[name] = channel_of(name, columns, [column.dtype for column in columns], "the cloud")
    return _table_points(table, time, channels)


def _time_field(names: Iterable[str]) -> str | None:
    return next((name for name in names if name.lower().replace("_", "") in _TIME_FIELDS), None)


def _table_points(
    table: np.ndarray, time: str | None, channels: Mapping[str, Tensor] = MappingProxyType({})
) -> Reading:
    times = None if time is None else table[time].astype(table[time].dtype.newbyteorder("="), copy=False)
    with np.errstate(invalid="ignore"):  # signalling NaNs, which random bytes contain
        points = np.stack([table[axis].astype(np.float64) for axis in "xyz"], 1)
    return reading(points, None, times, channels)


def _row_bytes(shape: tuple[int, int], item: int, step: int, most_padding: int, n_bytes: int) -> int:
    """The bytes of a row of items (H, W), which are `step` if rows are padded, but only if all data is used.

    Raises `DataError` otherwise: if one of the sizes is wrong, the items would be others.
    """
    height, width = shape
    is_padded = height > 1 and 0 < step - width * item < most_padding
    if 0 < height * width * item == n_bytes and not is_padded:
        return width * item
    if is_padded and height * step == n_bytes:
        return step
    raise DataError(
        f"{height} × {width} items of {item} bytes, in rows of {step} bytes, do not fit the {n_bytes} bytes "
        "of the message"
    )


def _check_fields(fields: list[dict[str, Any]]) -> None:
    """Raise `DataError` if coordinates are not numbers of one kind in places of their own."""
    places = [(int(f["offset"]), _TYPES.get(int(f["datatype"]), "V0"), f["name"]) for f in fields]
    ours = [place for place in places if place[2] in ("x", "y", "z")]
    for offset, kind, name in ours:
        for other, their_kind, their_name in places:
            is_other = (other, their_kind, their_name) != (offset, kind, name)
            if is_other and offset < other + int(their_kind[1:]) and other < offset + int(kind[1:]):
                raise DataError(f"the fields {name} and {their_name} overlap")
    if len({name for _, _, name in ours}) < len(ours) or len({kind[0] for _, kind, _ in ours}) > 1:
        raise DataError(f"x, y, z are not three fields of one kind, but {ours}")


def listed_points(message: dict[str, Any], field: str) -> Reading:
    """The points of a message with a list of points in `field`, such as Livox's CustomMsg."""
    table = message[field]
    if len(table) == 0:
        return reading(np.empty((0, 3)))
    return _table_points(table, _time_field(table.dtype.names))


def laser_points(message: dict[str, Any]) -> Reading:
    """The beam ends of a LaserScan, or the nearest echoes of a MultiEchoLaserScan. Infinite ranges and too
    long ones have no return, and so have beams without an echo."""
    ranges = _nearest_echoes(message["ranges"])
    farthest = float(message["range_max"])
    limit = farthest if 0 < farthest < np.inf else np.inf
    angles = float(message["angle_min"]) + np.arange(len(ranges)) * float(message["angle_increment"])
    _check_angles(angles, message)
    with np.errstate(invalid="ignore"):
        no_return = (ranges > limit) | (ranges == np.inf)
        valid = (ranges > 0) & (ranges >= float(message["range_min"])) & (no_return | (ranges <= limit))
    length = np.where(valid & ~no_return, ranges, np.where(valid, limit if limit < np.inf else 1.0, 0.0))
    points = np.stack([length * np.cos(angles), length * np.sin(angles), np.zeros_like(length)], 1)
    times, doubt = _beam_times(message, len(ranges))
    return reading(points, no_return, times)._replace(doubt=doubt)


def _nearest_echoes(ranges: Any) -> np.ndarray:
    """Ranges (N,), float64, in metres: of beams, or of beams with echoes, whose nearest counts."""
    if isinstance(ranges, np.ndarray):
        return ranges.astype(np.float64)
    counts = np.array([len(beam["echoes"]) for beam in ranges], np.int64)
    echoes = np.concatenate([np.empty(0), *(beam["echoes"] for beam in ranges)])
    found = np.where(counts > 0, np.nan, np.inf)
    np.fmin.at(found, np.repeat(np.arange(len(counts)), counts), np.where(echoes > 0, echoes, np.nan))
    return found


def _beam_times(message: dict[str, Any], n_beams: int) -> tuple[np.ndarray | None, str]:
    """Times (N,) of the beams of a LaserScan in ns after the first; None if it states none. And why they
    cannot be used, or nothing."""
    step, scan_time = float(message["time_increment"]), float(message.get("scan_time", 0))
    sweep = step * (n_beams - 1)
    if step == 0 or n_beams < 2:
        return None, ""
    if not 0 < sweep < _LONGEST_LASER_SWEEP:
        return None, f"time_increment gives no sweep of 0 to {_LONGEST_LASER_SWEEP:g} s"
    if scan_time > 0 and not scan_time / 20 < sweep < 1.2 * scan_time:
        return None, "time_increment contradicts scan_time"
    return np.round(np.arange(n_beams) * step * 1e9).astype(np.int64), ""


def _check_angles(angles: np.ndarray, message: dict[str, Any]) -> None:
    """Raise `DataError` unless the beams (N,) of a LaserScan have the directions that its limits state.

    Drivers differ by up to two beams in what they call the last angle; some do not state it, as 0.
    """
    increment, last = float(message["angle_increment"]), float(message.get("angle_max", 0))
    if not np.isfinite(angles).all():
        raise DataError("the angles of the laser are not finite")
    if len(angles) > 1 and increment == 0:
        raise DataError(f"all {len(angles)} beams have one direction: angle_increment is 0")
    if len(angles) > 1 and last != 0 and not abs(angles[-1] - last) < 2.5 * abs(increment):
        raise DataError(
            f"{len(angles)} beams from angle_min={angles[0]:.4f} with angle_increment={increment:.6f} end at "
            f"{angles[-1]:.4f}, not at angle_max={last:.4f}; the directions of the beams are not known"
        )


def depth_image(message: dict[str, Any], scale: float | None = None) -> Tensor:
    """Depth (H, W) in metres, float64, 0 where it is unknown, of an Image with 16UC1, mono16 or 32FC1.

    scale: metres per unit; None: 0.001 for whole numbers, 1 for 32FC1.
    """
    width, height, step = int(message["width"]), int(message["height"]), int(message["step"])
    kind = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}.get(message["encoding"])
    if kind is None:
        raise DataError(f"encoding {message['encoding']} is not a depth: expected 16UC1, mono16 or 32FC1")
    dtype = np.dtype((">" if message["is_bigendian"] else "<") + kind)
    data = message["data"]
    if width * height > MAX_PIXELS:
        raise DataError(f"{width} × {height} pixels are announced; at most {MAX_PIXELS:,} are read")
    row = _row_bytes((height, width), dtype.itemsize, step, width * dtype.itemsize, len(data))
    raw = np.ndarray((height, width), dtype, bytes(data), 0, (row, dtype.itemsize))
    return metric(raw, scale or _MILLIMETRE) if kind == "u2" else _finite(raw.astype(np.float64), scale)


def compressed_depth_image(message: dict[str, Any], scale: float | None = None) -> Tensor:
    """Depth (H, W) in metres of a CompressedImage of compressed_depth_image_transport, in PNG.

    For 32FC1 the image stores q = a / d + b with the two parameters in the header of the data.
    """
    form, data = str(message["format"]), bytes(message["data"])
    start = 0 if data.startswith(_PNG) else _COMPRESSED_DEPTH_BYTES
    if not data[start:].startswith(_PNG):
        raise DataError(
            f"the image has format {form!r}, which is not a depth in PNG; record raw depth images"
        )
    raw = read_png(io.BytesIO(data[start:]), "the compressed image")
    if "32FC1" not in form or start == 0:
        return metric(raw, scale or _MILLIMETRE)
    a, b = np.frombuffer(data, "<f4", 2, 4).astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return _finite(np.where(raw > 0, a / (raw.astype(np.float64) - b), 0), scale)


def _finite(depth: np.ndarray, scale: float | None) -> Tensor:
    with np.errstate(invalid="ignore"):
        valid = torch.from_numpy(np.where(np.isfinite(depth) & (depth > 0), depth, 0.0))
    return valid if scale is None else valid * scale
