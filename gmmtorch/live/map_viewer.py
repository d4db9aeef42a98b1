"""MapViewer: a map in the browser, by viser. Needs no network beyond this machine."""

from __future__ import annotations

import contextlib
import hashlib
import io
import ipaddress
import math
import socket
import threading
from collections.abc import Callable, Container, Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import GmmTorchError, InvalidArgumentError, check_choice, check_whole
from gmmtorch.export import surface_mesh
from gmmtorch.live import viewer_scene
from gmmtorch.live.map_page import write_page
from gmmtorch.mapping import Components, GaussianMap
from gmmtorch.optional_packages import needs_extra

_PATH_COLOUR, _PATH_WIDTH = (213, 94, 0), 4.0
_FINEST, _COARSEST = 0.02, 1.0  # m, of the slider of the resolution
_LAST_PORT = 65535
_ROOM = 1.1  # the controls cover a part of the page
Rgb = tuple[int, int, int]
_WELCOME = "Click a place to see what the map knows about it."


class MapViewer:
    """Shows a map in the browser: components, the sensor's paths and slices of occupancy.

        viewer = MapViewer(GaussianMap.load("map.safetensors"))
        print(viewer.url)

    Args:
        shown: the map; an empty map is shown once `update` gives another one.
        trajectories: (S, D) sensor positions of each recording, world metres.
        shape: one of `viewer_scene.SHAPES`. colour: one of `viewer_scene.colour_choices`.
        host, port: where the page is served; another port is taken if this one is in use.
        origins: of the page at a proxy, such as https://map.example.org; others are refused, see `admits`.

    The page has controls for the shape, the colour, the height above which components are hidden, the paths,
    and the height and resolution of the slice. A click shows occupancy, hits and misses at a place.

    Attributes:
        server: the viser server.
        shift: (3,) origin of the scene's frame in the world frame, metres.

    Raises `GmmTorchError` if viser is not installed, and `InvalidArgumentError` for a host that is not of
    this machine, or an origin that is none.
    """

    def __init__(
        self,
        shown: GaussianMap,
        trajectories: Sequence[Tensor] = (),
        *,
        shape: str = "splats",
        colour: str = "height",
        host: str = "127.0.0.1",
        port: int = 8080,
        origins: Sequence[str] = (),
    ) -> None:
        check_choice("shape", shape, viewer_scene.SHAPES)
        known = shown.components() if shown.dim else Components.empty(3)
        check_choice("colour", colour, viewer_scene.colour_choices(known))
        with needs_extra("The browser viewer needs", "viser", "viewer"):
            import viser
        _check_address(host, port)
        _check_origins(origins)
        # viser prints a box with the address
        with contextlib.redirect_stdout(io.StringIO()), _refusing(host, origins):
            self.server: Any = viser.ViserServer(host, port, label="gmmtorch", verbose=False)
        self._lock = threading.RLock()
        self._nodes: dict[str, Any] = {}
        self._sent: dict[str, tuple[str, bytes]] = {}  # shape and digest of each part of the components
        self.shift = torch.zeros(3, dtype=torch.float64)
        self._view: viewer_scene.Frame | None = None
        self._map, self._components = shown, Components.empty(3)
        self._paths: list[Tensor] = []
        self._path_colours: Sequence[Rgb] = ()
        self._is_lit = False
        self._chosen: dict[str, float] = {}  # by control, the value that was set here last
        self._camera = viewer_scene.FollowingCamera(self.server)
        self._add_controls(shape, colour)
        self.update(shown, trajectories)

    @property
    def url(self) -> str:
        """The address of the page."""
        host = self.server.get_host()
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}"

    def stop(self) -> None:
        """Ends the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    @property
    def n_viewers(self) -> int:
        """Number of browsers that show the page now."""
        return len(self.server.get_clients())

    def update(
        self, shown: GaussianMap, trajectories: Sequence[Tensor] = (), colours: Sequence[Rgb] = ()
    ) -> None:
        """Shows another map and other paths. The map must not change afterwards.

        A camera that the user has not moved follows the map, and so do the controls.

        Args:
            trajectories: (S, D) sensor positions, world metres. colours: of each; without, all are orange.
        """
        with self._lock:
            if shown.dim is None:
                return
            self._map, self._components = shown, shown.components()
            choices = viewer_scene.colour_choices(self._components)
            if choices != self._colour.options:  # a channel of an earlier map may be gone
                self._colour.options = choices
            self._paths, self._path_colours = viewer_scene.in_space(trajectories), colours
            unsure = viewer_scene.first_hidden(viewer_scene.surfaces(self._components), shown.resolution)
            self._choose(self._unsure, unsure)
            self._show(viewer_scene.frame(self._components, self._paths, self._unsure.value / 100))
            self._draw_components()
            self._draw_paths()
            self._draw_slice()

    def update_cells(
        self, centres: Tensor, side: float, trajectories: Sequence[Tensor], colours: Sequence[Rgb]
    ) -> None:
        """Shows occupied cells, with centres (C, 3) and a side (m), in place of a map; there is no slice."""
        with self._lock:
            self._paths, self._path_colours = viewer_scene.in_space(trajectories), colours
            for folder in self._folders:
                folder.visible = False
            self._fit(viewer_scene.frame_of(centres, self._paths), flat=False)
            shades = viewer_scene.height_shades(centres)
            moved = (centres - self.shift).numpy()
            self._remove_parts(keep=("components",))
            self._nodes["components"] = viewer_scene.add_cells(self.server.scene, moved, side, shades)
            self._draw_paths()

    def save_html(self, path: str | Path) -> Path:
        """Writes the map and the paths as one HTML file; see `map_page.write_page`."""
        with self._lock:
            return write_page(
                path, self._map, self._paths, shape=self._shape.value, colour=self._colour.value
            )

    def _fit(self, view: viewer_scene.Frame, flat: bool) -> None:
        """Fits the camera to a frame; the first one moves the origin. flat: the camera looks from above."""
        if not self._is_lit:
            self._is_lit, self.shift = True, view.shift
            viewer_scene.add_lights(self.server.scene, view.distance)
        middle = ((view.low + view.high) / 2 - self.shift).numpy()
        offset = np.array([-0.02, -0.1, 1.0]) if flat else np.array([-0.45, -0.65, 0.6])
        self._camera.show(middle, middle + _ROOM * view.distance * offset)

    def _show(self, view: viewer_scene.Frame) -> None:
        """Fits the camera and the limits of the controls to a frame."""
        flat = self._map.dim == 2
        self._fit(view, flat)
        self._view = view
        low, high = round(float(view.low[2]), 2), round(float(view.high[2]) + 0.1, 2)
        self._is_quiet = True
        try:
            for control in (self._cut, self._height):
                _assign(control, visible=not flat)
            cut_is_chosen = self._is_chosen(self._cut) and self._cut.value < self._cut.max
            for control in (self._cut, self._height):
                _assign(control, min=low, max=high)
            self._choose(self._height, view.height)
            self._choose(self._visible, flat)
            self._choose(self._resolution, max(_FINEST, min(self._map.resolution, _COARSEST)))
            if not cut_is_chosen:
                _assign(self._cut, value=min(view.open_height, high))
                self._chosen[self._cut.label] = self._cut.value
        finally:
            self._is_quiet = False

    def _is_chosen(self, control: Any) -> bool:
        """Whether the user has chosen the value of a control."""
        return control.value != self._chosen.get(control.label, control.value)

    def _choose(self, control: Any, value: float) -> None:
        """Sets a control that the user has not set."""
        if not self._is_chosen(control):
            _assign(control, value=value)
            self._chosen[control.label] = control.value

    def _highest(self) -> float:
        """The height (m) above which components are hidden."""
        return self._cut.value if self._map.dim == 3 and self._cut.value < self._cut.max else math.inf

    def _draw_components(self) -> None:
        below = self._highest()
        solid = viewer_scene.surfaces(self._components, below, self._unsure.value / 100)
        shape = self._shape.value
        if shape == "none" or len(solid.rows) == 0:
            self._remove_parts()
            return
        colours = viewer_scene.colours(self._components, solid, self._colour.value)
        self._legend.content = colours.html
        scene = self.server.scene
        solid = solid._replace(means=solid.means - self.shift)
        if shape == "surfaces" and self._map.dim == 3:
            mesh = surface_mesh(self._components, self._resolution.value)
            if below < math.inf:
                mesh = mesh.inside((-math.inf,) * 3, (math.inf, math.inf, below))
            self._remove_parts()
            self._nodes["components"] = viewer_scene.add_mesh(scene, mesh, self.shift)
            return
        parts = viewer_scene.parts(self._components, solid)
        self._remove_parts(keep=parts)
        is_soft, n_all = shape == "splats", len(solid.rows)
        arrays = viewer_scene.splats(solid, colours) if is_soft else viewer_scene.ellipsoids(solid, colours)
        for name, rows in parts.items():
            part = tuple(values[rows] for values in arrays)
            content = hashlib.blake2b(b"".join(values.tobytes() for values in part)).digest()
            if self._sent.get(name) == (shape, content):
                continue
            self._sent[name] = shape, content
            self._nodes[name] = (
                scene.add_gaussian_splats(f"/{name}", *part)
                if is_soft
                else viewer_scene.add_ellipsoids(scene, f"/{name}", part, n_all)
            )

    def _remove_parts(self, keep: Container[str] = ()) -> None:
        """Removes what components are drawn as, except the parts with some names."""
        for name in [name for name in self._nodes if name.startswith("components") and name not in keep]:
            self._sent.pop(name, None)
            self._remove(name)

    def _draw_paths(self) -> None:
        given = self._path_colours or [_PATH_COLOUR] * len(self._paths)
        for number, path in enumerate(self._paths):
            name, lines = f"paths/{number}", viewer_scene.segments([path]) - self.shift
            if len(lines) == 0 or not self._with_paths.value:
                self._remove(name)
                continue
            self._nodes[name] = self.server.scene.add_line_segments(
                f"/{name}",
                lines.float().numpy(),
                given[number],
                thickness=_PATH_WIDTH,
                thickness_units="screen",
            )

    def _draw_slice(self) -> None:
        if not self._visible.value or self._view is None:
            self._remove("slice")
            return
        sides = self._resolution.value, self._height.value
        picture = viewer_scene.occupancy_slice(self._map, *sides, self._view)
        self._nodes["slice"] = viewer_scene.add_slice(self.server.scene, picture, self.shift)

    def _remove(self, name: str) -> None:
        if name in self._nodes:
            self._nodes.pop(name).remove()

    def _add_controls(self, shape: str, colour: str) -> None:
        gui = self.server.gui
        gui.configure_theme(dark_mode=False, show_logo=False, show_share_button=False)
        self._is_quiet = False
        self._folders = [gui.add_folder(name) for name in ("Components", "Occupancy", "Place")]
        components, occupancy, place = self._folders
        with components:
            self._shape = gui.add_dropdown("shape", viewer_scene.SHAPES, initial_value=shape)
            known = dict.fromkeys((*viewer_scene.COLOURS, colour))  # each once, or the page stays blank
            self._colour = gui.add_dropdown("colour", tuple(known), initial_value=colour)
            self._legend = gui.add_html("")
            self._cut = gui.add_slider("hide above [m]", 0.0, 1.0, 0.05, 1.0)
            self._unsure = gui.add_slider("hide least certain [%]", 0, 100, 1, 0)
            self._with_paths = gui.add_checkbox("trajectory", True)
        with occupancy:
            self._visible = gui.add_checkbox("slice", False)
            self._height = gui.add_slider("height [m]", 0.0, 1.0, 0.05, 0.5)
            self._resolution = gui.add_slider("resolution [m]", _FINEST, _COARSEST, 0.01, 0.1)
        with place:
            self._place = gui.add_markdown(_WELCOME)
        for control in (self._shape, self._colour, self._cut, self._unsure):
            control.on_update(lambda _: self._redraw(self._draw_components))
        self._with_paths.on_update(lambda _: self._redraw(self._draw_paths))
        for control in (self._visible, self._height, self._resolution):
            control.on_update(lambda _: self._redraw(self._draw_slice))
        self.server.scene.on_click()(lambda event: self._show_place(event.ray_origin, event.ray_direction))

    def _redraw(self, draw: Any) -> None:
        with self._lock:
            if not self._is_quiet and self._view is not None:
                draw()

    def _show_place(self, origin: Sequence[float], direction: Sequence[float]) -> None:
        """Shows what the map knows where a ray in the scene's frame meets a component or the slice."""
        with self._lock:
            if self._view is None:
                return
            start = torch.tensor(origin, dtype=torch.float64) + self.shift
            along = torch.tensor(direction, dtype=torch.float64)
            dim = self._components.dim
            nearest = math.inf
            if self._shape.value != "none":
                hidden = self._unsure.value / 100
                solid = viewer_scene.surfaces(self._components, self._highest(), hidden)
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
            self._place.content = viewer_scene.place_text(self._map, position, resolution)
            spot = torch.nn.functional.pad(position, (0, 3 - dim)) - self.shift
            self._remove("place")
            self._nodes["place"] = self.server.scene.add_icosphere(
                "/place", 0.6 * max(resolution, 0.1), (230, 0, 80), position=tuple(spot.tolist())
            )


