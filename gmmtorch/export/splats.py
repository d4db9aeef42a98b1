"""3D Gaussian splats: components as files for viewers, PLY, SPZ and glTF, and such files as maps.

PLY has the layout of the original 3D Gaussian splatting (Kerbl et al., ACM TOG 42(4), 2023): opacity as a
logit, logarithms of the deviations, and colours as spherical harmonics. SPZ is Niantic's compressed format,
versions 2 and 3. glTF has the extension KHR_gaussian_splatting. PLY keeps the frame of the map, with z up; in
SPZ and glTF y is up, as these formats ask for.
"""

from __future__ import annotations

import gzip
import math
import struct
import warnings
import zlib
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets import ply_fields, ply_rows
from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError, check_number
from gmmtorch.export.point_cloud import glb_bytes, ply_bytes
from gmmtorch.files import write_bytes
from gmmtorch.mapping import Attributes, Components, GaussianMap, Numbers
from gmmtorch.pose import Pose
from gmmtorch.scan import COLOUR, check_positions, display_colours, linear_colours

SUFFIXES = (".ply", ".spz", ".glb")
_OPACITY = 0.95
_GREY = 0.6
_HARMONIC = 0.28209479177387814  # √(1/4π), of degree 0
_MOST_SPLATS, _MOST_BYTES = 1 << 24, 1 << 30
_FARTHEST_EXACT = 2e-3 * 2**23  # m, where 24 bits with a sign have steps of 2 mm
_REACH = 10.0  # deviations: the farthest that a splat is seen from as a component
_THINNEST = 1e-3  # m, least deviation of a splat that becomes a component
_POINTS = 1e4  # for each m² of a splat that becomes a component: one for each square centimetre
_Y_UP = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)

_SPZ_HEADER = struct.Struct("<IIIBBBB")
_SPZ_MAGIC, _SPZ_VERSION = 0x5053474E, 3
_SPZ_COLOUR, _SPZ_FRACTION = 0.15, 12
_HARMONICS = (0, 3, 8, 15, 24)  # coefficients beyond degree 0, by degree


class Splats(NamedTuple):
    """K splats, float64: means (K, 3), metres; deviations (K, 3) along the axes of the rotations (K, 3, 3);
    sRGB colours (K, 3) and opacity (K,) from 0 to 1."""

    means: Tensor
    deviations: Tensor
    rotations: Tensor
    colours: Tensor
    opacity: Tensor

    @classmethod
    def of(cls, components: Components) -> Splats:
        """The surface components, in their colours; grey without a colour. Raises for a 2D map."""
        if components.dim != 3:
            raise InvalidArgumentError("Splats are 3D, and the map is 2D; export it as map_server or csv.")
        rows = (~components.max_range & (components.support > 0)).nonzero().squeeze(1)
        c = components.selected(rows).on_cpu()
        variances, axes = torch.linalg.eigh(c.covariances)
        axes = torch.cat([axes[:, :, :2], axes[:, :, 2:] * torch.linalg.det(axes)[:, None, None].sign()], 2)
        colours = torch.full_like(c.means, _GREY)
        known = c.attributes.channels.get(COLOUR)
        if isinstance(known, Numbers):
            seen = display_colours(known.mean.clamp(0, 1))
            colours = torch.where(known.share[:, None] > 0, seen, colours)
        opacity = torch.full_like(c.support, _OPACITY)
        return cls(c.means, variances.clamp_min(0).sqrt(), axes, colours, opacity)

    def turned(self, rotation: Tensor) -> Splats:
        """The splats in another frame: x → R x."""
        return self._replace(means=self.means @ rotation.T, rotations=rotation @ self.rotations)

    def quaternions(self) -> Tensor:
        """The rotations (K, 4) as x, y, z, w."""
        return Pose(self.rotations, self.means).quaternion()


