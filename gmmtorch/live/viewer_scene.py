"""What the browser viewer shows: ellipsoids, colours, slices of occupancy, robots, and a place."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import check_choice
from gmmtorch.export import TriangleMesh, colour_bytes
from gmmtorch.mapping import Attributes, Components, GaussianMap, Labels
from gmmtorch.occupancy import VoxelGrid
from gmmtorch.pose import Pose
from gmmtorch.report import (
    N_SIGMA,
    SOUTH_WEST,
    MapPanel,
    colour,
    cut_away,
    first_viewpoints,
    height_colour_map,
    height_scale,
    occupancy_colours,
    principal_axes,
    robust_bounds,
    slice_image,
    unit_sphere,
)
from gmmtorch.scan import COLOUR, display_colours

SHAPES = ("splats", "ellipsoids", "surfaces", "none")
"""How components are drawn: Gaussian splats, 2σ ellipsoids, or the triangle mesh of the surfaces."""

COLOURS = ("height", "support", "age", "uncertainty")
"""What colours the components of every map: z of the mean; log of the support; order in which they were
learned; log of the `uncertainty`. Channels of the map, such as colour, come after these."""

_UNKNOWN = 160  # grey of components without a value of a channel

_SPHERES = ((1500, 162), (math.inf, 42))  # number of components, at most, and vertices of each ellipsoid
_FLATNESS = 0.01  # m, thickness of a 2D component
_FREE_ALPHA, _OCCUPIED_ALPHA = 90, 240
_FAR = 1e4  # m from the origin, above which float32 is too coarse and the scene is moved to the origin
_SLICE_PIXELS = 1000  # along the longer side of a slice
_UNSURE = 3.0  # cells of the map's resolution: uncertainty of components that are hidden at first
_SCALE_STEPS = 10  # of a scale of heights, at least, to which its ends are rounded
_PART = 256  # components, numbered one after the other, that are sent together
_UNDERNEATH = -0.05  # m, height of the slice of a 2D map: below its components


class Solid(NamedTuple):
    """Components in space: means (K, 3), metres; covariances (K, 3, 3), m²; rows (K,) in the map; support
    (K,)."""

    means: Tensor
    covariances: Tensor
    rows: Tensor
    support: Tensor


class Slice(NamedTuple):
    """A picture of occupancy in a plane: RGBA (rows, columns, 4) uint8, highest y first. In 3D unknown is
    clear, and free is translucent. middle (3,), world frame, and size (2,), metres."""

    pixels: np.ndarray
    middle: Tensor
    size: tuple[float, float]


def surfaces(components: Components, below: float = math.inf, hidden: float = 0.0) -> Solid:
    """The surface components with means below a height (m), without a share of the least certain ones.

    2D ones become flat ones at z = 0.
    """
    kept = ~components.max_range & (components.support > 0)
    if components.dim == 3:
        kept = kept & (components.means[:, 2] <= below)
    rows = kept.nonzero().squeeze(1)
    support = components.support[rows].double().cpu()
    mean, covariance = components.means[rows].cpu(), components.covariances[rows].cpu()
    if components.dim == 2:
        mean = torch.nn.functional.pad(mean, (0, 1))
        covariance = torch.nn.functional.pad(covariance, (0, 1, 0, 1))
        covariance[:, 2, 2] = (_FLATNESS / 2) ** 2
    solid = Solid(mean, covariance, rows.cpu(), support)
    if not hidden:
        return solid
    surest = torch.argsort(uncertainty(solid), stable=True)[: math.ceil((1 - hidden) * len(rows))]
    return Solid(*(values[surest.sort().values] for values in solid))


def uncertainty(solid: Solid) -> Tensor:
    """How uncertain the surface of each component is (K,), metres: the larger one of its deviation across
    the surface and the mean distance between its points."""
    deviations = torch.linalg.eigvalsh(solid.covariances).clamp_min(0).sqrt()
    area = 2 * math.pi * deviations[:, 1] * deviations[:, 2]
    return torch.maximum(deviations[:, 0], (area / solid.support).sqrt())


def first_hidden(solid: Solid, resolution: float) -> int:
    """Percent of the components that are hidden at first: they are less certain than three cells of the
    map's resolution (m), and would hide what is certain."""
    unsure = uncertainty(solid) > _UNSURE * resolution
    return math.ceil(100 * int(unsure.sum()) / max(len(unsure), 1))