def _check_address(host: str, port: int) -> None:
    """Raises an error for an address that cannot be used; viser would wait for ever."""
    if check_whole("port", port, 1) > _LAST_PORT:
        raise InvalidArgumentError(f"port={port} must be at most {_LAST_PORT}.")
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        socket.create_server((host, 0), family=family).close()
    except OSError as error:
        raise InvalidArgumentError(
            f"host={host} is not an address of this machine ({error}); use 127.0.0.1, or 0.0.0.0 for all."
        ) from error


def admits(host: str, origin: str | None, served: str, origins: Sequence[str] = ()) -> bool:
    """Whether a request may see the map: the headers Host and Origin are those of our own page.

    Without this, every page that is open in the user's browser could read the map: it connects from its own
    Origin, or lets the name of its own machine point to this one, which Host then shows.

    Args:
        host, origin: the headers. Only browsers send an Origin.
        served: the address that the page is served at.
        origins: further ones that are allowed, such as https://map.example.org.
    """
    allowed = {_as_sent(name) for name in origins}
    place = host.lower()
    names = {served.lower(), "localhost", (own := socket.gethostname().lower()), f"{own}.local"}
    is_ours = _host_name(place) in names or _is_address(_host_name(place))
    if not is_ours and place not in {urlsplit(name).netloc for name in allowed}:
        return False
    return origin is None or origin.lower() in {*allowed, f"http://{place}", f"https://{place}"}


