"""MapPublisher: which of a robot's records stand for its own map."""

from __future__ import annotations

import torch

from gmmtorch.mapping.codec.component_batch import quantized
from gmmtorch.mapping.components import Components
from gmmtorch.sharing.replica.component_table import fingerprints
from gmmtorch.sharing.replica.replica import Replica


class MapPublisher:
    """Keeps what a replica holds of its robot equal to a map that grows and changes.

    `Replica.add` does so for a map of one life. Here components are known by what they say, so it goes on
    where another life of the robot was cut off, whatever it had said by then: what the map still has stays,
    and is not said again. Nobody else may add components to the replica.
    """

    def __init__(self, replica: Replica) -> None:
        self._replica = replica
        self._said: dict[int, bytes] = {}  # sequences of records that stand for the map, and what they say

    def update(self, components: Components, whole: bool) -> None:
        """Say what is new in a map, in place of what this has said and the map no longer has.

        whole: the map has all that earlier lives have said, too: what it does not have of that, goes.
        """
        components = Components(**{name: value.detach().cpu() for name, value in vars(components).items()})
        theirs = self._of_earlier_lives()
        spare: dict[bytes, list[int]] = {}
        for sequence, print_ in [*theirs.items(), *self._said.items()]:  # the latter are taken first
            spare.setdefault(print_, []).append(sequence)
        prints = fingerprints(quantized(components))
        kept, fresh = {}, []
        for row, print_ in enumerate(prints):
            if spare.get(print_):
                kept[spare[print_].pop()] = print_
            else:
                fresh.append(row)
        left = {sequence for sequences in spare.values() for sequence in sequences}
        gone = left if whole else left & self._said.keys()
        self._said = kept
        if fresh or gone:
            old = torch.tensor(
                [[self._replica.robot, sequence] for sequence in sorted(gone)], dtype=torch.int64
            )
            ids = self._replica.add(components.selected(torch.tensor(fresh, dtype=torch.int64)), old)
            self._said.update(zip(ids[:, 1].tolist(), (prints[row] for row in fresh), strict=True))

    def _of_earlier_lives(self) -> dict[int, bytes]:
        """Records of this robot that count, and that this has not said; and of the others it forgets those
        that do not."""
        held = self._replica.components()
        rows = (held.ids[:, 0] == self._replica.robot).nonzero().squeeze(1)
        sequences = held.ids[rows, 1].tolist()
        alive = set(sequences)
        self._said = {sequence: print_ for sequence, print_ in self._said.items() if sequence in alive}
        strange = [row for row, sequence in enumerate(sequences) if sequence not in self._said]
        found = held.selected(rows[torch.tensor(strange, dtype=torch.int64)])
        return dict(zip(found.ids[:, 1].tolist(), fingerprints(found), strict=True))
