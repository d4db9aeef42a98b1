"""Points in packets of Hesai lidars, by the formats and nominal angles in the user manuals of the models."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gmmtorch.datasets.base import number_rows
from gmmtorch.errors import DataError

MOST_CALIBRATION_BYTES = 1 << 20
_SECOND = 1_000_000  # µs, after which the clock in a packet begins again


def _degrees(text: str) -> np.ndarray:
    return np.array(text.split(), np.float64)


_PANDAR64 = _degrees(
    "14.882 11.032 8.059 5.057 3.04 2.028 1.86 1.688 1.522 1.351 1.184 1.013 0.846 0.675 0.508 0.337 "
    "0.169 0 -0.169 -0.337 -0.508 -0.675 -0.845 -1.013 -1.184 -1.351 -1.522 -1.688 -1.86 -2.028 -2.198 "
    "-2.365 -2.536 -2.7 -2.873 -3.04 -3.21 -3.375 -3.548 -3.712 -3.884 -4.05 -4.221 -4.385 -4.558 "
    "-4.72 -4.892 -5.057 -5.229 -5.391 -5.565 -5.726 -5.898 -6.061 -7.063 -8.059 -9.06 -10.045 -11.032 "
    "-12.006 -12.974 -13.93 -18.889 -24.897"
)
_TURNS64 = np.full(64, -1.042)
_TURNS64[6:54] = np.tile([1.042, 3.125, 5.208, -5.208, -3.125, -1.042], 8)
_OF_40 = np.r_[0:6, 7:54:2, 54:64]  # channels of a Pandar64 that a Pandar40P has
_QT64 = _degrees(
    "-52.121 -49.785 -47.577 -45.477 -43.465 -41.528 -39.653 -37.831 -36.055 -34.32 -32.619 -30.95 "
    "-29.308 -27.69 -26.094 -24.517 -22.964 -21.42 -19.889 -18.372 -16.865 -15.368 -13.88 -12.399 "
    "-10.925 -9.457 -7.994 -6.535 -5.079 -3.626 -2.175 -0.725 0.725 2.175 3.626 5.079 6.534 7.993 "
    "9.456 10.923 12.397 13.877 15.365 16.861 18.368 19.885 21.415 22.959 24.524 26.101 27.697 29.315 "
    "30.957 32.627 34.328 36.064 37.84 39.662 41.537 43.475 45.487 47.587 49.795 52.133"
)
_TURNS_QT64 = _degrees(
    "8.736 8.314 7.964 7.669 7.417 7.198 7.007 6.838 6.688 6.554 6.434 6.326 6.228 6.14 6.059 5.987 "
    "-5.27 -5.216 -5.167 -5.123 -5.083 -5.047 -5.016 -4.988 -4.963 -4.942 -4.924 -4.91 -4.898 -4.889 "
    "-4.884 -4.881 5.493 5.496 5.502 5.512 5.525 5.541 5.561 5.584 5.611 5.642 5.676 5.716 5.759 5.808 "
    "5.862 5.921 -5.33 -5.396 -5.469 -5.55 -5.64 -5.74 -5.85 -5.974 -6.113 -6.269 -6.447 -6.651 -6.887 "
    "-7.163 -7.493 -7.892"
)


class Angles(NamedTuple):
    """Elevation and azimuth (C,) of channels in degrees; the azimuth is added to that of the block."""

    elevation: np.ndarray
    azimuth: np.ndarray


def read_angles(path: Path) -> Angles:
    """The angles in the correction file of a lidar: CSV rows of channel, elevation, azimuth in degrees.

    Raises `DataError`.
    """
    if path.stat().st_size > MOST_CALIBRATION_BYTES:
        raise DataError(f"{path} is not a correction file of a lidar: it has {path.stat().st_size:,} bytes.")
    lines = path.read_text("utf-8", errors="replace").splitlines()
    rows = [" ".join(line.split(",")[:3]) for line in lines if line.strip()[:1].isdigit()]
    table = number_rows(rows, 3, f"{path}, row")
    if not len(table) or not np.isfinite(table).all() or (np.abs(table[:, 1:]) > 360).any():
        raise DataError(f"{path} has no angles; expected rows of channel, elevation and azimuth in degrees.")
    table = table[np.argsort(table[:, 0], kind="stable")]
    return Angles(table[:, 1], table[:, 2])


class Model(NamedTuple):
    """The format of a model's packets.

    start: bytes at places of a packet that show the model. header: bytes before the blocks, of which each
    begins with `mark` bytes and the azimuth in 0.01°. n_blocks, n_channels: in a packet. cell: bytes of a
    return: distance (u2), reflectivity (u1). clock: the place after the blocks of the µs in a second.
    period: µs between blocks of different azimuth. angles: nominal; None: only the unit's own are known.
    """

    name: str
    start: dict[int, int]
    header: int
    mark: int
    n_blocks: int
    n_channels: int
    cell: int
    clock: int
    period: float
    angles: Angles | None

    @property
    def block(self) -> int:
        """Bytes of a block."""
        return self.mark + 2 + self.n_channels * self.cell

    @property
    def n_bytes(self) -> int:
        """The fewest bytes of a packet: up to its clock."""
        return self.header + self.n_blocks * self.block + self.clock + 4


_EEFF = {0: 0xEE, 1: 0xFF}
_QT = {**_EEFF, 2: 3}


def _xt(name: str, n_blocks: int, elevation: np.ndarray) -> Model:
    """An XT, whose channels are in one plane."""
    n = len(elevation)
    start = {**_EEFF, 2: 6, 3: 1, 6: n, 7: n_blocks}
    return Model(name, start, 12, 0, n_blocks, n, 4, 19, 50.0, Angles(elevation, np.zeros(n)))


MODELS = (
    Model(
        *("Pandar40P", {0: 0xFF, 1: 0xEE, 124: 0xFF, 125: 0xEE}, 0, 2, 10, 40, 3, 10, 55.56),
        Angles(_PANDAR64[_OF_40], np.r_[_TURNS64[:6], np.tile([3.125, -5.208, -1.042], 8), _TURNS64[54:]]),
    ),
    Model("Pandar64", {**_EEFF, 2: 64, 3: 6}, 8, 0, 6, 64, 3, 10, 55.56, Angles(_PANDAR64, _TURNS64)),
    Model("PandarQT64", {**_QT, 3: 1, 6: 64, 7: 4}, 12, 0, 4, 64, 4, 12, 166.7, Angles(_QT64, _TURNS_QT64)),
    Model("QT128", {**_QT, 3: 2, 6: 128, 7: 2}, 12, 0, 2, 128, 4, 42, 111.1, None),
    _xt("XT16", 8, 15.0 - 2 * np.arange(16)),
    _xt("XT32", 8, 15.0 - np.arange(32)),
    _xt("XT32M2X", 6, 19.5 - 1.3 * np.arange(32)),
)


def model_of(data: bytes) -> Model | None:
    """The model whose packet this is; None if it is none of Hesai's."""
    for model in MODELS:
        if len(data) >= model.n_bytes and all(data[at] == value for at, value in model.start.items()):
            return model
    return None


