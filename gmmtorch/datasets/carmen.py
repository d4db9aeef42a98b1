"""CARMEN logs of 2D lasers (the Radish collection and many others), gzip or plain text.

Only lines `FLASER n r_1 … r_n x y theta …` are read: n ranges (m) and the pose of the laser (m, rad), which
is corrected by SLAM in corrected logs. Beam angles, 0 = forward: −90° + i·1° for n = 180, −90° + i·0.5° for
n = 360, and n beams spread evenly over [−90°, 90°] for any other n.
"""

from __future__ import annotations

import io
import math
from pathlib import Path

import torch
from torch import Tensor

from gmmtorch.datasets.base import Dataset, Ranges, gunzip, require_path
from gmmtorch.datasets.number_rows import number_rows
from gmmtorch.errors import DataError
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan

_MAX_BEAMS = 100_000


def beam_angles(n: int) -> Tensor:
    """Beam angles (n,) of a front laser in radians, 0 = forward, counter-clockwise."""
    if n in (180, 360):
        return (torch.arange(n, dtype=torch.float64) * (180 / n) - 90).deg2rad()
    return torch.linspace(-math.pi / 2, math.pi / 2, n, dtype=torch.float64)


class CarmenLog(Dataset):
    """Scans of a CARMEN log in the order of the file. Times are the stamps of the logger; there are none if a
    line lacks one, or if they do not increase.

    Readings at or beyond `max_range` have no return; the Radish logs use 81.83, 81.91 or 50 m as code for "no
    return". Readings of zero or less, and NaN, are invalid and dropped.
    """

    def __init__(self, path: str | Path, ranges: Ranges, stride: int = 1) -> None:
        path = require_path(
            path,
            "file",
            "a CARMEN log (text or gzip) with FLASER lines",
            "Such logs are published in the Radish repository and the SLAM benchmarking pages of Freiburg.",
        )
        super().__init__(path.name.split(".")[0], ranges, stride)
        self._records, stamps = _read_records(path)
        ordered = bool((stamps.diff() > 0).all())  # false for NaN
        self._times = stamps if ordered and bool(torch.isfinite(stamps).all()) else None

    def _count(self) -> int:
        return len(self._records)

    def _read(self, index: int) -> Scan:
        record = self._records[index]
        readings, (x, y, theta) = record[:-3], record[-3:]
        angles = beam_angles(readings.shape[0]) + theta
        origin = torch.stack([x, y])
        valid = readings > 0  # false for NaN
        if self.ranges.max_range is not None:
            readings = readings.clamp_max(self.ranges.max_range)  # some lasers report infinity
        ends = origin + readings[valid, None] * torch.stack([angles.cos(), angles.sin()], 1)[valid]
        return self.ranges.scan(ends, origin)

    def _known_pose(self, index: int) -> Tensor:
        x, y, theta = self._records[index][-3:]
        return Pose.from_yaw(theta, torch.stack([x, y])).matrix


def _read_records(path: Path) -> tuple[list[Tensor], Tensor]:
    """One tensor [r_1 … r_n, x, y, theta] for each FLASER line, and their stamps (s); NaN: no stamp."""
    data = gunzip(path)
    records, stamps = [], []
    with path.open("rb") if data is None else io.BytesIO(data) as file:
        for number, line in enumerate(io.TextIOWrapper(file, errors="replace"), 1):
            if line.startswith("FLASER "):
                words = line.split()
                records.append(_parse(words, path, number))
                stamps.append(_stamp(words))
    if not records:
        raise DataError(f"{path} has no FLASER line, so it is not a CARMEN log of a front laser.")
    return records, torch.tensor(stamps, dtype=torch.float64)


def _stamp(words: list[str]) -> float:
    """The stamp that follows the corrected pose and the odometry of a FLASER line; NaN without one."""
    try:
        return float(words[2 + int(words[1]) + 6])
    except (IndexError, ValueError):
        return math.nan


def _parse(words: list[str], path: Path, number: int) -> Tensor:
    """[r_1 … r_n, x, y, theta] of the words of the line with this number."""
    where = f"{path}, line {number}"
    n = int(words[1]) if len(words) > 1 and words[1].isdecimal() else 0
    if not 1 <= n <= _MAX_BEAMS:
        raise DataError(
            f"{where}: FLASER announces {' '.join(words[1:2]) or 'no'} beams; expected 1 to {_MAX_BEAMS}."
        )
    if len(words) < 2 + n + 3:
        raise DataError(f"{where}: FLASER announces {n} beams, but the line ends early.")
    record = torch.from_numpy(
        number_rows([" ".join(words[2 : 2 + n + 3])], n + 3, f"{path}, line", number)[0]
    )
    if not bool(torch.isfinite(record[-3:]).all()):
        raise DataError(f"{where}: the pose {record[-3:].tolist()} is not finite.")
    return record
