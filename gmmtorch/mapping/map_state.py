"""MapState: what a map remembers between scans, and learns from them; a torch module with a state dict."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Self

import torch
from torch import Tensor

from gmmtorch.arrays import DeviceModule
from gmmtorch.errors import DAMAGED_CONTENT, DataError, GmmTorchError, InvalidArgumentError, check_whole
from gmmtorch.mapping.attributes.moments import Attributes
from gmmtorch.mapping.codec.component_batch import MapSettings, file_size
from gmmtorch.mapping.codec.quantization import number_after, numbered
from gmmtorch.mapping.components import TENSORS, Components
from gmmtorch.mapping.learning import windows
from gmmtorch.mapping.learning.fitting import DepthFrame, as_scans
from gmmtorch.mapping.learning.rules import LearningRule, WindowedRule, read_rule, rule_facts
from gmmtorch.mapping.query import Block, Query, in_blocks
from gmmtorch.mapping.query_options import QueryOptions
from gmmtorch.occupancy import Calibrator
from gmmtorch.scan import Scan

_PART = 5_000  # beams of a part of an unfinished window, at least
_LONGEST_WINDOW = 40  # scans, if no scan yet shows how many points it holds
_STATE = "_extra_state"  # torch's name of it in a state dict


class MapState(DeviceModule):
    """The final components of a map, the pending scans of its unfinished window, and its settings.

    Components are in blocks. If the rule keeps components, the end of a window changes the last block only,
    so its cost does not depend on the size of the map; otherwise there is one block.

    The fields of `Components` are attributes: those of all components, not rounded.

    Args:
        learning: how scans become components.
        settings: what the map's file states.
        random_state: seed. Every window has its own generator, so previews do not change later windows.

    Attributes:
        learning: the rule, with the options that the first windows determined.
        resolution, method, codec, robot, query_options: the settings.
    """

    def __init__(self, learning: LearningRule, settings: MapSettings, random_state: int) -> None:
        super().__init__()
        self.resolution, self.method, self.codec = settings.resolution, settings.method, settings.codec
        self.robot, self._query_options = settings.robot, settings.query
        known = settings.query.calibration
        self._calibrator = None if known is None else Calibrator.continued(known, len(windows.SIDES))
        self.learning = learning
        self._random_state = random_state
        self._blocks: list[Block] = []  # the final components
        self._pending: list[Scan] = []
        self._n_windows = 0
        self._next_number = 0  # of the next new component
        self._doubts = windows.Doubts.none()  # of the final components
        self._next_doubts = self._doubts  # after the pending scans
        self._learned: tuple[Components, int] | None = None  # the last block with those of pending scans
        self._fitted: LearningRule | None = None  # the rule after the pending scans
        self._parts: dict[tuple[int, int], Components] = {}  # learned from these pending scans
        self._all_rounded: Components | None = None
        self._rounded: list[tuple[Components, Components]] = []  # of each block, and rounded
        self._query: Query | None = None
        self._is_stale = False  # the query is of earlier components
        self._is_asked = False  # there was a query since the last scan

    def __getattr__(self, name: str) -> Any:
        if name not in TENSORS:
            return super().__getattr__(name)
        if self.dim is None:
            raise AttributeError(f"{name}: the map is empty; insert a scan first.")
        return getattr(self.unrounded(), name)

    @property
    def dim(self) -> int | None:
        """2 or 3; None while the map is empty."""
        return self._blocks[0].components.dim if self._blocks else None

    @property
    def _device(self) -> torch.device | None:
        return self._blocks[0].components.means.device if self._blocks else None

    @property
    def n_final(self) -> int:
        """Number of components without those of the unfinished window, which is not learned for it."""
        return sum(len(block.components) for block in self._blocks)

    @property
    def n_pending(self) -> int:
        """Number of scans of the unfinished window. If it is 0, all components are final."""
        return len(self._pending)

    @property
    def query_options(self) -> QueryOptions:
        """How queries are answered, with the calibration that the map has learned."""
        if self._calibrator is None or self._query_options.prior is not None:
            return self._query_options
        return replace(self._query_options, calibration=self._calibrator.calibration)

    @property
    def predictions(self) -> dict[float, Tensor]:
        """What the map predicted and then saw: a tally (15, 6) for each side (m) of cubes that it predicted,
        as in `occupancy.calibrator.Calibrator`."""
        if self._calibrator is None:
            return {}
        return {
            side: tally
            for side, tally in zip(windows.SIDES, self._calibrator.tally, strict=True)
            if float(tally[:, 0].sum())
        }

    @property
    def settings(self) -> MapSettings:
        """What the map's file states about it, besides the components and the learning rule."""
        options = self.resolution, self.method, self.codec, self.robot, self.query_options
        return MapSettings(*options, self._next_doubts.time)

    def _final(self) -> Components:
        """The components without those of the unfinished window, not rounded."""
        return Components.concatenate([*self._parts_before, self._last])

    @property
    def _last(self) -> Components:
        """The components of the last block, not rounded."""
        if not self._blocks:
            raise InvalidArgumentError("The map is empty; insert a scan first.")
        return self._blocks[-1].components

    @property
    def _parts_before(self) -> list[Components]:
        """The components of the other blocks, not rounded."""
        return [block.components for block in self._blocks[:-1]]

    def unrounded(self) -> Components:
        """All components, not rounded."""
        return Components.concatenate([*self._parts_before, self._upcoming()[0]])

    def _upcoming(self) -> tuple[Components, int]:
        """The last block with the components of the unfinished window, not rounded; and the number of the
        next new one after them."""
        if not self._pending:
            return self._last, self._next_number
        if self._learned is None:
            self._learned = self._absorbed(self._pending, self._next_rule)
            self._is_stale = True  # the query may be of parts of the window
        return self._learned

    def _window_parts(self) -> list[Components] | None:
        """The components of the unfinished window for a query, learned from some scans at a time, so that a
        scan makes the next query learn from few beams. None: the window is learned as a whole, if it is small
        or already learned."""
        sizes = [scan.n_beams for scan in self._pending]
        if self._learned is not None or sum(sizes) <= _PART or not windows.learns_in_parts(self.learning):
            return None
        found, begin, size = {}, 0, 0
        for end, n_beams in enumerate(sizes, 1):
            size += n_beams
            if size >= _PART or end == len(sizes):
                rule, scans = self.learning.fitted(self._pending[:end]), self._pending[begin:end]
                known = self._parts.get((begin, end))
                found[begin, end] = known or windows.learn_part(scans, rule, self._generator())
                begin, size = end, 0
        self._parts = found
        return list(found.values())

    @property
    def _next_rule(self) -> LearningRule:
        """The rule after the unfinished window."""
        if self._fitted is None:
            self._fitted = windows.with_law(self.learning.fitted(self._pending), self._pending)
        return self._fitted

    def _generator(self) -> torch.Generator:
        """Random numbers for the unfinished window."""
        return torch.Generator().manual_seed(hash((self._random_state, self._n_windows)) % 2**63)

    def _absorbed(
        self,
        scans: Iterable[Scan | DepthFrame],
        rule: LearningRule,
        weight: float = 1.0,
        before: windows.BeforeWindow | None = None,
    ) -> tuple[Components, int]:
        """`_upcoming`, with the components of scans, or of frames whose points each stand for `weight`.

        before: is called with each window before it is learned, see `absorb`.
        """
        known = self._last
        if isinstance(rule, WindowedRule):
            window = as_scans(scans)
            new = windows.learn_window(window, rule, self._generator())
            learned, self._next_doubts = windows.joined(known, new, window, rule, self._doubts)
        else:
            size = partial(file_size, rule=rule, settings=self.settings, next_number=self._next_number)
            options = rule, size, weight, self._doubts, before
            learned, self._next_doubts = windows.absorb(known, scans, *options)
        made, next_number = numbered(learned, self.robot, self._next_number)
        return made.to(known.means.device), next_number

    def _add(self, scan: Scan) -> None:
        """Adds a scan to the window, and makes the window final once it is full.

        A scan that cannot be learned from is removed again.
        """
        self._forget()
        self._pending.append(scan)
        if len(self._pending) < (self.learning.fitted(self._pending).window or _LONGEST_WINDOW):
            return
        try:
            learned = self._upcoming()
        except GmmTorchError:
            self._pending.pop()
            raise
        self._calibrator = self._predicted(self._blocks, self._pending, self._calibrator, self._n_windows)
        self._commit(*learned)

    def _predicted(
        self,
        known: Sequence[Block],
        window: Sequence[Scan | DepthFrame],
        calibrator: Calibrator | None,
        number: int,
    ) -> Calibrator | None:
        """`predicted`, unless probabilities follow from counts."""
        if self._query_options.prior is not None:
            return None
        return windows.predicted(known, window, calibrator, number)

    def _prepare(self, dim: int, device: torch.device, what: str) -> None:
        """Gives an empty map its dimension. Raises if the map has another one."""
        if self.dim is None:
            self._set(Components.empty(dim, device))
        elif dim != self.dim:
            raise InvalidArgumentError(f"{what} {dim}-dimensional, but the map is {self.dim}-dimensional.")

    def _commit(self, components: Components, next_number: int | None = None) -> None:
        """Ends the unfinished window: replaces the last block, or all components.

        `next_number`: of the next new component after those of the last block; None: all are replaced, and it
        is the one after all ids.
        """
        self.learning = self._next_rule
        self._doubts = self._next_doubts
        self._n_windows += bool(self._pending)
        self._pending, self._parts = [], {}
        before = [] if next_number is None else self._blocks[:-1]
        self._next_number = next_number or number_after(components.ids, self._next_number)
        self._set(components, before)

    def _set(self, components: Components, before: Sequence[Block] = ()) -> None:
        """Replaces all components by those of the blocks `before`, and these."""
        parts = in_blocks(components) if windows.keeps_components(self.learning) else [components]
        self._blocks = [*before, *map(Block, parts)]
        self._forget()

    def _forget(self) -> None:
        """Drops what was computed from the components. The query keeps what the next one can use."""
        self._learned, self._all_rounded, self._is_stale, self._fitted = None, None, True, None

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Moves the map and its pending scans between devices."""
        super()._apply(fn, recurse)
        if self._blocks:
            device = fn(self._last.means[:0]).device
            self._blocks = [Block(block.components.to(device)) for block in self._blocks]
            self._pending = [scan.to(device) for scan in self._pending]
        self._parts = {}
        self._query, self._rounded = None, []  # are on the former device
        self._forget()
        return self

    def _save_to_state_dict(self, destination: dict[str, Any], prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        if self._blocks:
            destination.update({prefix + name: value for name, value in self._final().tensors().items()})

    def get_extra_state(self) -> dict[str, Any]:
        """The learning rule, the pending scans and the counters, as part of `state_dict`."""
        return {
            "learning": rule_facts(self.learning),
            "pending": [dict(vars(scan)) for scan in self._pending],
            "attributes": self._final().attributes.tensors() if self._blocks else {},
            "n_windows": self._n_windows,
            "n_numbered": self._next_number,
            "doubts": dict(vars(self._doubts)),
            "calibrator": None if self._calibrator is None else dict(vars(self._calibrator)),
        }

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
        missing = [name for name in TENSORS if name not in own]
        if strict:
            unexpected_keys += [prefix + name for name in own if name not in TENSORS]
        if missing and (state is None or len(missing) < len(TENSORS)):
            missing_keys += [prefix + name for name in missing]
            return
        try:
            extra = {} if state is None else _read_extra(state)
            components = None
            if not missing:
                known = Attributes.of((state or {}).get("attributes", {}))
                components = Components(**{name: own[name] for name in TENSORS}, attributes=known).checked()
        except (GmmTorchError, *DAMAGED_CONTENT) as error:
            raise DataError(f"The state of the map is damaged ({error}).") from error
        device = self._device
        self._blocks, self._pending, self._parts = [], [], {}
        vars(self).update(extra)
        if components is not None:
            self._set(components.changed(lambda value: value.detach().clone().to(device)))
            self._next_number = number_after(components.ids, self._next_number)
            self._pending = [scan.to(self._device) for scan in self._pending]
        self._forget()


def _read_extra(state: dict[str, Any]) -> dict[str, Any]:
    """The attributes of a map with this extra state. Raises an error of any kind if it is damaged."""
    doubts = windows.Doubts.read(state["doubts"]) if "doubts" in state else windows.Doubts.none()
    return {
        "learning": read_rule(**state["learning"]),
        "_pending": [Scan(**scan) for scan in state["pending"]],
        "_n_windows": check_whole("n_windows", state["n_windows"], 0),
        "_next_number": check_whole("n_numbered", state["n_numbered"], 0),
        "_doubts": doubts,
        "_next_doubts": doubts,
        "_calibrator": Calibrator.restored(state["calibrator"]) if state.get("calibrator") else None,
    }
