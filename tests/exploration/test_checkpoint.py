"""Nested states come back as they were; what is not a checkpoint of this mission is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from gmmtorch.errors import DataError, MissingDataError
from gmmtorch.exploration.mission.checkpoint import load_checkpoint, save_checkpoint

STATE = {
    "tick": 7,
    "pace": 0.1 + 0.2,
    "none": None,
    "on": True,
    "robots": [{"path": torch.arange(6.0).view(2, 3), "plans": [[1, 2.5, torch.zeros(0, 4)]]}, {}],
    "flags": torch.tensor([True, False]),
    "generator": torch.Generator().manual_seed(3).get_state(),
}


def same(one: object, other: object) -> bool:
    if isinstance(one, torch.Tensor):
        return isinstance(other, torch.Tensor) and one.dtype == other.dtype and torch.equal(one, other)
    if isinstance(one, dict):
        return (
            isinstance(other, dict) and list(one) == list(other) and all(same(one[k], other[k]) for k in one)
        )
    if isinstance(one, list):
        return isinstance(other, list) and len(one) == len(other) and all(map(same, one, other))
    return type(one) is type(other) and one == other


def test_states_come_back(tmp_path: Path) -> None:
    path = save_checkpoint(tmp_path / "a.safetensors", STATE, seed=3)
    back = load_checkpoint(path, seed=3)
    assert dict.fromkeys(STATE, True) == {k: same(STATE[k], back[k]) for k in STATE}


def test_one_tensor_in_two_places(tmp_path: Path) -> None:
    both = torch.ones(3)
    back = load_checkpoint(save_checkpoint(tmp_path / "a.safetensors", {"a": both, "b": [both[1:]]}))
    assert torch.equal(back["a"], both)
    assert torch.equal(back["b"][0], both[1:])


def test_a_checkpoint_of_another_mission_is_refused(tmp_path: Path) -> None:
    path = save_checkpoint(tmp_path / "a.safetensors", STATE, seed=3, team="x")
    with pytest.raises(DataError, match=r"another mission .*seed"):
        load_checkpoint(path, seed=4, team="x")
    with pytest.raises(DataError, match="team"):
        load_checkpoint(path, seed=3)


@pytest.mark.parametrize("keep", [0, 5, 100, -1])
def test_a_cut_off_file_is_refused(tmp_path: Path, keep: int) -> None:
    path = save_checkpoint(tmp_path / "a.safetensors", STATE)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(DataError):
        load_checkpoint(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match=r"nowhere\.safetensors"):
        load_checkpoint(tmp_path / "nowhere.safetensors")