def write_splats(path: str | Path, splats: Splats) -> Path:
    """Writes splats, atomically, as .ply, .spz or .glb. Raises `InvalidArgumentError` for another ending.

    Warns of a map so far from its origin that the numbers of the format round positions to more than 2 mm:
    24 bits, or those of float32.
    """
    path = Path(path)
    reach = float(splats.means.abs().max()) if len(splats.means) else 0.0
    if reach > _FARTHEST_EXACT:
        warnings.warn(
            f"{path}: the map reaches {reach:.6g} m from its origin, so that positions are rounded to "
            f"{reach / 2**23:.2g} m or more; move it closer, as viewers also compute in float32.",
            stacklevel=2,
        )
    writers = dict(zip(SUFFIXES, (_ply, _spz, _glb), strict=True))
    if path.suffix.lower() not in writers:
        raise InvalidArgumentError(f"output={path} must end in {', '.join(SUFFIXES)} for splats.")
    return write_bytes(path, writers[path.suffix.lower()](splats))


def _harmonics(splats: Splats) -> Tensor:
    """The coefficients (K, 3) of degree 0."""
    return (splats.colours - 0.5) / _HARMONIC


def _ply(splats: Splats) -> bytes:
    columns = {
        **dict(zip(("x", "y", "z"), splats.means.T, strict=True)),
        **{f"n{axis}": torch.zeros(len(splats.means)) for axis in "xyz"},
        **{f"f_dc_{i}": column for i, column in enumerate(_harmonics(splats).T)},
        "opacity": splats.opacity.clamp(1e-6, 1 - 1e-6).logit(),
        **{f"scale_{i}": column for i, column in enumerate(splats.deviations.clamp_min(1e-9).log().T)},
        **{f"rot_{i}": column for i, column in enumerate(splats.quaternions()[:, [3, 0, 1, 2]].T)},
    }
    table = {name: column.numpy().astype("<f4") for name, column in columns.items()}
    return ply_bytes(table, "3D Gaussian splats of a gmmtorch map, z up")


def _spz(splats: Splats) -> bytes:
    splats = splats.turned(_Y_UP)
    reach = float(splats.means.abs().max()) if len(splats.means) else 1.0
    fraction = min(_SPZ_FRACTION, 22 - math.ceil(math.log2(max(reach, 1e-9))))
    if fraction < 0:
        raise InvalidArgumentError(f"SPZ stores positions up to 4,194 km; the map reaches {reach:.3g} m.")
    places = (splats.means * 2.0**fraction).round().to(torch.int32).numpy().astype("<i4")
    parts = [
        np.ascontiguousarray(places).view(np.uint8).reshape(-1, 3, 4)[:, :, :3],
        _bytes(splats.opacity * 255),
        _bytes((_harmonics(splats) * _SPZ_COLOUR + 0.5) * 255),
        _bytes((splats.deviations.clamp_min(1e-9).log() + 10) * 16),
        _packed_quaternions(splats.quaternions().numpy()),
    ]
    header = _SPZ_HEADER.pack(_SPZ_MAGIC, _SPZ_VERSION, len(splats.means), 0, fraction, 0, 0)
    return gzip.compress(header + b"".join(part.tobytes() for part in parts), 6, mtime=0)


def _bytes(values: Tensor) -> np.ndarray:
    return values.round().clamp(0, 255).numpy().astype(np.uint8)


def _packed_quaternions(quaternions: np.ndarray) -> np.ndarray:
    """x, y, z, w (K, 4) in 32 bits: the number of the largest one, then sign and 9 bits of each other one."""
    rows = np.arange(len(quaternions))
    largest = np.abs(quaternions).argmax(1)
    positive = quaternions * np.sign(quaternions[rows, largest])[:, None]
    word = largest.astype(np.uint32)
    for i in range(4):
        size = np.floor(511 * np.abs(positive[:, i]) * math.sqrt(2) + 0.5).clip(0, 511).astype(np.uint32)
        longer = (word << np.uint32(10)) | ((positive[:, i] < 0).astype(np.uint32) << np.uint32(9)) | size
        word = np.where(largest == i, word, longer)
    return word.astype("<u4")


