"""Learner: the part of a map that is not final yet. It collects scans until their window is full."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import torch

from gmmtorch.errors import GmmTorchError, check_whole
from gmmtorch.mapping.codec.component_batch import numbered
from gmmtorch.mapping.codec.map_file import FileSize, MapSettings, number_after
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.depth_frame import DepthFrame
from gmmtorch.mapping.learning.forgetting import Doubts, Forgetting
from gmmtorch.mapping.learning.rules import LearningRule, read_rule, rule_facts
from gmmtorch.scan import Scan

_LONGEST_WINDOW = 40  # scans, if no scan yet shows how many points it holds


class Learner:
    """Learns components from windows of scans, and numbers them. The map keeps the components.

    Args:
        rule: how scans become components. Attribute `rule` has the options that its first scans determine.
        random_state: seed; every window has its own generator, so previews do not change later windows.
    """

    def __init__(self, rule: LearningRule, random_state: int) -> None:
        self.rule = rule
        self.pending: list[Scan] = []
        self.n_windows = 0
        self.next_number = 0
        self.doubts = Doubts.none()
        self._next_doubts = self.doubts  # after the pending scans, as the last preview found them
        self._random_state = random_state

    def add(self, known: Components, scan: Scan, settings: MapSettings) -> Components | None:
        """Adds a scan. Returns the components of the map once the window is full, otherwise None.

        A scan that cannot be learned from is removed again.
        """
        self.pending.append(scan)
        if len(self.pending) < (self.rule.fitted(self.pending).window or _LONGEST_WINDOW):
            return None
        try:
            learned = self.preview(known, settings)
        except GmmTorchError:
            self.pending.pop()
            raise
        self.commit(learned)
        return learned

    def preview(self, known: Components, settings: MapSettings) -> Components:
        """All components, with those of the unfinished window. Changes nothing."""
        if not self.pending:
            return known
        return self._absorb(known, self.pending, self.rule.fitted(self.pending), settings, 1.0)

    def absorb(
        self, known: Components, scans: Iterable[DepthFrame], settings: MapSettings, weight: float
    ) -> Components:
        """All components, with those of frames. Each point of a frame stands for `weight` points.

        There must be no unfinished window, and the rule must be fitted.
        """
        learned = self._absorb(known, scans, self.rule, settings, weight)
        self.commit(learned)
        return learned

    def commit(self, learned: Components) -> None:
        """Makes these components final, with all pending scans."""
        self.rule = self.rule.fitted(self.pending)
        self.doubts = self._next_doubts
        self.n_windows += bool(self.pending)
        self.pending = []
        self.next_number = number_after(learned.ids, self.next_number)

    def _absorb(
        self,
        known: Components,
        scans: Iterable[Scan | DepthFrame],
        rule: LearningRule,
        settings: MapSettings,
        weight: float,
    ) -> Components:
        generator = torch.Generator().manual_seed(hash((self._random_state, self.n_windows)) % 2**63)
        size = FileSize(rule, settings, self.next_number)
        forgetting = Forgetting(rule, self.doubts)
        learned = rule.absorb(known, scans, generator, size, weight, forgetting)
        self._next_doubts = forgetting.doubts
        return numbered(learned, settings.robot, self.next_number)

    @property
    def time(self) -> float | None:
        """Of the last scan (s), in a map with a half-life; None otherwise."""
        return self._next_doubts.time

    def resume(self, next_number: int, time: float | None) -> None:
        """Continues from a file, which holds no doubts."""
        self.next_number = next_number
        self.doubts = self._next_doubts = replace(Doubts.none(), time=time)

    def state(self) -> dict[str, Any]:
        """All that learning continues from: plain values, and the tensors of the pending scans."""
        return {
            "learning": rule_facts(self.rule),
            "pending": [dict(vars(scan)) for scan in self.pending],
            "n_windows": self.n_windows,
            "n_numbered": self.next_number,
            "doubts": dict(vars(self.doubts)),
        }

    def restored(self, state: dict[str, Any]) -> Learner:
        """A learner that continues from a state. Raises an error of any kind if the state is damaged."""
        made = Learner(read_rule(**state["learning"]), self._random_state)
        made.pending = [Scan(**scan) for scan in state["pending"]]
        made.n_windows = check_whole("n_windows", state["n_windows"], 0)
        made.next_number = check_whole("n_numbered", state["n_numbered"], 0)
        made.doubts = made._next_doubts = Doubts.read(state["doubts"]) if "doubts" in state else Doubts.none()
        return made
