"""What a viser server shows: lights, components, robots, and the cameras of its clients."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from torch import Tensor

from gmmtorch.export import TriangleMesh
from gmmtorch.live import viewer_scene
from gmmtorch.live.viewer_scene import Slice, Solid

_MESH_COLOUR, _BACKGROUND = (205, 205, 210), (240, 242, 245)
_OPACITY = 0.9  # of a splat
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
    for name, place, strength in (("key", (-0.5, -0.8, 1.0), 1.0), ("fill", (0.9, 0.4, 0.5), 0.4)):
        scene.add_light_directional(
            f"/lights/{name}",
            intensity=strength,
            cast_shadow=False,
            position=tuple(10 * distance * np.array(place)),
        )


def add_ellipsoids(scene: Any, solid: Solid, colours: np.ndarray) -> Any:
    """Components in the scene's frame as 2σ ellipsoids with colours (K, 3) uint8."""
    balls = viewer_scene.instances(solid)
    vertices, faces = viewer_scene.sphere(len(colours))
    return scene.add_batched_meshes_simple(
        "/components",
        vertices.float().numpy(),
        faces.numpy().astype(np.uint32),
        balls.wxyz.astype(np.float32),
        balls.positions.astype(np.float32),
        batched_scales=balls.scales.astype(np.float32),
        batched_colors=colours,
        lod="off",
        **_UNSHADED,
    )


def add_splats(scene: Any, solid: Solid, colours: np.ndarray) -> Any:
    """Components in the scene's frame as Gaussian splats with colours (K, 3) uint8."""
    opacity = np.full((len(colours), 1), _OPACITY, np.float32)
    means, covariances = solid.means.float().numpy(), solid.covariances.float().numpy()
    return scene.add_gaussian_splats("/components", means, covariances, colours, opacity)


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