def instances(solid: Solid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The 2σ ellipsoids as copies of a unit sphere: quaternions wxyz (K, 4), places and scales (K, 3), m."""
    deviations, axes = principal_axes(solid.covariances)
    turned = Pose(axes, solid.means).quaternion()[:, [3, 0, 1, 2]]
    return turned.numpy(), solid.means.numpy(), N_SIGMA * deviations.numpy()


class Colours(NamedTuple):
    """Colours of components, rgb (K, 3) uint8, and what the first and the last colour of the scale mean;
    None: they are not of the scale. legend: names and CSS colours of classes. slopes (K, 3, 3): change of the
    RGB, from 0 to 1, in a deviation along each principal axis; None: it does not vary in a component."""

    rgb: np.ndarray
    ends: tuple[str, str] | None = None
    legend: Sequence[tuple[str, str]] = ()
    slopes: np.ndarray | None = None

    @property
    def html(self) -> str:
        """The scale with its ends, or the legend of the classes; empty without both."""
        if self.ends is None:
            mark = '<span style="background:{};display:inline-block;width:10px;height:10px"></span> {}<br>'
            return "".join(mark.format(css, html.escape(name)) for name, css in self.legend)
        bar = f"height:10px;background:linear-gradient(to right,{','.join(colour_scale())})"
        ends = "<span>{}</span><span>{}</span>".format(*self.ends)
        row = "display:flex;justify-content:space-between;padding:0 1em;font-size:12px"
        return f'<div style="{bar}"></div><div style="{row}">{ends}</div>'


def colour_choices(components: Components) -> tuple[str, ...]:
    """What can colour these components: `COLOURS`, and the channels of the map."""
    return (*COLOURS, *(name for name in components.attributes.channels if name not in COLOURS))


def colours(components: Components, solid: Solid, by: str) -> Colours:
    """The colours of the components by one of `colour_choices`."""
    check_choice("colour", by, colour_choices(components))
    if by == "height":
        scale = _steady_scale(solid.means[:, 2])
        deviations, axes = principal_axes(solid.covariances)
        change = axes[:, 2] * deviations
        above, below = (
            _shades(scale((solid.means[:, 2:] + sign * change).numpy())) / 255 for sign in (1, -1)
        )
        slopes = (above - below) / 2
        return Colours(
            height_shades(solid.means), (f"{scale.vmin:.2f} m", f"{scale.vmax:.2f} m"), slopes=slopes
        )
    if by == "age":
        value = components.ids[:, 1].cpu()[solid.rows].double()
        return Colours(_spread(value, *_range(value)), ("oldest", "newest"))
    if by in COLOURS:
        value = 1e3 * uncertainty(solid) if by == "uncertainty" else solid.support
        low, high = _range(value)
        unit = "points" if by == "support" else "mm"
        ends = (f"{low:.3g} {unit}", f"{high:.3g} {unit}")
        low, high = math.log(max(low, 1e-9)), math.log(max(high, 1e-9))
        return Colours(_spread(value.clamp_min(1e-9).log(), low, high), ends)
    chosen = components.attributes.selected(solid.rows.to(components.means.device)).on_cpu()
    return _channel_colours(by, chosen, solid)


def _channel_colours(name: str, attributes: Attributes, solid: Solid) -> Colours:
    """The colours of a channel of components on the CPU; grey where it is unknown."""
    channel, legend, ends, slopes = attributes.channels[name], [], None, None
    if isinstance(channel, Labels):
        hues = np.array([list(bytes.fromhex(colour(i)[1:])) for i in range(len(channel.labels))], np.uint8)
        known, rgb = channel.share.sum(1) > 0, hues[channel.share.argmax(1).numpy()]
        names = map(str, channel.labels.tolist())
        legend = [(label, _css(hue)) for label, hue in zip(names, hues.tolist(), strict=True)]
    elif name == COLOUR:
        known, rgb = channel.share > 0, colour_bytes(channel.mean)
        deviations, axes = principal_axes(solid.covariances)
        change = (channel.slope @ axes[:, : channel.slope.shape[2]] * deviations[:, None]).mT
        nearby = [display_colours((channel.mean[:, None] + sign * change).clamp(0, 1)) for sign in (1, -1)]
        slopes = ((nearby[0] - nearby[1]) / 2).numpy()
    else:
        known, value = channel.share > 0, channel.mean[:, 0]
        some = value[known]
        low, high = some.quantile(torch.tensor([0.02, 0.98]).double()).tolist() if len(some) else (0.0, 1.0)
        rgb, ends = _spread(value, low, high), (f"{low:.3g}", f"{high:.3g}")
    rgb = np.where(known.numpy()[:, None], rgb, _UNKNOWN).astype(np.uint8)
    return Colours(rgb, ends, legend, slopes)


def _range(value: Tensor) -> tuple[float, float]:
    """The least and the largest of some values (K,); 0 and 1 if there are none."""
    return (float(value.min()), float(value.max())) if len(value) else (0.0, 1.0)


def _spread(value: Tensor, low: float, high: float) -> np.ndarray:
    """Colours (K, 3) uint8 of values (K,) on a scale from `low` to `high`."""
    share = (value - low) / max(high - low, 1e-9)
    return _shades(share.clamp(0, 1).numpy())


def height_shades(places: Tensor) -> np.ndarray:
    """Colours (K, 3) uint8 of the heights of places (K, 3), metres."""
    return _shades(np.asarray(_steady_scale(places[:, 2])(places[:, 2].numpy())))


def _steady_scale(heights: Tensor) -> Any:
    """The colour scale of heights (N,), metres, whose ends are rounded, so that a map that grows a little
    keeps its colours."""
    scale: Any = height_scale(heights)
    low, high = scale.vmin, scale.vmax
    step = 2.0 ** math.floor(math.log2((high - low) / _SCALE_STEPS))
    scale.vmin, scale.vmax = step * math.floor(low / step), step * math.ceil(high / step)
    return scale


def colour_scale() -> list[str]:
    """The scale of a legend as CSS colours, from the first to the last."""
    return [_css(shade) for shade in _shades(np.linspace(0, 1, _N_SHADES)).tolist()]


def _css(shade: Sequence[int]) -> str:
    return "rgb({}, {}, {})".format(*shade)


def _shades(share: np.ndarray) -> np.ndarray:
    """Colours (K, 3) uint8 of shares (K,) of the scale."""
    return np.round(255 * height_colour_map(lighter=0.0)(share)[..., :3]).astype(np.uint8)


class Frame(NamedTuple):
    """What a first view of a map shows.

    low, high (3,): corners of the box of the map and the path, world frame. shift (3,): origin of the scene's
    frame, moved to the map where float32 is too coarse in the world frame. distance: of the camera from the
    middle of the box. height: of the slice, that of the sensor. open_height: below a level ceiling; ∞ if
    there is none. All in metres.
    """

    low: Tensor
    high: Tensor
    shift: Tensor
    distance: float
    height: float
    open_height: float


def in_space(trajectories: Sequence[Tensor]) -> list[Tensor]:
    """Sensor positions (S, 3), float64, of paths (S, 2 or 3); those in 2D lie at z = 0."""
    paths = [path.detach().cpu().double() for path in trajectories]
    return [torch.nn.functional.pad(path, (0, 3 - path.shape[1])) for path in paths]


def segments(paths: Sequence[Tensor]) -> Tensor:
    """The lines (N, 2, 3) between consecutive positions of each path (S, 3)."""
    pieces = [torch.stack([path[:-1], path[1:]], 1) for path in paths if len(path)]
    return torch.cat(pieces) if pieces else torch.zeros(0, 2, 3, dtype=torch.float64)


def frame(components: Components, paths: Sequence[Tensor], hidden: float = 0.0) -> Frame:
    """The first view of components, without a share of the least certain, and the sensor's paths (S, 3)."""
    solid = surfaces(components, hidden=hidden)
    found = frame_of(solid.means, paths)
    if components.dim == 2:
        return found
    chosen = components.selected(solid.rows.to(components.means.device))
    seen_from = first_viewpoints(chosen).cpu()
    _, top = cut_away(chosen.means.cpu(), chosen.covariances.cpu(), seen_from, SOUTH_WEST)
    return found._replace(open_height=top)


def frame_of(places: Tensor, paths: Sequence[Tensor]) -> Frame:
    """The first view of places (K, 3) of a map and the sensor's paths (S, 3); it has no ceiling."""
    path = torch.cat([places[:0].double(), *paths])
    corners = robust_bounds(places, path, margin=0.5)
    low, high = torch.tensor(corners, dtype=torch.float64)
    far = max(float(low.abs().max()), float(high.abs().max())) > _FAR
    shift = ((low + high) / 2).round() if far else torch.zeros(3, dtype=torch.float64)
    distance = 0.65 * float((high - low).norm())
    height = float(path[:, 2].median()) if len(path) else float(low[2] + high[2]) / 2
    return Frame(low, high, shift, distance, height, math.inf)


def occupancy_slice(shown: GaussianMap, resolution: float, height: float, view: Frame) -> Slice:
    """The occupancy of cells of a side (m), in 3D at a height (m), in the box of a view."""

    def answer(points: Tensor) -> Tensor:
        return shown.occupancy(points, resolution)  # type: ignore[return-value]

    low, high = (tuple(corner[: shown.dim].tolist()) for corner in (view.low, view.high))
    image = slice_image(MapPanel("", answer, resolution, low, high), height, _SLICE_PIXELS)
    theta = image.image.numpy()
    pixels = np.round(255 * occupancy_colours()(np.ma.masked_invalid(theta))).astype(np.uint8)
    if shown.dim == 3:
        pixels[..., 3] = np.where(theta < 0.5, _FREE_ALPHA, _OCCUPIED_ALPHA)
        pixels[np.isnan(theta)] = 0
    left, right, bottom, top = image.extent
    place = [(left + right) / 2, (bottom + top) / 2, height if shown.dim == 3 else _UNDERNEATH]
    middle = torch.tensor(place, dtype=torch.float64)
    return Slice(np.flipud(pixels.transpose(1, 0, 2)).copy(), middle, (right - left, top - bottom))


def first_hit(solid: Solid, origin: Tensor, direction: Tensor) -> float:
    """Distance along a ray to the first 2σ ellipsoid that it enters; inf if it meets none. origin (3,),
    metres; direction (3,): of any length, in whose multiples the distance is."""
    if len(solid.means) == 0:
        return float("inf")
    precision = torch.linalg.inv(solid.covariances)
    offset = origin - solid.means
    along = torch.einsum("i,kij,j->k", direction, precision, direction)
    mixed = torch.einsum("ki,kij,j->k", offset, precision, direction)
    inside = torch.einsum("ki,kij,kj->k", offset, precision, offset) - N_SIGMA**2
    root = mixed.square() - along * inside
    enter = (-mixed - root.clamp_min(0).sqrt()) / along
    met = (root >= 0) & (enter > 0)
    return float(torch.where(met, enter, torch.inf).min())


def place_at(shown: GaussianMap, position: Tensor, resolution: float) -> tuple[float, float, float]:
    """What the map knows about the cube of a side (m) around a position (D,): θ, hits and misses."""
    corner = (position - resolution / 2).tolist()
    evidence = shown.evidence(VoxelGrid(tuple(corner), resolution, (1,) * len(corner)))
    theta = torch.as_tensor(shown.occupancy(position[None], resolution))
    return float(theta[0]), float(evidence.hits.sum()), float(evidence.misses.sum())


def place_text(shown: GaussianMap, position: Tensor, resolution: float) -> str:
    """A table of what the map knows about the cube of a side (m) around a position (D,), in Markdown."""
    theta, hits, misses = place_at(shown, position, resolution)
    where = ", ".join(f"{value:.2f}" for value in position.tolist())
    kind = "unknown" if hits + misses < 0.01 else "free" if theta < 0.5 else "occupied"
    return (
        f"**{kind}** at ({where}) m\n\n"
        f"| | |\n|---|---|\n| occupancy θ | {theta:.3f} |\n| hits | {hits:.3g} |\n"
        f"| misses | {misses:.3g} |\n| cell | {resolution:g} m |"
    )


_MESH_COLOUR, _BACKGROUND = (205, 205, 210), (240, 242, 245)
_OPACITY, _WIDER = 1.0, 1.3  # of a splat; 1.3 times as wide, the splats of a surface leave no gaps
_N_SHADES = 9  # of a legend
_LAMPS = ((-0.5, -0.8, 1.0), (0.9, 0.4, 0.5))
_UNSHADED = {"cast_shadow": False, "receive_shadow": False}
_BODY = 0.2  # m, radius of the ball that is a robot
_FRUSTUM = 0.8  # m, depth of a frustum
_AHEAD_WIDTH, _FRUSTUM_WIDTH = 2.0, 2.0  # pixels
_MOVED = 0.02  # share of the distance: a camera that is farther from its place was moved by its user
_GROWN = 0.08  # share of the distance by which the scene grows or moves before the cameras follow


def add_lights(scene: Any, distance: float) -> None:
    """A grey background, light from everywhere, and two lamps: colours stay as saturated as they are.

    distance: of the lamps, in tenths, metres.
    """
    scene.set_background_image(np.full((2, 2, 3), _BACKGROUND, np.uint8), format="png")
    scene.configure_environment_map(None)
    scene.configure_default_lights(enabled=False)
    scene.add_light_ambient("/lights/everywhere", intensity=0.7)
    for name, place, strength in zip(("key", "fill"), _LAMPS, (1.0, 0.4), strict=True):
        scene.add_light_directional(
            f"/lights/{name}",
            intensity=strength,
            cast_shadow=False,
            position=tuple(10 * distance * np.array(place)),
        )


def parts(components: Components, solid: Solid) -> dict[str, np.ndarray]:
    """The rows of `solid` in parts of components that a robot learned together, by name."""
    ids = components.ids.cpu()[solid.rows]
    keys = torch.stack([ids[:, 0], ids[:, 1] // _PART], 1)
    found, number = torch.unique(keys, dim=0, return_inverse=True)
    rows = torch.argsort(number, stable=True).split(torch.bincount(number).tolist())
    return {
        "components/{}-{}".format(*key): part.numpy() for key, part in zip(found.tolist(), rows, strict=True)
    }


Arrays = tuple[np.ndarray, ...]
"""Of each component that is drawn."""


def ellipsoids(solid: Solid, colours: Colours) -> Arrays:
    """What `add_ellipsoids` draws: quaternions, places and scales of 2σ ellipsoids, and their colours."""
    return (*(part.astype(np.float32) for part in instances(solid)), colours.rgb)


def add_ellipsoids(scene: Any, name: str, arrays: Arrays, n_all: int) -> Any:
    """Components in the scene's frame as ellipsoids; n_all: the number of all of them."""
    wxyz, positions, scales, rgb = arrays
    vertices, faces = unit_sphere(next(n for most, n in _SPHERES if n_all <= most))
    return scene.add_batched_meshes_simple(
        name,
        vertices.float().numpy(),
        faces.numpy().astype(np.uint32),
        wxyz,
        positions,
        batched_scales=scales,
        batched_colors=rgb,
        lod="off",
        **_UNSHADED,
    )


def splats(solid: Solid, colours: Colours) -> Arrays:
    """What viser draws as Gaussian splats: places, covariances, colours and opacity. Light falls on them,
    except on colours of a camera, which have the light of the place."""
    opacity = np.full((len(solid.means), 1), _OPACITY, np.float32)
    means, covariances = solid.means.float().numpy(), _WIDER**2 * solid.covariances.float().numpy()
    shades = colours.rgb
    if colours.ends or colours.legend:
        normal = principal_axes(solid.covariances)[1][:, :, 0]
        lamps = torch.nn.functional.normalize(normal.new_tensor(_LAMPS), dim=1)
        light = 0.5 + (normal @ lamps.T).abs() @ normal.new_tensor([0.45, 0.2])
        shades = (shades * light.clamp_max(1)[:, None].numpy()).astype(np.uint8)
    return means, covariances, shades, opacity


def add_mesh(scene: Any, mesh: TriangleMesh, shift: Tensor) -> Any:
    """A mesh of surfaces in world metres; shift (3,): the origin of the scene's frame."""
    return scene.add_mesh_simple(
        "/components",
        (mesh.vertices.cpu() - shift).float().numpy(),
        mesh.faces.cpu().numpy().astype(np.uint32),
        color=_MESH_COLOUR,
        side="double",
        **_UNSHADED,
    )


def add_cells(scene: Any, centres: np.ndarray, side: float, colours: np.ndarray) -> Any:
    """Cubes of a side (m) at centres (C, 3) in the scene's frame, with colours (C, 3) uint8."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
    faces = np.array(
        [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)], np.uint32
    )
    return scene.add_batched_meshes_simple(
        "/components",
        corners * (side / 2),
        np.concatenate([faces[:, :3], faces[:, [0, 2, 3]]]),
        np.tile(np.array([1, 0, 0, 0], np.float32), (len(centres), 1)),
        centres.astype(np.float32),
        batched_colors=colours,
        flat_shading=True,
        lod="off",
        **_UNSHADED,
    )


def add_slice(scene: Any, picture: Slice, shift: Tensor) -> Any:
    """A slice of occupancy; shift (3,): the origin of the scene's frame, metres."""
    return scene.add_image(
        "/slice",
        picture.pixels,
        *picture.size,
        format="png",
        wxyz=(0.0, 1.0, 0.0, 0.0),  # an image's own y points down
        position=tuple((picture.middle - shift).tolist()),
        **_UNSHADED,
    )


class RobotNodes:
    """A robot in the scene: a ball with its number, the frustum of its camera, and the path ahead of it.

    Args:
        number: its id. colour: RGB, 0 to 255.
        camera: horizontal and vertical field of view, rad; None: axes are drawn.
    """

    def __init__(
        self, scene: Any, number: int, colour: tuple[int, int, int], camera: tuple[float, float] | None
    ) -> None:
        self._scene, self._name, self._colour = scene, f"/robots/{number}", colour
        self._frame = scene.add_frame(self._name, show_axes=camera is None, axes_length=1.0, axes_radius=0.04)
        scene.add_icosphere(f"{self._name}/body", _BODY, colour, **_UNSHADED)
        if camera is not None:
            across, up = (math.tan(angle / 2) for angle in camera)
            scene.add_camera_frustum(
                f"{self._name}/camera",
                2 * math.atan(up),
                across / up,
                scale=_FRUSTUM,
                thickness=_FRUSTUM_WIDTH,
                thickness_units="screen",
                color=colour,
                **_UNSHADED,
            )
        scene.add_label(f"{self._name}/label", str(number), position=(0.0, 0.0, -2 * _BODY))
        self._ahead: Any = None

    def place(self, wxyz: np.ndarray, position: np.ndarray, ahead: np.ndarray) -> None:
        """Moves the robot to a pose in the scene's frame; ahead (S, 3): the positions that it flies to."""
        self._frame.wxyz, self._frame.position = wxyz, position
        if len(ahead) > 1:
            self._ahead = self._scene.add_line_segments(
                f"{self._name}-ahead",
                np.stack([ahead[:-1], ahead[1:]], 1).astype(np.float32),
                self._colour,
                thickness=_AHEAD_WIDTH,
                thickness_units="screen",
            )
        elif self._ahead is not None:
            self._ahead.remove()
            self._ahead = None


class FollowingCamera:
    """Keeps the cameras of a viser server's clients on a scene that grows.

    New clients begin with the last place. A client whose user has moved the camera keeps it; "reset view" of
    the page shows the whole scene.
    """

    def __init__(self, server: Any) -> None:
        self._server = server
        self._look_at, self._position = np.zeros(3), np.zeros(3)

    def show(self, look_at: np.ndarray, position: np.ndarray) -> None:
        """Looks at a point (3,) from a place (3,), in the scene's frame, metres."""
        before, distance = self._position, float(np.linalg.norm(position - look_at))
        moved = max(np.linalg.norm(position - before), np.linalg.norm(look_at - self._look_at))
        if moved <= _GROWN * distance:
            return
        reach = _MOVED * float(np.linalg.norm(before - self._look_at))
        self._look_at, self._position = look_at, position
        self._server.initial_camera.look_at = tuple(look_at)
        self._server.initial_camera.position = tuple(position)
        for client in self._server.get_clients().values():
            if np.linalg.norm(client.camera.position - before) <= reach:
                with client.atomic():
                    client.camera.position = position
                    client.camera.look_at = look_at
