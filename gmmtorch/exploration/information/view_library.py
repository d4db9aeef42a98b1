"""View library: far views worth going to, known to the whole team as a set (thesis 4.3)."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.exploration.robot.local_map import LocalMap
from gmmtorch.sharing.messages.message_registry import MAX_BYTES, Message, ViewsMessage, quantized_poses
from gmmtorch.sharing.replica.record_keys import first_key, robot_of
from gmmtorch.sharing.view_set import ViewSet

Id = tuple[int, int]
"""(robot that found it, its number there), as of records: `gmmtorch.sharing.replica.record_keys`."""

_HARDLY = 0.2  # of a value
_AHEAD = 1.0  # seconds that clocks of a team are apart where they are one


class Candidates(NamedTuple):
    """Views that may be gone to: ids, poses (V, 4), values (V,)."""

    ids: list[Id]
    poses: Tensor
    values: Tensor


class ViewLibrary:
    """A set of views that a team shares, whatever its network loses: `gmmtorch.sharing.view_set.ViewSet`.

    Each id holds its latest view, or is removed, for good. What is stored is what messages carry:
    poses to the centimetre, values as float16, stamps in milliseconds; so all replicas hold the same.

    Args:
        robot: whose it is; names the views added here.
        spacing: metres, and turn: radians: a view nearer than both to another is not added.
        size: most views of this robot's own; the least valuable go.
        incarnation: of this life of the robot. Where a robot may start again without its last state, each
            life needs another (`record_ids.drawn_incarnation`), so that no id is given twice.
    """

    def __init__(
        self,
        robot: int,
        spacing: float = 1.5,
        turn: float = math.pi / 4,
        size: int = 256,
        *,
        incarnation: int = 0,
    ) -> None:
        for name, value in (("spacing", spacing), ("turn", turn)):
            if not 0 <= value < math.inf:
                raise InvalidArgumentError(f"{name}={value} must be finite, at least zero.")
        self._set = ViewSet(robot, incarnation=incarnation)
        self._robot = robot
        self._size = check_whole("size", size, 1)
        self.spacing, self.turn = spacing, turn
        # When a value was last found here; or heard, if it is of a clock that this one is far behind.
        self._checked: dict[Id, float] = {}
        self._cached: tuple[int, Candidates] | None = None

    def __len__(self) -> int:
        return len(self._set.views)

    def candidates(self) -> Candidates:
        """All views, by id."""
        if self._cached is None or self._cached[0] != self.version:
            keys = sorted(self._set.views)
            ids = [_id(key) for key in keys]
            views = [self._set.views[key] for key in keys]
            poses = torch.tensor([view.pose for view in views], dtype=torch.float64).reshape(-1, 4)
            values = torch.tensor([view.value for view in views], dtype=torch.float64)
            self._cached = self.version, Candidates(ids, poses, values)
            self._checked = {key: self._checked[key] for key in ids if key in self._checked}
        return self._cached[1]

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
            near = torch.cat([near, rows[row][None]])
            added.append(_id(self._set.add(rows[row], worth[row], now)))
        views = self._set.views
        own = sorted((view.value, key) for key, view in views.items() if robot_of(key) == self._robot)
        self._set.remove(key for _, key in own[: max(0, len(own) - self._size)])
        return [key for key in added if _key(key) in views]

    def revalue(self, ids: list[Id], values: Tensor, now: float, least: float) -> None:
        """Give views their values of now; those worth less than `least` are removed.

        A value that has hardly changed is not told: it would cost a message and change no plan.
        """
        for name, value in zip(ids, values.tolist(), strict=True):
            known = self._set.views.get(_key(name))
            if value < least:
                self.remove([name], now)
            elif known is not None:
                self._checked[name] = now
                if abs(value - known.value) > _HARDLY * known.value:
                    self._set.revalue(_key(name), value, now)

    def remove(self, ids: list[Id], now: float) -> None:
        """Views that are not worth going to, ever again."""
        self._set.remove(_key(name) for name in ids)

    def visit(self, poses: Tensor, now: float, reach: float = 0.8, turn: float = math.pi / 5) -> None:
        """Remove the views that a robot has looked from, near enough, at poses (N, 4)."""
        known = self.candidates()
        if known.ids:
            seen = _is_near(poses[:, None], known.poses, reach, turn).any(0)
            self.remove([known.ids[row] for row in seen.nonzero()[:, 0].tolist()], now)

    def covered(self, local_map: LocalMap, now: float, most: int, age: float = 10.0) -> list[Id]:
        """Views in the window not valued for `age` seconds, the longest first, `most` at most."""
        known = self.candidates()
        if not known.ids:
            return []
        inside = local_map.is_passable(known.poses[:, :3]).tolist()
        views = self._set.views
        seen = ((self._checked.get(name, views[_key(name)].stamp), name) for name in known.ids)
        due = sorted(pair for pair, there in zip(seen, inside, strict=True) if there and pair[0] <= now - age)
        return [key for _, key in due[:most]]

    def best(self, metres: Tensor, *, least: float = 0.0) -> int | None:
        """Row of `candidates` of argmax value/(1 + metres to it), metres (V,); None if none is in reach."""
        known = self.candidates()
        score = torch.where(known.values >= least, known.values / (1 + metres), 0.0)
        if not len(score) or not float(score.max()) > 0:
            return None
        return int(score.argmax())

    # -- the team ---------------------------------------------------------------------------------

    @property
    def version(self) -> int:
        """Rises with every change."""
        return self._set.version

    @property
    def differs(self) -> bool:
        """Whether a teammate, when last heard, held other views."""
        return self._set.differs

    def digest(self) -> bytes:
        """8 bytes: equal for equal libraries."""
        return self._set.digest()

    def datagrams(self, max_bytes: int = MAX_BYTES, budget: int | None = None) -> list[bytes]:
        """What has changed here, and what others lack: as `ViewSet.datagrams`."""
        return self._set.datagrams(max_bytes, budget)

    def announcements(self, max_bytes: int = MAX_BYTES) -> list[bytes]:
        """What is held here, for others to send what is missing: as `ViewSet.announcements`."""
        return self._set.announcements(max_bytes)

    def receive(self, message: Message, now: float = math.inf) -> bool:
        """Merge what others say, as `ViewSet.receive`; heard at `now` (s).

        Stamps are of the clocks of others, which count from their own starts: those far ahead of `now` would
        pass for fresh until this clock has come to them. What they say is as old as the hearing of it.
        """
        ids = message.ids.tolist() if isinstance(message, ViewsMessage) else []
        before = {(robot, number): self._set.views.get(_key((robot, number))) for robot, number in ids}
        is_taken = self._set.receive(message)
        for name, old in before.items():
            view = self._set.views.get(_key(name))
            if view is not None and view != old and view.stamp > now + _AHEAD:
                self._checked[name] = now
        return is_taken

    # -- keeping ----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        alive = set(self.candidates().ids)
        checked = [[*name, when] for name, when in sorted(self._checked.items()) if name in alive]
        return {"set": self._set.state(), "checked": checked}

    def restore(self, state: dict[str, Any]) -> None:
        """Raises `DataError` for a state that is damaged, or another robot's."""
        self._set.restore(state["set"])
        self._cached = None
        self._checked = {(int(r), int(n)): float(when) for r, n, when in state["checked"]}


def _key(name: Id) -> int:
    return first_key(name[0]) + name[1]


def _id(key: int) -> Id:
    robot = robot_of(key)
    return robot, key - first_key(robot)


def _is_near(one: Tensor, others: Tensor, spacing: float, turn: float) -> Tensor:
    """Which of poses (…, 4) are nearer than `spacing` metres and `turn` radians."""
    apart = (one[..., :3] - others[..., :3]).norm(dim=-1)
    angle = torch.remainder(one[..., 3] - others[..., 3] + math.pi, 2 * math.pi) - math.pi
    return (apart < spacing) & (angle.abs() < turn)
