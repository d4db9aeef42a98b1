"""FollowingCamera: the cameras of all browsers show the whole scene until their users move them."""

from __future__ import annotations

from typing import Any

import numpy as np

_MOVED = 0.02  # share of the distance: a camera that is farther from its place was moved by its user
_GROWN = 0.08  # share of the distance by which the scene grows or moves before the cameras follow


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