def _glb(splats: Splats) -> bytes:
    """Binary glTF 2.0: points, which viewers without the extension show in their colours."""
    if not len(splats.means):
        raise InvalidArgumentError("No surface: glTF has no empty tables; export the map as .ply or .spz.")
    splats = splats.turned(_Y_UP)
    name = "KHR_gaussian_splatting"
    columns = {
        "POSITION": splats.means,
        "COLOR_0": torch.cat([linear_colours(splats.colours), splats.opacity[:, None]], 1),
        f"{name}:ROTATION": splats.quaternions(),
        f"{name}:SCALE": splats.deviations,
        f"{name}:OPACITY": splats.opacity[:, None],
        f"{name}:SH_DEGREE_0_COEF_0": _harmonics(splats),
    }
    extension = {name: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    return glb_bytes(
        {key: column.numpy() for key, column in columns.items()},
        primitive={"mode": 0, "extensions": extension},
        extensionsUsed=[name],
    )


def read_splats(path: str | Path) -> Splats:
    """The splats of a .ply or .spz file, in the frame of `write_splats`, without harmonics above degree 0.

    Raises `MissingDataError` if the file does not exist, `InvalidArgumentError` for another ending, and
    `DataError` for another content, numbers that are not finite, or more than 16 million splats.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingDataError(f"{path} does not exist; expected splats (.ply, .spz).")
    if path.stat().st_size > _MOST_BYTES:
        raise DataError(f"{path} has {path.stat().st_size:,} bytes, above the limit of {_MOST_BYTES:,}.")
    if path.suffix.lower() not in (".ply", ".spz"):
        raise InvalidArgumentError(f"{path} must end in .ply or .spz; convert other splats first.")
    found = _read_ply(path) if path.suffix.lower() == ".ply" else _read_spz(path)
    for name, values in found._asdict().items():
        if not bool(torch.isfinite(values).all()):
            raise DataError(
                f"{path}: {name} of a splat are not finite; remove such splats, or write it again."
            )
    try:
        check_positions("means", found.means)
        check_positions("extent", found.means.abs() + _REACH * found.deviations)
    except InvalidArgumentError as error:
        raise DataError(f"{path}: {error}") from error
    return found


def _read_ply(path: Path) -> Splats:
    names = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3))]
    names += [f"rot_{i}" for i in range(4)]
    missing = [name for name in names if name not in ply_fields(path)]
    if missing:
        raise DataError(
            f"{path} has no property {missing[0]}; it holds no 3D Gaussian splats of the common layout. "
            "Compressed PLY is not read; convert it to plain PLY or to SPZ."
        )
    rows = ply_rows(path, names)
    if rows.n_rows > _MOST_SPLATS:
        raise DataError(f"{path} has {rows.n_rows:,} splats, more than {_MOST_SPLATS:,}.")
    blocks = list(rows.blocks(0, rows.n_rows, max(1, rows.n_rows)))
    table = torch.from_numpy(np.concatenate([np.empty((0, len(names))), *blocks]))
    means, harmonics, opacity, logs, turn = table.split([3, 3, 1, 3, 4], 1)
    if not bool(torch.isfinite(turn).all()):
        raise DataError(f"{path}: rotations of a splat are not finite; remove such splats.")
    return _made(means, logs.exp(), turn[:, [1, 2, 3, 0]], harmonics, opacity[:, 0].sigmoid())


def _made(means: Tensor, deviations: Tensor, turn: Tensor, harmonics: Tensor, opacity: Tensor) -> Splats:
    """Splats of quaternions x, y, z, w (K, 4), of any length, and of harmonics of degree 0 (K, 3)."""
    length = turn.norm(dim=1, keepdim=True)
    unturned = torch.tensor([0.0, 0, 0, 1], dtype=turn.dtype)
    turn = torch.where(length > 0, turn / length.clamp_min(1e-300), unturned)
    colours = (0.5 + _HARMONIC * harmonics).clamp(0, 1)
    return Splats(
        means, deviations, Pose.from_quaternion(torch.zeros_like(means), turn).rotation, colours, opacity
    )


def _read_spz(path: Path) -> Splats:
    data = path.read_bytes()
    if data[:4] == b"NGSP":
        raise DataError(f"{path} is SPZ of version 4; write it as version 2 or 3, or as PLY.")
    try:
        unpacker = zlib.decompressobj(31)
        raw = unpacker.decompress(data, _MOST_BYTES)
        magic, version, n, degree, fraction, _, _ = _SPZ_HEADER.unpack_from(raw)
    except (zlib.error, struct.error) as error:
        raise DataError(f"{path} is not SPZ ({error}); it is truncated or another kind of file.") from error
    if magic != _SPZ_MAGIC or version not in (2, 3):
        raise DataError(f"{path} is SPZ of version {version}, or another kind of file; known are 2 and 3.")
    if degree >= len(_HARMONICS) or fraction > 23 or n > _MOST_SPLATS:
        raise DataError(f"{path} announces {n:,} splats with harmonics of degree {degree}: it is damaged.")
    widths = [9, 1, 3, 3, 4 if version == 3 else 3, 3 * _HARMONICS[degree]]
    if len(raw) - _SPZ_HEADER.size < n * sum(widths):
        raise DataError(f"{path} announces {n:,} splats, but is shorter: it is truncated.")
    ends = _SPZ_HEADER.size + n * np.cumsum([0, *widths])
    parts = [np.frombuffer(raw, np.uint8, n * w, e).reshape(n, w) for w, e in zip(widths, ends, strict=False)]
    places, opacity, colours, logs, turn, _ = parts
    whole = np.zeros((n, 3, 4), np.uint8)
    whole[:, :, 1:] = places.reshape(n, 3, 3)  # the upper bytes, so that the shift below keeps the sign
    means = torch.from_numpy((whole.view("<i4")[:, :, 0] >> 8) / 2.0**fraction)
    quaternions = _unpacked_quaternions(turn) if version == 3 else _first_three(turn)
    harmonics = (torch.from_numpy(colours / 255.0) - 0.5) / _SPZ_COLOUR
    deviations = torch.exp(torch.from_numpy(logs / 16.0 - 10.0))
    alpha = torch.from_numpy(opacity[:, 0] / 255.0)
    return _made(means, deviations, torch.from_numpy(quaternions), harmonics, alpha).turned(_Y_UP.T)


def _first_three(turn: np.ndarray) -> np.ndarray:
    """Quaternions x, y, z, w of version 2: x, y, z in bytes, w ≥ 0."""
    xyz = turn / 127.5 - 1.0
    return np.column_stack([xyz, np.sqrt(np.maximum(0, 1 - (xyz * xyz).sum(1)))])


def _unpacked_quaternions(turn: np.ndarray) -> np.ndarray:
    """The inverse of `_packed_quaternions`, from bytes (K, 4)."""
    word = np.ascontiguousarray(turn).view("<u4")[:, 0].copy()
    largest = (word >> np.uint32(30)).astype(np.int64)
    found = np.zeros((len(word), 4))
    for i in range(3, -1, -1):
        size = (word & np.uint32(511)) / (511 * math.sqrt(2))
        value = np.where(word >> np.uint32(9) & np.uint32(1), -size, size)
        found[:, i] = np.where(largest == i, 0.0, value)
        word = np.where(largest == i, word, word >> np.uint32(10))
    found[np.arange(len(word)), largest] = np.sqrt(np.maximum(0, 1 - (found * found).sum(1)))
    return found


def map_of_splats(splats: Splats, least_opacity: float = 0.1) -> GaussianMap:
    """A map whose components are splats, with their colours; it answers occupancy.

    A splat stands for a point on each square centimetre of its largest cross-section, times its opacity. The
    file does not tell from where it was seen: free space is known only near a surface, on the side of the
    middle of all splats. Splats below `least_opacity` are left out.
    """
    check_number("least_opacity", least_opacity)
    kept = splats.opacity >= least_opacity
    means, deviations, axes, colours, opacity = (values[kept] for values in splats)
    deviations = deviations.clamp_min(_THINNEST)
    order = deviations.argsort(1)
    short, middle, long = deviations.gather(1, order).unbind(1)
    normal = axes.gather(2, order[:, None, :1].expand(-1, 3, 1))[:, :, 0]
    center = means.median(0).values if len(means) else means.sum(0)
    side = ((center - means) * normal).sum(1, keepdim=True)
    toward = torch.where(side < 0, -normal, normal)
    k = len(means)
    scaled = axes * deviations[:, None]
    components = Components.given(
        means,
        scaled @ scaled.mT,
        (2 * math.pi * _POINTS * middle * long * opacity).clamp_min(1.0),
        means + torch.maximum(2 * long, _REACH * short)[:, None] * toward,
        None,
        0,
    )
    own = Numbers(
        torch.ones_like(opacity),
        linear_colours(colours),
        colours.new_zeros(k, 3, 3),
        colours.new_zeros(k, 3, 3),
    )
    return GaussianMap.of(replace(components, attributes=Attributes({COLOUR: own})))
