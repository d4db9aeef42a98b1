"""The contract of baselines with a safetensors file, which also refuses damaged content."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest
from occupancy.protocol_contract import OccupancyMapContract, open_scan, wall_scan
from torch import Tensor

from gmmtorch.errors import DataError
from gmmtorch.files import pack_tensors, read_tensors
from gmmtorch.occupancy.protocol import TensorFileMap

Damage = dict[str, list[Callable[[Tensor], Tensor]]]
"""Changes of a tensor's values, by the name of the tensor, after which the file is refused."""


def check_damaged_files_are_refused(
    made: TensorFileMap, folder: Path, damage: Damage, settings: list[dict[str, Any]]
) -> None:
    """Check that files with missing, cut and changed tensors, and with these settings, are refused."""
    path = folder / "map.safetensors"
    made.save(path)
    tensors, facts = read_tensors(path, made.file_kind, 1)
    changes = [(name, change(tensors[name])) for name in damage for change in damage[name]]
    changes += [(name, value[:-1]) for name, value in tensors.items()]
    contents = [({**tensors, name: value}, facts) for name, value in changes]
    contents += [({name: tensors[name] for name in tensors.keys() - {missing}}, facts) for missing in tensors]
    contents += [(tensors, {**facts, **wrong}) for wrong in [{"dim": 4}, {"dim": 1}, {"dim": [2]}, *settings]]
    for wrong_tensors, wrong_facts in contents:
        path.write_bytes(pack_tensors(wrong_tensors, made.file_kind, 1, **wrong_facts))
        with pytest.raises(DataError, match=r"map\.safetensors"):
            type(made).load(path)


class TensorFileContract(OccupancyMapContract):
    """Inherit as from `OccupancyMapContract`."""

    damage: ClassVar[Damage] = {}
    damaged_settings: ClassVar[list[dict[str, Any]]] = []

    def test_files_with_damaged_tensors_or_settings_are_refused(self, tmp_path):
        made = self.built(wall_scan(2), open_scan(2))
        check_damaged_files_are_refused(made, tmp_path, self.damage, self.damaged_settings)
