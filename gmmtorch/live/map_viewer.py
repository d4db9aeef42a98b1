"""MapViewer: a map in the browser, by viser. Needs no network beyond this machine."""

from __future__ import annotations

import contextlib
import io
import math
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import OutputError, check_choice
from gmmtorch.export.mesh import surface_mesh
from gmmtorch.live import viewer_scene
from gmmtorch.live.map_page import write_page
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.optional_packages import load_viser
from gmmtorch.report.scenes.ellipsoids import unit_sphere

_PATH_COLOUR, _PATH_WIDTH = (213, 94, 0), 4.0
_MESH_COLOUR, _BACKGROUND = (205, 205, 210), (240, 242, 245)
_OPACITY = 0.9  # of a splat
_FINEST, _COARSEST = 0.02, 1.0  # m, of the slider of the resolution
_WELCOME = "Click a place to see what the map knows about it."


class MapViewer:
    """Shows a map in the browser: components, the sensor's paths and slices of occupancy.

        viewer = MapViewer(GaussianMap.load("map.safetensors"))
        print(viewer.url)

    Args:
        shown: the map; an empty map is shown once `update` gives another one.
        trajectories: (S, D) sensor positions of each recording, world metres.
        shape: one of `viewer_scene.SHAPES`. colour: one of `viewer_scene.COLOURS`.
        host, port: where the page is served; another port is taken if this one is in use.

    The page has controls for the shape, the colour, the height above which components are hidden, the paths,
    and the height and resolution of the slice. A click shows occupancy, hits and misses at a place.

    Raises `GmmTorchError` if viser is not installed, and `OutputError` if no port is free.
    """

    def __init__(
        self,
        shown: GaussianMap,
        trajectories: Sequence[Tensor] = (),
        *,
        shape: str = "ellipsoids",
        colour: str = "height",
        host: str = "127.0.0.1",
        port: int = 8080,
    ) -> None:
        check_choice("shape", shape, viewer_scene.SHAPES)
        check_choice("colour", colour, viewer_scene.COLOURS)
        viser = load_viser()
        try:
            with contextlib.redirect_stdout(io.StringIO()):  # viser prints a box with the address
                self._server = viser.ViserServer(host, port, label="gmmtorch", verbose=False)
        except OSError as error:
            raise OutputError(f"host={host}, port={port} cannot be used: {error}; give another.") from error
        self._lock = threading.RLock()
        self._nodes: dict[str, Any] = {}
        self._shift = torch.zeros(3, dtype=torch.float64)
        self._box: tuple[tuple[float, ...], tuple[float, ...]] | None = None
        self._map, self._components = shown, Components.empty(3)
        self._paths: list[Tensor] = []
        self._add_controls(shape, colour)
        self.update(shown, trajectories)

    @property
    def url(self) -> str:
        """The address of the page."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    def stop(self) -> None:
        """Ends the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def update(self, shown: GaussianMap, trajectories: Sequence[Tensor] = ()) -> None:
        """Shows another map and other paths. The map must not change afterwards."""
        with self._lock:
            if shown.dim is None:
                return
            first = self._box is None
            self._map, self._components = shown, shown.components()
            self._paths = viewer_scene.in_space(trajectories)
            view = viewer_scene.frame(self._components, self._paths)
            self._box = tuple(view.low.tolist()), tuple(view.high.tolist())
            if first:
                self._begin(view)
            self._draw_components()
            self._draw_paths()
            self._draw_slice()

    def save_html(self, path: str | Path) -> Path:
        """Writes the map and the paths as one HTML file; see `map_page.write_page`."""
        with self._lock:
            return write_page(
                path, self._map, self._paths, shape=self._shape.value, colour=self._colour.value
            )

    # -- the scene ------------------------------------------------------------------------------------

    def _begin(self, begin: viewer_scene.Frame) -> None:
        """Limits of the controls, the camera and the lights, from the first map."""
        self._shift, away = begin.shift, begin.distance
        middle = ((begin.low + begin.high) / 2 - begin.shift).numpy()
        self._server.initial_camera.look_at = tuple(middle)
        self._add_lights(away)
        flat = self._map.dim == 2
        offset = np.array([-0.02, -0.1, 1.0]) if flat else np.array([-0.45, -0.65, 0.6])
        self._server.initial_camera.position = tuple(middle + away * offset)
        for control, visible in ((self._cut, not flat), (self._height, not flat)):
            control.visible = visible
        with self._quiet():
            for control in (self._cut, self._height):
                control.min, control.max = round(float(begin.low[2]), 2), round(float(begin.high[2]) + 0.1, 2)
            self._height.value = begin.height
            self._cut.value = min(begin.open_height, self._cut.max)
            self._resolution.value = max(_FINEST, min(self._map.resolution, _COARSEST))

    def _add_lights(self, away: float) -> None:
        """A grey background, light from everywhere, and two lamps: colours stay as saturated as they are."""
        scene = self._server.scene
        scene.set_background_image(np.full((2, 2, 3), _BACKGROUND, np.uint8), format="png")
        scene.configure_environment_map(None)
        scene.configure_default_lights(enabled=False)
        scene.add_light_ambient("/lights/everywhere", intensity=0.7)
        for name, place, strength in (("key", (-0.5, -0.8, 1.0), 1.0), ("fill", (0.9, 0.4, 0.5), 0.4)):
            scene.add_light_directional(
                f"/lights/{name}",
                intensity=strength,
                cast_shadow=False,
                position=tuple(10 * away * np.array(place)),
            )

    def _draw_components(self) -> None:
        below = self._cut.value if self._map.dim == 3 else math.inf
        below = math.inf if below >= self._cut.max else below
        solid = viewer_scene.surfaces(self._components, below)
        shape = self._shape.value
        self._remove("components")
        if shape == "none" or len(solid.rows) == 0:
            return
        colours = viewer_scene.colours(self._components, solid, self._colour.value).rgb
        scene = self._server.scene
        moved = (solid.means - self._shift).float().numpy()
        if shape == "surfaces" and self._map.dim == 3:
            self._nodes["components"] = self._surface_node(below)
        elif shape == "splats":
            opacity = np.full((len(moved), 1), _OPACITY, np.float32)
            covariance = solid.covariances.float().numpy()
            self._nodes["components"] = scene.add_gaussian_splats(
                "/components", moved, covariance, colours, opacity
            )
        else:
            balls = viewer_scene.instances(solid)
            vertices, faces = unit_sphere(viewer_scene.SPHERE_VERTICES)
            self._nodes["components"] = scene.add_batched_meshes_simple(
                "/components",
                vertices.float().numpy(),
                faces.numpy().astype(np.uint32),
                balls.wxyz.astype(np.float32),
                moved,
                batched_scales=balls.scales.astype(np.float32),
                batched_colors=colours,
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
            )

    def _surface_node(self, below: float) -> Any:
        """The mesh of the surfaces, with cells of the resolution of the slice."""
        mesh = surface_mesh(self._components, self._resolution.value)
        if below < math.inf:
            mesh = mesh.inside((-math.inf,) * 3, (math.inf, math.inf, below))
        return self._server.scene.add_mesh_simple(
            "/components",
            (mesh.vertices.cpu() - self._shift).float().numpy(),
            mesh.faces.cpu().numpy().astype(np.uint32),
            color=_MESH_COLOUR,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )

    def _draw_paths(self) -> None:
        self._remove("paths")
        lines = viewer_scene.segments(self._paths) - self._shift
        if len(lines) == 0 or not self._with_paths.value:
            return
        self._nodes["paths"] = self._server.scene.add_line_segments(
            "/paths",
            lines.float().numpy(),
            _PATH_COLOUR,
            thickness=_PATH_WIDTH,
            thickness_units="screen",
        )

    def _draw_slice(self) -> None:
        self._remove("slice")
        if not self._visible.value or self._box is None:
            return
        dim = self._components.dim
        height = self._height.value if dim == 3 else 0.0
        low, high = (corner[:dim] for corner in self._box)
        picture = viewer_scene.occupancy_slice(self._map, self._resolution.value, height, low, high)
        place = torch.tensor([*picture.middle, height if dim == 3 else -0.05], dtype=torch.float64)
        self._nodes["slice"] = self._server.scene.add_image(
            "/slice",
            picture.pixels,
            *picture.size,
            format="png",
            wxyz=(0.0, 1.0, 0.0, 0.0),  # an image's own y points down
            position=tuple((place - self._shift).tolist()),
            cast_shadow=False,
            receive_shadow=False,
        )

    def _remove(self, name: str) -> None:
        if name in self._nodes:
            self._nodes.pop(name).remove()

    # -- controls -------------------------------------------------------------------------------------

    def _add_controls(self, shape: str, colour: str) -> None:
        gui = self._server.gui
        gui.configure_theme(dark_mode=False, show_logo=False, show_share_button=False)
        self._is_quiet = False
        with gui.add_folder("Components"):
            self._shape = gui.add_dropdown("shape", viewer_scene.SHAPES, initial_value=shape)
            self._colour = gui.add_dropdown("colour", viewer_scene.COLOURS, initial_value=colour)
            self._cut = gui.add_slider("hide above [m]", 0.0, 1.0, 0.05, 1.0)
            self._with_paths = gui.add_checkbox("trajectory", True)
        with gui.add_folder("Occupancy"):
            self._visible = gui.add_checkbox("slice", True)
            self._height = gui.add_slider("height [m]", 0.0, 1.0, 0.05, 0.5)
            self._resolution = gui.add_slider("resolution [m]", _FINEST, _COARSEST, 0.01, 0.1)
        with gui.add_folder("Place"):
            self._place = gui.add_markdown(_WELCOME)
        for control in (self._shape, self._colour, self._cut):
            control.on_update(lambda _: self._redraw(self._draw_components))
        self._with_paths.on_update(lambda _: self._redraw(self._draw_paths))
        for control in (self._visible, self._height, self._resolution):
            control.on_update(lambda _: self._redraw(self._draw_slice))
        self._server.scene.on_click()(lambda event: self._show_place(event.ray_origin, event.ray_direction))

    def _redraw(self, draw: Any) -> None:
        with self._lock:
            if not self._is_quiet and self._box is not None:
                draw()

    def _show_place(self, origin: Sequence[float], direction: Sequence[float]) -> None:
        """Shows what the map knows where a ray in the scene's frame meets a component or the slice."""
        with self._lock:
            if self._box is None:
                return
            start = torch.tensor(origin, dtype=torch.float64) + self._shift
            along = torch.tensor(direction, dtype=torch.float64)
            dim = self._components.dim
            below = self._cut.value if dim == 3 and self._cut.value < self._cut.max else math.inf
            nearest = math.inf
            if self._shape.value != "none":
                solid = viewer_scene.surfaces(self._components, below)
                nearest = viewer_scene.first_hit(solid, start, along)
            if self._visible.value and float(along[2]):
                plane = (self._height.value if dim == 3 else 0.0) - float(start[2])
                to_plane = plane / float(along[2])
                nearest = min(nearest, to_plane if to_plane > 0 else math.inf)
            if not math.isfinite(nearest):
                self._place.content = _WELCOME
                return
            resolution = self._resolution.value
            position = (start + nearest * along)[:dim]
            known = viewer_scene.place_at(self._map, position, resolution)
            self._place.content = viewer_scene.place_text(known, resolution)
            spot = torch.nn.functional.pad(position, (0, 3 - dim)) - self._shift
            self._remove("place")
            self._nodes["place"] = self._server.scene.add_icosphere(
                "/place", 0.6 * max(resolution, 0.1), (230, 0, 80), position=tuple(spot.tolist())
            )

    @contextlib.contextmanager
    def _quiet(self) -> Iterator[None]:
        """Changes of controls draw nothing."""
        self._is_quiet = True
        try:
            yield
        finally:
            self._is_quiet = False
