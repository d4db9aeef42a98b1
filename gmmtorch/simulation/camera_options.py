"""The options of a depth camera. Importing this file does not load torch."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gmmtorch.declarations import option
from gmmtorch.errors import InvalidArgumentError, check_number, check_whole

CLOSEST_READING = 1e-3
"""Metres."""


@dataclass(frozen=True)
class CameraOptions:
    """What a depth camera sees.

    horizontal_fov, vertical_fov: angles (rad) between opposite edges of the image, below π.
    max_range: surfaces at this distance (m) along a beam, or beyond, give no return.
    noise: a depth of z metres along the optical axis has standard deviation noise · z² metres.
    dropout: share of the pixels without a reading.

    Raises `InvalidArgumentError` for a value out of its range.
    """

    width: int = option(160, "pixels along a row, evenly spaced on the image plane")
    height: int = option(120, "pixels along a column")
    horizontal_fov: float = 1.5184
    vertical_fov: float = 1.0123
    max_range: float = 6.0
    noise: float = 0.0015
    dropout: float = 0.01

    def __post_init__(self) -> None:
        check_whole("width", self.width, 1)
        check_whole("height", self.height, 1)
        for name in ("horizontal_fov", "vertical_fov"):
            if not 0 < getattr(self, name) < math.pi:
                raise InvalidArgumentError(
                    f"{name}={getattr(self, name)} must be an angle above 0 and below π radians: "
                    "a camera needs a field of view."
                )
        check_number("max_range", self.max_range, above=True, least=CLOSEST_READING)
        check_number("noise", self.noise)
        check_dropout("pixels", self.dropout)


def check_dropout(parts: str, dropout: float) -> None:
    """Raise `InvalidArgumentError` unless it is a share of the parts in [0, 1)."""
    if not 0 <= dropout < 1:
        raise InvalidArgumentError(f"dropout={dropout} must be a share of the {parts} in [0, 1).")