def azimuth_of(data: bytes, model: Model) -> float:
    """The azimuth of the first block of a packet in degrees."""
    return int.from_bytes(data[model.header + model.mark :][:2], "little") / 100


class Returns(NamedTuple):
    """Points (N, 3) in metres, their times (N,) in ns after the first, and reflectivities (N,)."""

    points: np.ndarray
    times: np.ndarray
    reflectivity: np.ndarray


def returns_of(packets: Sequence[bytes], model: Model, own: Angles | None) -> Returns:
    """The returns in packets of a sweep. own: angles of the unit; None: the nominal ones.

    The lidar spins clockwise from y, and z is up. Of the returns of a laser, those with equal distances count
    once. Raises `DataError` if packets are of other models, or the angles of other lidars.
    """
    angles = own or model.angles
    if angles is None:
        raise DataError(
            f"a {model.name} does not state its angles: give the correction file (.csv) that Hesai delivers "
            "with it, ‹calibration›=FILE"
        )
    if len(angles.elevation) != model.n_channels:
        raise DataError(
            f"‹calibration› has {len(angles.elevation)} channels, but a {model.name} has {model.n_channels}"
        )
    if any(model_of(data) is not model for data in packets):
        raise DataError(f"not all packets are those of a {model.name}")
    cells = np.dtype([("distance", "<u2"), ("reflectivity", "u1"), ("rest", f"V{model.cell - 3}")])
    blocks = np.dtype([("mark", f"V{model.mark}"), ("azimuth", "<u2"), ("cells", cells, model.n_channels)])
    end = model.header + model.n_blocks * model.block
    body = b"".join(data[model.header : end] for data in packets)
    table = np.frombuffer(body, blocks).reshape(len(packets), model.n_blocks)
    clock = b"".join(data[end + model.clock :][:4] for data in packets)
    azimuth, distance = table["azimuth"], table["cells"]["distance"]
    repeats = azimuth[:, 1:] == azimuth[:, :-1]  # further returns of the same lasers
    kept = distance > 0
    kept[:, 1:] &= ~(repeats[..., None] & (distance[:, 1:] == distance[:, :-1]))
    passed = np.cumsum(np.c_[np.zeros(len(packets), bool), ~repeats], axis=1)  # blocks of other azimuths
    counts = np.frombuffer(clock, "<u4").astype(np.int64)
    steps = np.diff(counts, prepend=counts[:1])
    began = np.cumsum(np.mod(steps + _SECOND // 2, _SECOND) - _SECOND // 2)
    times = ((began[:, None] + passed * model.period) * 1000).round().astype(np.int64)
    of_block, channel = np.nonzero(kept.reshape(-1, model.n_channels))
    unit = {0: 4, 8: packets[0][5], 12: packets[0][9]}[model.header] / 1000  # stated in mm
    length = distance[kept] * unit
    turn = np.radians(azimuth.ravel()[of_block] / 100 + angles.azimuth[channel])
    rise = np.radians(angles.elevation[channel])
    level = length * np.cos(rise)
    points = np.stack([level * np.sin(turn), level * np.cos(turn), length * np.sin(rise)], 1)
    return Returns(points, times.ravel()[of_block], table["cells"]["reflectivity"][kept])
