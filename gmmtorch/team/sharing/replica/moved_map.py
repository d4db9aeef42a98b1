"""MovedMap: how corrected poses have moved a robot's map since its components were learned."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.mapping import Components
from gmmtorch.team.sharing.replica.record_keys import Intervals, Ints, authors

_MOST_RUNS = 128
"""Intervals of keys in a correction, which then fits into a datagram."""


class MovedMap(NamedTuple):
    """How corrected poses have moved a map of K components.

    before: the components where they would be without corrections. scans (K,): the number of the scan, or of
    the window of scans, of each; −1: of none. motions: of each scan, from number 0 on, (D+1, D+1), from
    `before` to the map; the identity to the bit for those that were not corrected.
    """

    before: Components
    scans: Tensor
    motions: Sequence[Tensor]

    def corrected(self, keys: Ints, live: Ints, known: Collection[int]) -> dict[int, Intervals]:
        """The keys that the correction of each corrected scan moves.

        Intervals also contain keys of dead records, so that they are few. Keys beyond `_MOST_RUNS` intervals
        of a scan are set to −1: their components must be published again.

        Args:
            keys: (K,) of the components that were published where they were before; −1 for others.
            live: (L,) rising keys of all components of the robot.
            known: scans that have a correction already.
        """
        scans = np.full(len(live), -1)
        scans[np.searchsorted(live, keys[keys >= 0])] = self.scans.cpu().numpy()[keys >= 0]
        is_first = np.ones(len(live), np.bool_)  # key of an interval of one scan and one author
        is_first[1:] = (scans[1:] != scans[:-1]) | (authors(live[1:]) != authors(live[:-1]))
        is_last = np.append(is_first[1:], True)[: len(live)]
        edges, scans = np.stack([live[is_first], live[is_last] + 1], 1), scans[is_first]
        found = {}
        for scan, motion in enumerate(self.motions):
            runs = edges[scans == scan]
            is_identity = torch.equal(motion, torch.eye(len(motion), dtype=motion.dtype))
            if scan in known or (len(runs) and not is_identity):
                found[scan] = Intervals(runs[:_MOST_RUNS].reshape(-1))
                for begin, end in runs[_MOST_RUNS:].tolist():
                    keys[(begin <= keys) & (keys < end)] = -1
        return found
