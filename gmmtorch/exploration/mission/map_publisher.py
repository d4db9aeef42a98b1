"""MapPublisher: keeps the records of a robot equal to its own map."""

from __future__ import annotations

import torch

from gmmtorch.mapping.codec.component_batch import quantized
from gmmtorch.mapping.components import Components
from gmmtorch.sharing.replica.component_table import fingerprints
from gmmtorch.sharing.replica.replica import Replica


class MapPublisher:
    """Publishes a map that grows and changes.

    `Replica.add` does this for a map of one session. This class identifies components by their content, so
    it also continues after an earlier session of the robot was killed: components that were published
    before, and are still in the map, stay and are not sent again. Nothing else may add components to the
    replica.
    """

    def __init__(self, replica: Replica) -> None:
        self._replica = replica
        self._published: dict[int, bytes] = {}  # content by sequence number, of this session's records

    def update(self, components: Components, is_whole: bool) -> None:
        """Publishes what is new in a map; supersedes what this session published and the map no longer has.

        is_whole: the map has everything that earlier sessions published; what it lacks of that is superseded,
            too.
        """
        components = Components(**{name: value.detach().cpu() for name, value in vars(components).items()})
        earlier = self._of_earlier_sessions()
        # Records by content. The last are used first, so this session's own.
        available: dict[bytes, list[int]] = {}
        for sequence, content in [*earlier.items(), *self._published.items()]:
            available.setdefault(content, []).append(sequence)
        contents = fingerprints(quantized(components))
        kept, new = {}, []
        for row, content in enumerate(contents):
            if available.get(content):
                kept[available[content].pop()] = content
            else:
                new.append(row)
        left = {sequence for sequences in available.values() for sequence in sequences}
        gone = left if is_whole else left & self._published.keys()
        self._published = kept
        if new or gone:
            old = torch.tensor(
                [[self._replica.robot, sequence] for sequence in sorted(gone)], dtype=torch.int64
            )
            ids = self._replica.add(components.selected(torch.tensor(new, dtype=torch.int64)), old)
            self._published.update(zip(ids[:, 1].tolist(), (contents[row] for row in new), strict=True))

    def _of_earlier_sessions(self) -> dict[int, bytes]:
        """The live records of this robot that this session has not published. Forgets published records that
        are no longer live."""
        held = self._replica.components()
        rows = (held.ids[:, 0] == self._replica.robot).nonzero().squeeze(1)
        sequences = held.ids[rows, 1].tolist()
        live = set(sequences)
        self._published = {
            sequence: content for sequence, content in self._published.items() if sequence in live
        }
        other = [row for row, sequence in enumerate(sequences) if sequence not in self._published]
        found = held.selected(rows[torch.tensor(other, dtype=torch.int64)])
        return dict(zip(found.ids[:, 1].tolist(), fingerprints(found), strict=True))
