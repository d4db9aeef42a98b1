"""A map as one HTML page with controls, which a browser opens from disk without a network (WebGL 2)."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_choice
from gmmtorch.export import surface_mesh
from gmmtorch.files import write_bytes
from gmmtorch.live import viewer_scene
from gmmtorch.live.viewer_scene import Frame, Solid
from gmmtorch.mapping import Components, GaussianMap
from gmmtorch.report import byte_text

_TEMPLATE = Path(__file__).with_suffix(".html")
_PLACE = "__MAP__"
_SLOPE_STEPS = 254  # of a colour, as in the page


def write_page(
    path: str | Path,
    shown: GaussianMap,
    trajectories: Sequence[Tensor] = (),
    *,
    shape: str = "splats",
    colour: str = "height",
) -> Path:
    """Writes a map as one HTML file, atomically.

    The page has controls for the shape, the colour and the size of components, the height above which and
    the share of the least certain that are hidden, the paths and a slice of occupancy at the sensor's height.

    Args:
        path: FILE.html.
        shown: the map.
        trajectories: (S, 2) or (S, 3) sensor positions of each recording, world metres.
        shape: one of `viewer_scene.SHAPES`, shown first. The mesh of the surfaces, which is large, is in the
            file only with "surfaces".
        colour: one of `viewer_scene.colour_choices`, shown first.

    Raises `InvalidArgumentError` for another ending or choice, and for a map without surfaces.
    """
    check_choice("shape", shape, viewer_scene.SHAPES)
    path = Path(path)
    if path.suffix not in (".html", ".htm"):
        raise InvalidArgumentError(f"html={path} must end in .html.")
    components = shown.components() if shown.dim else Components.empty(3)
    check_choice("colour", colour, viewer_scene.colour_choices(components))
    solid = viewer_scene.surfaces(components)
    if len(solid.rows) == 0:
        raise InvalidArgumentError(f"html={path}: the map has no surface to show; insert scans with returns.")
    paths = viewer_scene.in_space(trajectories)
    unsure = viewer_scene.first_hidden(solid, shown.resolution)
    frame = viewer_scene.frame(components, paths, unsure / 100)
    scene = {
        "about": f"{len(components):,} components, {byte_text(shown.nbytes)}",
        "flat": components.dim == 2,
        "shape": shape,
        "shapes": [name for name in viewer_scene.SHAPES if name != "surfaces" or shape == "surfaces"],
        "colour": colour,
        "scale": viewer_scene.colour_scale(),
        "unsure": unsure,
        **_view(frame),
        **_ellipsoids(components, solid, frame),
        "paths": _encoded(viewer_scene.segments(paths) - frame.shift, "<f4"),
        "slice": _slice(shown, frame),
        "mesh": _mesh(shown, frame) if shape == "surfaces" and shown.dim == 3 else None,
    }
    text = json.dumps(scene).replace("</", "<\\/")  # a closing tag would end the element with the data
    return write_bytes(path, _TEMPLATE.read_text(encoding="utf-8").replace(_PLACE, text).encode())


def _view(frame: Frame) -> dict[str, Any]:
    """The first camera, and the heights (m) of the scene's frame between which components can be hidden."""
    low, high = frame.low - frame.shift, frame.high - frame.shift
    top = float(high[2]) + 0.1
    shown = torch.cat([high[:2], high[2:].clamp_max(frame.open_height - float(frame.shift[2]))])
    return {
        "middle": ((low + shown) / 2).tolist(),
        "half": ((shown - low) / 2).tolist(),
        "distance": 1.35 * frame.distance,
        "low": float(low[2]),
        "high": top,
        "cut": min(frame.open_height - float(frame.shift[2]), top),
    }


def _ellipsoids(components: Components, solid: Solid, frame: Frame) -> dict[str, Any]:
    """Place, turn (x, y, z, w), standard deviations and uncertainty of each component, and colours."""
    wxyz, positions, scales = viewer_scene.instances(solid)
    places = np.zeros((len(solid.rows), 3, 4))
    places[:, 0, :3] = positions - frame.shift.numpy()
    places[:, 1] = wxyz[:, [1, 2, 3, 0]]
    places[:, 2, :3] = scales / viewer_scene.N_SIGMA
    places[:, 2, 3] = viewer_scene.uncertainty(solid)
    colours = {}
    for by in viewer_scene.colour_choices(components):
        found = viewer_scene.colours(components, solid, by)
        colours[by] = {"rgb": _encoded(found.rgb, "u1"), "ends": found.ends, "legend": found.legend}
        if found.slopes is not None:
            slopes = np.clip(np.round(_SLOPE_STEPS * found.slopes), -127, 127) + 128
            colours[by]["slopes"] = _encoded(slopes, "u1")
    return {"places": _encoded(places, "<f4"), "colours": colours}


def _slice(shown: GaussianMap, frame: Frame) -> dict[str, Any]:
    """The picture of occupancy at the sensor's height, as PNG, and its place in the scene."""
    from PIL import Image

    picture = viewer_scene.occupancy_slice(shown, shown.resolution, frame.height, frame)
    file = io.BytesIO()
    Image.fromarray(picture.pixels).save(file, "PNG")
    return {
        "png": "data:image/png;base64," + base64.b64encode(file.getvalue()).decode(),
        "middle": (picture.middle - frame.shift).tolist(),
        "size": picture.size,
    }


def _mesh(shown: GaussianMap, frame: Frame) -> dict[str, str]:
    """The triangles of the surfaces."""
    found = surface_mesh(shown.components(), shown.resolution)
    return {
        "vertices": _encoded(found.vertices.cpu() - frame.shift, "<f4"),
        "faces": _encoded(found.faces, "<u4"),
    }


def _encoded(values: Tensor | np.ndarray, kind: str) -> str:
    """The values in row-major order as numbers of a NumPy type, in base64."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode()
