"""MapState: what a map remembers between scans, as a torch module with a state dict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any, cast

import torch
from torch import Tensor, nn

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError
from gmmtorch.mapping.codec.map_file import MapSettings, number_after
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.learner import Learner
from gmmtorch.mapping.learning.rules import LearningRule
from gmmtorch.mapping.query import Query

_BUFFERS = tuple(f.name for f in fields(Components))
_STATE = "_extra_state"  # torch's name of it in a state dict


def _field(name: str, about: str) -> Any:
    """A property: a field of all components, not rounded, those of the unfinished window included."""

    def read(self: MapState) -> Tensor:
        if self.dim is None:
            raise AttributeError(name)  # `__getattr__` explains it
        return cast(Tensor, getattr(self._with_pending(), name))

    return property(read, doc=f"{about} Not rounded; with the components of the unfinished window.")


class MapState(nn.Module):
    """The final components of a map (buffers), its learner with the pending scans, and its settings.

    Args:
        learner: learns the scans of unfinished windows.
        settings: what the map's file states; the learner keeps the time.
    """

    means = _field("means", "(K, D) in metres.")
    covariances = _field("covariances", "(K, D, D) in m².")
    support = _field("support", "(K,) points that each component stands for.")
    max_range = _field("max_range", "(K,) bool: components of no-return beams.")
    ids = _field("ids", "(K, 2): robot, sequence number.")
    origins = _field("origins", "(S, D) sensor positions, metres.")
    seen_by = _field("seen_by", "(E,) the component of each viewpoint.")
    seen_from = _field("seen_from", "(E,) the origin of each viewpoint.")
    seen_count = _field("seen_count", "(E,) points of each viewpoint.")

    def __init__(self, learner: Learner, settings: MapSettings) -> None:
        super().__init__()
        self.resolution, self.method, self.codec = settings.resolution, settings.method, settings.codec
        self.robot, self.query_options = settings.robot, settings.query
        self._learner = learner
        self._learned: Components | None = None  # what follows from the buffers and the pending scans
        self._rounded: Components | None = None
        self._query: Query | None = None

    def __getattr__(self, name: str) -> Any:
        if name in _BUFFERS:
            raise AttributeError(f"{name}: the map is empty; insert a scan first.")
        return super().__getattr__(name)

    @property
    def dim(self) -> int | None:
        """2 or 3; None while the map is empty."""
        means = self._buffers.get("means")
        return None if means is None else means.shape[1]

    @property
    def _device(self) -> torch.device | None:
        means = self._buffers.get("means")
        return None if means is None else means.device

    @property
    def learning(self) -> LearningRule:
        """The learning rule, with the options that the first windows determined."""
        return self._learner.rule

    @property
    def n_final(self) -> int:
        """Number of components without those of the unfinished window, which is not learned for it."""
        return 0 if self.dim is None else len(self._final())

    @property
    def n_pending(self) -> int:
        """Number of scans of the unfinished window. If it is 0, all components are final."""
        return len(self._learner.pending)

    @property
    def settings(self) -> MapSettings:
        """What the map's file states about it, besides the components and the learning rule."""
        options = self.resolution, self.method, self.codec, self.robot, self.query_options
        return MapSettings(*options, self._learner.time)

    def _final(self) -> Components:
        """The components without those of the unfinished window, not rounded."""
        if self.dim is None:
            raise InvalidArgumentError("The map is empty; insert a scan first.")
        buffers = {name: self._buffers[name] for name in _BUFFERS}
        return Components(**{name: value for name, value in buffers.items() if value is not None})

    def _with_pending(self) -> Components:
        """All components, not rounded."""
        if self._learned is None:
            self._learned = self._learner.preview(self._final(), self.settings)
        return self._learned

    def _prepare(self, dim: int, device: torch.device, what: str) -> None:
        """Gives an empty map its dimension. Raises if the map has another one."""
        if self.dim is None:
            self._set(Components.empty(dim, device))
        elif dim != self.dim:
            raise InvalidArgumentError(f"{what} {dim}-dimensional, but the map is {self.dim}-dimensional.")

    def _commit(self, components: Components) -> None:
        """Replaces all components, those of the unfinished window included."""
        self._learner.commit(components)
        self._set(components)

    def _set(self, components: Components) -> None:
        for name in _BUFFERS:
            self._buffers[name] = getattr(components, name)  # properties have the names of the buffers
        self._forget()

    def _forget(self) -> None:
        """Drops what was computed from the components."""
        self._learned, self._rounded, self._query = None, None, None

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> MapState:
        """Moves the map and its pending scans between devices. Types stay: positions need float64."""
        super()._apply(lambda tensor: tensor.to(fn(tensor.new_empty(0)).device), recurse)
        if self.dim is not None:
            self._learner.pending = [scan.to(self._device) for scan in self._learner.pending]
        self._forget()
        return self

    def get_extra_state(self) -> dict[str, Any]:
        """The learning rule, the pending scans and the counters, as part of `state_dict`."""
        return self._learner.state()

    def _load_from_state_dict(
        self,
        state_dict: dict[str, Any],
        prefix: str,
        local_metadata: dict[str, Any],
        strict: bool,
        missing_keys: list[str],
        unexpected_keys: list[str],
        error_msgs: list[str],
    ) -> None:
        """Takes components of any number, also into an empty map. A state without the extra state gives a
        map whose components are all final. Raises `DataError` for a damaged state, and changes nothing."""
        own = {key.removeprefix(prefix): v for key, v in state_dict.items() if key.startswith(prefix)}
        state = own.pop(_STATE, None)
        missing = [name for name in _BUFFERS if name not in own]
        if strict:
            unexpected_keys += [prefix + name for name in own if name not in _BUFFERS]
        if missing and (state is None or len(missing) < len(_BUFFERS)):
            missing_keys += [prefix + name for name in missing]
            return
        try:
            learner = self._learner if state is None else self._learner.restored(state)
            components = None if missing else Components(**{name: own[name] for name in _BUFFERS}).checked()
        except (GmmTorchError, KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            raise DataError(f"The state of the map is damaged ({error}).") from error
        device = self._device
        for name in _BUFFERS:
            self._buffers.pop(name, None)
        self._learner = learner
        if state is None:
            learner.pending = []
        if components is not None:
            self._set(Components(**{n: v.detach().clone().to(device) for n, v in vars(components).items()}))
            learner.next_number = number_after(components.ids, learner.next_number)
        self._forget()
