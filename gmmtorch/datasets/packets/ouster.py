"""Points in packets of Ouster lidars, by the formats of the manufacturer's software manual."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from gmmtorch.datasets.packets.hesai import MOST_CALIBRATION_BYTES, Returns
from gmmtorch.errors import DAMAGED_CONTENT, DataError

_MOST_CHANNELS, _MOST_COLUMNS = 1024, 65535
_NEEDED = ("beam_altitude_angles", "beam_azimuth_angles", "lidar_mode")
_LEGACY = "LEGACY"


class _Profile(NamedTuple):
    """The format of a pixel: its bytes, and of its returns the places of range and reflectivity.

    range_bits: lowest bits of the four bytes of a range. unit: mm.
    """

    n_bytes: int
    range_bits: int
    unit: int
    returns: tuple[tuple[int, int], ...]


_SINGLE, _DUAL = _Profile(12, 19, 1, ((0, 4),)), _Profile(16, 19, 1, ((0, 3), (4, 7)))
_LOW, _LOW_DUAL = _Profile(4, 15, 8, ((0, 2),)), _Profile(8, 15, 8, ((0, 2), (4, 6)))
_PROFILES = {
    _LEGACY: _Profile(12, 20, 1, ((0, 4),)),
    "RNG19_RFL8_SIG16_NIR16": _SINGLE,
    "RNG19_RFL8_SIG16_NIR16_ZONE16": _SINGLE,
    "RNG19_RFL8_SIG16_NIR16_DUAL": _DUAL,
    "RNG19_RFL8_SIG16_ZONE16_DUAL": _DUAL,
    "RNG15_RFL8_NIR8": _LOW,
    "RNG15_RFL8_WIN8": _LOW,
    "RNG15_RFL8_NIR8_ZONE16": _Profile(8, 15, 8, ((0, 2),)),
    "RNG15_RFL8_NIR8_DUAL": _LOW_DUAL,
    "FUSA_RNG15_RFL8_NIR8_DUAL": _LOW_DUAL,
}


_SIZES = (8, 16, 32, 64, 128)  # channels, in packets with 16 columns
_LEGACY_BYTES = {16 * (20 + 12 * n) for n in _SIZES}
_PROFILED_BYTES = {64 + 16 * (12 + n * pixel) for n in _SIZES for pixel in (4, 8, 12, 16, 20)}


def is_packet(data: bytes) -> bool:
    """Whether a datagram looks like a packet of an Ouster lidar, which has no mark of its own."""
    return len(data) in _LEGACY_BYTES or (len(data) in _PROFILED_BYTES and data[0] == 1)


def turn_of(data: bytes) -> bytes:
    """What in a packet changes with the number of the turn."""
    return data[10:12] if len(data) in _LEGACY_BYTES else data[2:8]


class Metadata(NamedTuple):
    """What an Ouster lidar states about itself.

    altitude, azimuth: (C,) of its channels, rad. n_columns: in a turn; per_packet: in a packet.
    offset: (3,) of the beams' origin from the axis, m, at the angle 0 of the encoder.
    to_sensor: (4, 4) sensor ← lidar, m. profile: of its pixels. is_legacy: whether packets have no header.
    """

    altitude: np.ndarray
    azimuth: np.ndarray
    n_columns: int
    per_packet: int
    offset: np.ndarray
    to_sensor: np.ndarray
    profile: _Profile
    is_legacy: bool

    @property
    def column(self) -> np.dtype[Any]:
        """The layout of a column."""
        n, pixel = len(self.altitude), self.profile.n_bytes
        header = 16 if self.is_legacy else 12
        state = ("<u4", header + n * pixel) if self.is_legacy else ("<u2", 10)
        return np.dtype(
            {
                "names": ["time", "number", "state", "pixels"],
                "formats": ["<u8", "<u2", state[0], ("u1", (n, pixel))],
                "offsets": [0, 8, state[1], header],
                "itemsize": header + n * pixel + 4 * self.is_legacy,
            }
        )

    @property
    def ends(self) -> int:
        """Bytes of the header of a packet, and of its footer."""
        return 0 if self.is_legacy else 32

    @property
    def n_bytes(self) -> int:
        """Of a packet."""
        return 2 * self.ends + self.per_packet * self.column.itemsize


def is_metadata(text: str | bytes) -> bool:
    """Whether a text looks like the metadata of an Ouster lidar."""
    return _NEEDED[0] in (text if isinstance(text, str) else text.decode("latin-1"))


def read_metadata(text: str | bytes, where: str) -> Metadata:
    """The metadata in JSON, in the form before or after firmware 2.0. Raises `DataError`."""
    if len(text) > MOST_CALIBRATION_BYTES:
        raise DataError(f"{where} is not the metadata of an Ouster lidar: it has {len(text):,} bytes.")
    try:
        found = _flat(json.loads(text))
        altitude, azimuth = (np.radians(np.array(found[name], np.float64)) for name in _NEEDED[:2])
        columns = str(found[_NEEDED[2]]).split("x")[0]
        n_columns = int(found.get("columns_per_frame") or columns)
        per_packet = int(found.get("columns_per_packet", 16))
        name = str(found.get("udp_profile_lidar") or _LEGACY)
        mount = np.array(found.get("lidar_to_sensor_transform", np.eye(4)), np.float64).reshape(4, 4)
        beams = found.get("beam_to_lidar_transform")
        if beams is None:
            offset = np.array([float(found.get("lidar_origin_to_beam_origin_mm", 0)), 0, 0])
        else:
            offset = np.array(beams, np.float64).reshape(4, 4)[:3, 3]
    except DAMAGED_CONTENT as error:
        raise DataError(f"{where} is not the metadata of an Ouster lidar ({error!r}).") from error
    if name not in _PROFILES:
        raise DataError(f"{where}: packets of the profile {name[:60]!r} are not read; record clouds.")
    sizes = 0 < len(altitude) <= _MOST_CHANNELS and 0 < n_columns <= _MOST_COLUMNS and 0 < per_packet <= 256
    numbers = np.concatenate([altitude.ravel(), azimuth.ravel(), offset, mount.ravel()])
    if not (sizes and altitude.shape == azimuth.shape == (len(altitude),) and np.isfinite(numbers).all()):
        raise DataError(f"{where} has impossible sizes or angles; it is damaged.")
    mount[:3, 3] /= 1000
    is_legacy = name == _LEGACY
    return Metadata(
        *(altitude, azimuth, n_columns, per_packet, offset / 1000, mount, _PROFILES[name], is_legacy)
    )


def _flat(content: Any) -> dict[str, Any]:
    """The values of nested objects by their names; of equal names that of the outermost."""
    found, inner = dict[str, Any](), [content]
    while inner:
        parts = [part for part in inner if isinstance(part, dict)]
        for part in parts:
            found = {**part, **found}
        inner = [value for part in parts for value in part.values()]
    return found


def returns_of(packets: Sequence[bytes], metadata: Metadata) -> Returns:
    """The returns in packets of a turn, in the frame of the sensor (x to its connector's other side, z up).

    Of two returns of a pixel, those with equal ranges count once. Raises `DataError` for packets of another
    size than the metadata states.
    """
    ends, column, profile = metadata.ends, metadata.column, metadata.profile
    for data in packets:
        if len(data) != metadata.n_bytes:
            raise DataError(
                f"a packet has {len(data):,} bytes, but its metadata states {metadata.n_bytes:,}: they are "
                "those of another lidar, or of another setting"
            )
    body = b"".join(data[ends : len(data) - ends] for data in packets)
    table = np.frombuffer(body, column)
    table = table[((table["state"] & 1) == 1) & (table["number"] < metadata.n_columns)]
    pixels = np.ascontiguousarray(table["pixels"])
    found, seen = [], None
    encoder = 2 * np.pi * (1 - table["number"] / metadata.n_columns)
    cos, sin = np.cos(encoder), np.sin(encoder)
    x, y, z = metadata.offset
    origins = np.stack([cos * x - sin * y, sin * x + cos * y, np.full_like(cos, z)], 1)
    for place, reflectivity in profile.returns:
        words = np.ascontiguousarray(pixels[..., place : place + 4]).view("<u4")[..., 0]
        counts = words & ((1 << profile.range_bits) - 1)
        kept = counts > 0 if seen is None else (counts > 0) & (counts != seen)
        seen = counts
        of_column, channel = np.nonzero(kept)
        length = counts[kept] * (profile.unit / 1000) - np.hypot(x, z)
        turn = encoder[of_column] - metadata.azimuth[channel]
        level = length * np.cos(metadata.altitude[channel])
        rise = length * np.sin(metadata.altitude[channel])
        points = np.stack([level * np.cos(turn), level * np.sin(turn), rise], 1) + origins[of_column]
        found.append((points, of_column, pixels[..., reflectivity][kept]))
    points, of_column, reflectivities = (np.concatenate(parts) for parts in zip(*found, strict=True))
    times = table["time"].astype(np.int64)
    after = times - (times[0] if len(times) else 0)
    points = points @ metadata.to_sensor[:3, :3].T + metadata.to_sensor[:3, 3]
    return Returns(points, after[of_column], reflectivities)
