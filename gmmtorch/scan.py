"""Scan: the measurements of one sweep, frame or beam fan of a range sensor, in the world frame."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike as ArrayLike
from gmmtorch.arrays import as_tensor, is_floating, naming_device
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.pose import Pose

FARTHEST = 2.0**27
"""Largest absolute coordinate in metres, 134 217 km. Map files store no larger ones."""

_FLOAT32_WARNING_METRES = 1e4
"""Distance from the origin beyond which float32 coordinates are coarser than about a millimetre."""


def _as_points(name: str, value: ArrayLike | None, dim: int | None) -> Tensor:
    if value is None:
        return torch.empty(0, dim or 0, dtype=torch.float64)
    tensor = as_tensor(value, name)
    if tensor.numel() == 0 and tensor.ndim < 2:
        tensor = tensor.new_empty(0, dim or 0)
    if tensor.ndim != 2 or (dim is not None and tensor.shape[1] != dim):
        raise InvalidArgumentError(
            f"{name} has shape {tuple(tensor.shape)}; expected (N, {dim if dim else '2 or 3'}), metres."
        )
    check_positions(name, tensor)
    if tensor.dtype == torch.float32 and bool((tensor.abs() > _FLOAT32_WARNING_METRES).any()):
        warnings.warn(
            f"{name} has float32 coordinates more than {_FLOAT32_WARNING_METRES / 1e3:.0f} km from the "
            "origin, where float32 does not resolve millimetres; use float64, or move the frame.",
            UserWarning,
            stacklevel=4,
        )
    return tensor


def check_positions(name: str, rows: Tensor) -> None:
    """Raise `InvalidArgumentError`, which names the first bad row, unless all positions (N, D) are finite
    and at most `FARTHEST` metres from the origin along each axis.
    """
    good = (rows.abs() <= FARTHEST).all(1)  # False for NaN
    if bool(good.all()):
        return
    row = int((~good).nonzero()[0])
    if bool(torch.isfinite(rows[row]).all()):
        raise InvalidArgumentError(
            f"{name}[{row}] = {rows[row].tolist()}: the largest allowed coordinate is {FARTHEST:.0f} m. Give "
            "metres, relative to an origin near the map."
        )
    raise InvalidArgumentError(
        f"{name}[{row}] = {rows[row].tolist()} is not finite; remove such rows first: "
        f"{name} = {name}[torch.isfinite({name}).all(1)]."
    )


def as_time(value: float | None) -> float | None:
    """Seconds as a float, or None. Raises `InvalidArgumentError` unless they are a finite number."""
    if value is None:
        return None
    try:
        seconds = float(value)
    except (TypeError, ValueError):
        seconds = math.nan
    if not math.isfinite(seconds):
        raise InvalidArgumentError(f"time={value!r} must be a finite number of seconds, or None.")
    return seconds


def extent(rows: Tensor) -> str:
    """Text of the bounding box of positions (N, D), metres, after a comma; empty if there are none."""
    if not rows.shape[0]:
        return ""
    low, high = rows.detach().amin(0).tolist(), rows.detach().amax(0).tolist()
    sides = zip("xyz", low, high, strict=False)
    return ", " + ", ".join(f"{axis} {a:.4g} to {b:.4g}" for axis, a, b in sides) + " m"


COLOUR = "colour"
"""Name of the channel with linear RGB from 0 to 1."""
INTENSITY = "intensity"
LARGEST_LABEL = 65535
MOST_CHANNELS, MOST_COLUMNS, LONGEST_NAME = 16, 8, 64
LARGEST_VALUE = 1e12


def linear_colours(values: Tensor) -> Tensor:
    """Linear RGB of sRGB values, both from 0 to 1 (IEC 61966-2-1)."""
    return torch.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055).clamp_min(0) ** 2.4)


def display_colours(values: Tensor) -> Tensor:
    """sRGB of linear RGB values, both from 0 to 1: the inverse of `linear_colours`."""
    return torch.where(
        values <= 0.0031308, values * 12.92, 1.055 * values.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    )


def _as_channel(name: str, given: ArrayLike, points: Tensor) -> Tensor:
    """A channel of points (N, D), on their device: floating numbers (N, A), or labels (N,) int64."""
    n, where = points.shape[0], f"attributes[{name!r}]"
    if not isinstance(name, str) or not 0 < len(name.encode()) <= LONGEST_NAME:
        raise InvalidArgumentError(f"{where}: the name of a channel is text of 1 to {LONGEST_NAME} bytes.")
    value = as_tensor(given, where, device=points.device)
    is_colour = name == COLOUR
    if value.shape[:1] != (n,) or value.ndim > 2 or (is_colour and value.shape[1:] != (3,)):
        raise InvalidArgumentError(
            f"{where} has shape {tuple(value.shape)}; expected {(n, 3) if is_colour else (n,)}, one row for "
            "each point."
        )
    if is_colour and str(getattr(given, "dtype", "")).endswith("uint8"):
        return linear_colours(value.float() / 255)
    if not is_floating(given):
        if is_colour:
            raise InvalidArgumentError(
                f"{where} are whole numbers; give linear RGB from 0 to 1, or sRGB from 0 to 255 as uint8."
            )
        value = value.long()
        if value.ndim != 1 or bool(((value < -1) | (value > LARGEST_LABEL)).any()):
            raise InvalidArgumentError(
                f"{where} are whole numbers, so they are labels: expected (N,) from 0 to {LARGEST_LABEL}, or "
                "−1 where unknown. Give measured values in a floating type."
            )
        return value
    value = value[:, None] if value.ndim == 1 else value
    if not 1 <= value.shape[1] <= MOST_COLUMNS:
        raise InvalidArgumentError(
            f"{where} has {value.shape[1]} columns; give 1 to {MOST_COLUMNS}, in several channels if need be."
        )
    if is_colour:
        if bool(((value < 0) | (value > 1)).any()):
            raise InvalidArgumentError(
                f"{where} has values outside 0 to 1; give linear RGB, or sRGB from 0 to 255 as uint8."
            )
    elif bool((value.abs() > LARGEST_VALUE).any()):
        raise InvalidArgumentError(
            f"{where} has values beyond {LARGEST_VALUE:g}, or infinite ones; give them in another unit, and "
            "NaN where unknown."
        )
    return value


@dataclass(frozen=True, eq=False, repr=False)
class Scan:
    """Measured surface points and the sensor position that measured them. World frame, metres.

    Attributes:
        points: (N, D) returns, D = 2 or 3. Each is a surface point seen from `origin`.
        origin: (D,) position of the sensor.
        no_return: (M, D) one row for each beam without return: the point up to which the beam is
            assumed to cross free space. It is never a surface point.
        time: of the measurement in seconds, on any clock that all scans share; None: not known.
        attributes: channels beside the points, by name. Numbers in a floating type (N,) or (N, A), NaN where
            unknown, such as "intensity"; or labels (N,), whole numbers, −1 where unknown, such as "class".
            "colour" (N, 3) is linear RGB from 0 to 1; uint8 is taken as sRGB. At most 16, of up to 8 columns
            and values up to 10¹².

    Accepts arrays, lists and tensors. Raises `InvalidArgumentError` for inconsistent shapes, for NaN and
    infinite coordinates, and for coordinates beyond 2²⁷ m. Warns if float32 coordinates are too far from
    the origin to be precise.
    """

    points: Tensor
    origin: Tensor
    no_return: Tensor = None  # type: ignore[assignment]  # None becomes an empty (0, D) tensor
    time: float | None = None
    attributes: Mapping[str, Tensor] = None  # type: ignore[assignment]  # None becomes no channel

    def __post_init__(self) -> None:
        origin = as_tensor(self.origin, "origin")
        if origin.shape not in ((2,), (3,)):
            raise InvalidArgumentError(f"origin has shape {tuple(origin.shape)}; expected (2,) or (3,).")
        dim = origin.shape[0]
        _as_points("origin", origin[None], dim)
        points = _as_points("points", self.points, dim)
        no_return = _as_points("no_return", self.no_return, dim)
        object.__setattr__(self, "time", as_time(self.time))
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "origin", origin.to(points.device))
        object.__setattr__(self, "no_return", no_return.to(points.device, points.dtype))
        given = {} if self.attributes is None else self.attributes
        if not isinstance(given, Mapping):
            raise InvalidArgumentError(
                f'attributes is a {type(given).__name__}; name each channel, as in {{"colour": values}}.'
            )
        channels = {name: _as_channel(name, x, points) for name, x in given.items()}
        if len(channels) > MOST_CHANNELS:
            raise InvalidArgumentError(
                f"attributes has {len(channels)} channels; give at most {MOST_CHANNELS}."
            )
        object.__setattr__(self, "attributes", channels)

    def __repr__(self) -> str:
        origin = ", ".join(f"{x:.6g}" for x in self.origin.tolist())
        channels = f" with {', '.join(self.attributes)}" if self.attributes else ""
        return (
            f"Scan({self.points.shape[0]} points{channels} and {self.no_return.shape[0]} no-return beams "
            f"in {self.dim}D from ({origin}) m{extent(self.points)}, {self.points.dtype}, "
            f"{self.points.device})"
        )

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self.origin.shape[0]

    @property
    def n_beams(self) -> int:
        """Number of beams: returns and no-returns."""
        return self.points.shape[0] + self.no_return.shape[0]

    def ends(self) -> tuple[Tensor, Tensor]:
        """All beam ends (N + M, D), returns first, and a mask (N + M,) of the returns."""
        is_hit = torch.zeros(self.n_beams, dtype=torch.bool, device=self.points.device)
        is_hit[: self.points.shape[0]] = True
        return torch.cat([self.points, self.no_return]), is_hit

    def select(self, keep: Tensor) -> Scan:
        """The scan with only the beams that `keep` (N + M,) marks, in the order of `ends`."""
        n = self.points.shape[0]
        channels = {name: value[keep[:n]] for name, value in self.attributes.items()}
        return replace(
            self, points=self.points[keep[:n]], no_return=self.no_return[keep[n:]], attributes=channels
        )

    def transformed(self, transform: ArrayLike) -> Scan:
        """The scan moved by a rigid motion (D+1, D+1): x → R x + t."""
        pose = Pose.checked(transform, self.dim, device=self.points.device)
        points, no_return = pose.apply(self.points), pose.apply(self.no_return)
        return Scan(points, pose.apply(self.origin[None])[0], no_return, self.time, self.attributes)

    def copied(self, device: torch.device | str | None = None) -> Scan:
        """A deep copy, on `device` if given. A reader that reuses its arrays for the next scan needs it."""
        return self._changed(lambda x: x.detach().to(device or x.device, copy=True))

    def to(self, device: torch.device | str | None) -> Scan:
        """The scan on another device. None: where it is."""
        with naming_device(device):
            return self._changed(lambda x: x.to(device))

    def _changed(self, change: Callable[[Tensor], Tensor]) -> Scan:
        """The scan with `change` applied to each tensor: the same numbers, which are not checked again."""
        made = object.__new__(Scan)
        for name, value in vars(self).items():
            object.__setattr__(made, name, change(value) if isinstance(value, Tensor) else value)
        object.__setattr__(made, "attributes", {name: change(x) for name, x in self.attributes.items()})
        return made
