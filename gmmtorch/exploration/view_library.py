"""View library: far views worth going to, known to the whole team as a set (thesis 4.3)."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.exploration.surroundings import Surroundings
from gmmtorch.sharing.messages import ViewsMessage, quantized_poses

Id = tuple[int, int]
"""(robot that found it, its number there)."""

_HARDLY = 0.2  # of a value
_LARGEST_VALUE = float(np.finfo(np.float16).max)


class View(NamedTuple):
    """stamp: seconds when the value was found; of two views of one id the greater tuple counts."""

    stamp: float
    value: float
    pose: tuple[float, float, float, float]


class Candidates(NamedTuple):
    """Views that may be gone to: ids, poses (V, 4), values (V,)."""

    ids: list[Id]
    poses: Tensor
    values: Tensor


class ViewLibrary:
    """A set of views that merges with others' whatever the order, and however often.

    Each id holds its latest view, or is removed, for good. What is stored is what messages carry:
    poses to the centimetre, values as float16, stamps in milliseconds; so all replicas hold the same.

    Args:
        robot: whose it is; names the views added here.
        spacing: metres, and turn: radians: a view nearer than both to another is not added.
        size: most views of this robot's own; the least valuable go.
    """

    def __init__(self, robot: int, spacing: float = 1.5, turn: float = math.pi / 4, size: int = 256) -> None:
        for name, value in (("spacing", spacing), ("turn", turn)):
            if not 0 <= value < math.inf:
                raise InvalidArgumentError(f"{name}={value} must be finite, at least zero.")
        self._robot = check_whole("robot", robot, 0)
        self._size = check_whole("size", size, 1)
        self.spacing, self.turn = spacing, turn
        self._views: dict[Id, View] = {}
        self._removed: dict[Id, float] = {}
        self._next = 0
        self._version = 0
        self._changed: dict[Id, int] = {}  # version of the last change made here
        self._taken = 0
        self._checked: dict[Id, float] = {}  # when a value was last found here
        self._cached: Candidates | None = None

    def __len__(self) -> int:
        return len(self._views)

    def candidates(self) -> Candidates:
        """All views, by id."""
        if self._cached is None:
            ids = sorted(self._views)
            views = [self._views[key] for key in ids]
            poses = torch.tensor([view.pose for view in views], dtype=torch.float64).reshape(-1, 4)
            values = torch.tensor([view.value for view in views], dtype=torch.float64)
            self._cached = Candidates(ids, poses, values)
        return self._cached

    # -- changes made here ------------------------------------------------------------------------

    def add(self, poses: Tensor, values: Tensor, now: float, least: float, most: int = 8) -> list[Id]:
        """Take in views (N, 4) worth at least `least`, best first, `most` at a time; returns their ids."""
        added: list[Id] = []
        rows, worth = quantized_poses(poses), values.detach().cpu().double().numpy()
        order = np.argsort(-worth, kind="stable")
        order = order[worth[order] >= max(least, 1e-6)]
        near = self.candidates().poses
        for row in order.tolist():
            if len(added) == most:
                break
            if bool(_is_near(rows[row], near, self.spacing, self.turn).any()):
                continue
            key = (self._robot, self._next)
            self._next += 1
            self._put(key, _view(rows[row], worth[row], now))
            near = torch.cat([near, rows[row][None]])
            added.append(key)
        own = sorted((view.value, key) for key, view in self._views.items() if key[0] == self._robot)
        for _, key in own[: max(0, len(own) - self._size)]:
            self.remove([key], now)
        return [key for key in added if key in self._views]

    def revalue(self, ids: list[Id], values: Tensor, now: float, least: float) -> None:
        """Give views their values of now; those worth less than `least` are removed.

        A value that has hardly changed is not told: it would cost a message and change no plan.
        """
        for key, value in zip(ids, values.tolist(), strict=True):
            known = self._views.get(key)
            if value < least:
                self.remove([key], now)
            elif known is not None:
                self._checked[key] = now
                if abs(value - known.value) > _HARDLY * known.value:
                    fresh = _view(torch.tensor(known.pose, dtype=torch.float64), value, now)
                    self._put(key, max(known, fresh))

    def remove(self, ids: list[Id], now: float) -> None:
        """Views that are not worth going to, ever again."""
        for key in ids:
            if key in self._views:
                del self._views[key]
                self._checked.pop(key, None)
                self._removed[key] = _milliseconds(now)
                self._change(key)

    def visit(self, poses: Tensor, now: float, reach: float = 0.8, turn: float = math.pi / 5) -> None:
        """Remove the views that a robot has looked from, near enough, at poses (N, 4)."""
        known = self.candidates()
        if known.ids:
            seen = _is_near(poses[:, None], known.poses, reach, turn).any(0)
            self.remove([known.ids[row] for row in seen.nonzero()[:, 0].tolist()], now)

    def covered(self, surroundings: Surroundings, now: float, most: int, age: float = 10.0) -> list[Id]:
        """Views in the window not valued for `age` seconds, the longest first, `most` at most."""
        known = self.candidates()
        if not known.ids:
            return []
        inside = surroundings.is_passable(known.poses[:, :3]).tolist()
        seen = ((self._checked.get(key, self._views[key].stamp), key) for key in known.ids)
        due = sorted(pair for pair, there in zip(seen, inside, strict=True) if there and pair[0] <= now - age)
        return [key for _, key in due[:most]]

    def best(self, metres: Tensor, *, least: float = 0.0) -> int | None:
        """Row of `candidates` of argmax value/(1 + metres to it), metres (V,); None if none is in reach."""
        known = self.candidates()
        score = torch.where(known.values >= least, known.values / (1 + metres), 0.0)
        if not len(score) or not float(score.max()) > 0:
            return None
        return int(score.argmax())

    def _put(self, key: Id, view: View) -> None:
        self._views[key] = view
        self._change(key)

    def _change(self, key: Id) -> None:
        self._version += 1
        self._changed[key] = self._version
        self._cached = None

    # -- the team ---------------------------------------------------------------------------------

    @property
    def version(self) -> int:
        """Rises with every change made here."""
        return self._version

    def changes_since(self, version: int) -> ViewsMessage:
        """What has been added, revalued or removed here since; what was merged is others' to tell."""
        return self._message([key for key, at in self._changed.items() if at > version])

    def take_changes(self) -> ViewsMessage:
        """What has changed here since the last call."""
        message = self.changes_since(self._taken)
        self._taken = self._version
        return message

    def everything(self) -> ViewsMessage:
        """The whole set, removed ids included."""
        return self._message([*self._views, *self._removed])

    def merge(self, message: ViewsMessage) -> None:
        """Take in others' views: of an id the later stamp counts, and what is removed stays so."""
        self._cached = None
        for (robot, number), stamp in zip(
            message.removed.tolist(), message.removed_stamps.tolist(), strict=True
        ):
            key = (robot, number)
            self._removed[key] = max(stamp, self._removed.get(key, stamp))
            self._views.pop(key, None)
            self._checked.pop(key, None)
        rows = (message.ids, message.stamps, message.values, message.poses)
        for (robot, number), stamp, value, pose in zip(*(row.tolist() for row in rows), strict=True):
            key, view = (robot, number), View(stamp, value, tuple(pose))
            if key not in self._removed:
                self._views[key] = max(view, self._views.get(key, view))

    def _message(self, ids: list[Id]) -> ViewsMessage:
        alive = sorted(key for key in ids if key in self._views)
        dead = sorted(key for key in ids if key in self._removed)
        views = [self._views[key] for key in alive]
        return ViewsMessage(
            ids=torch.tensor(alive, dtype=torch.int64).reshape(-1, 2),
            poses=torch.tensor([view.pose for view in views], dtype=torch.float64).reshape(-1, 4),
            values=torch.tensor([view.value for view in views], dtype=torch.float64),
            stamps=torch.tensor([view.stamp for view in views], dtype=torch.float64),
            removed=torch.tensor(dead, dtype=torch.int64).reshape(-1, 2),
            removed_stamps=torch.tensor([self._removed[key] for key in dead], dtype=torch.float64),
        )

    # -- keeping ----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        message = self.everything()
        changed = [[*key, version] for key, version in sorted(self._changed.items())]
        return {
            **{name: getattr(message, name) for name in ViewsMessage.__dataclass_fields__},
            "next": self._next,
            "version": self._version,
            "taken": self._taken,
            "checked": [[*key, when] for key, when in sorted(self._checked.items())],
            "changed": torch.tensor(changed, dtype=torch.int64).reshape(-1, 3),
        }

    def restore(self, state: dict[str, Any]) -> None:
        self._views, self._removed, self._cached = {}, {}, None
        self.merge(ViewsMessage(**{name: state[name] for name in ViewsMessage.__dataclass_fields__}))
        self._next, self._version = int(state["next"]), int(state["version"])
        self._taken = int(state["taken"])
        self._checked = {(int(r), int(n)): float(when) for r, n, when in state["checked"]}
        self._changed = {(r, n): version for r, n, version in state["changed"].tolist()}


def _view(pose: Tensor, value: float, now: float) -> View:
    x, y, z, yaw = pose.tolist()
    return View(_milliseconds(now), float(np.float16(min(value, _LARGEST_VALUE))), (x, y, z, yaw))


def _milliseconds(seconds: float) -> float:
    return round(seconds * 1000) / 1000


def _is_near(one: Tensor, others: Tensor, spacing: float, turn: float) -> Tensor:
    """Which of poses (…, 4) are nearer than `spacing` metres and `turn` radians."""
    apart = (one[..., :3] - others[..., :3]).norm(dim=-1)
    angle = torch.remainder(one[..., 3] - others[..., 3] + math.pi, 2 * math.pi) - math.pi
    return (apart < spacing) & (angle.abs() < turn)