def _host_name(place: str) -> str:
    """The name or address of name:port."""
    try:
        return urlsplit(f"//{place}").hostname or ""
    except ValueError:
        return ""


def _is_address(name: str) -> bool:
    """Whether a name is an IP address, which no other page can let point to this machine."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


_DEFAULT_PORTS = {"http": ":80", "https": ":443"}


def _as_sent(origin: str) -> str:
    """An origin as browsers send it: in lower case, without the default port."""
    origin = origin.rstrip("/").lower()
    return origin.removesuffix(_DEFAULT_PORTS.get(origin.partition(":")[0], ""))


def _is_origin(text: str) -> bool:
    """Whether a text is http or https and the name of a machine, perhaps with a port."""
    try:
        parts = urlsplit(text.rstrip("/"))
        _ = parts.port
    except ValueError:
        return False
    is_whole = parts.geturl() == f"{parts.scheme}://{parts.netloc}" and "@" not in parts.netloc
    return parts.scheme in _DEFAULT_PORTS and bool(parts.hostname) and is_whole


def _check_origins(origins: Sequence[str]) -> None:
    for origin in origins:
        if not _is_origin(origin):
            raise InvalidArgumentError(
                f"origins={list(origins)}: {origin} is not the origin of a page; give one such as "
                "https://map.example.org or http://robot:8080."
            )


_serving = threading.Lock()


@contextlib.contextmanager
def _refusing(host: str, origins: Sequence[str]) -> Iterator[None]:
    """A server that viser starts inside answers 403 to requests that `admits` does not admit.

    viser has no place for such a check, so it gets another `serve` of websockets while it starts.
    """
    from websockets.asyncio import server

    plain, n_started = server.serve, 0

    def serve(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        nonlocal n_started
        n_started += 1

        def checked(connection: Any, request: Any) -> Any:
            hosts, pages = request.headers.get_all("Host"), request.headers.get_all("Origin")
            is_clear = len(hosts) == 1 and len(pages) <= 1
            if is_clear and admits(hosts[0], pages[0] if pages else None, host, origins):
                return process_request(connection, request)
            return connection.respond(403, "This page is refused: its address is not one of the map's.\n")

        return plain(*arguments, process_request=checked, **options)

    with _serving:
        server.serve = serve  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            server.serve = plain  # type: ignore[misc]
    if not n_started:
        raise GmmTorchError("This version of viser cannot be kept from showing the map to foreign pages.")


def _assign(control: Any, **values: Any) -> None:
    """Sets properties of a control; those that stay as they are send nothing to the browsers."""
    for name, value in values.items():
        if getattr(control, name) != value:
            setattr(control, name, value)
