"""Transforms over time: against interpolation with quaternions by hand, and forgetting for live topics."""

from __future__ import annotations

import bisect
import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch

from gmmtorch.datasets.ros.transform_tree import TransformTree

Sample = tuple[int, np.ndarray, np.ndarray]


def message(parent: str, child: str, sample: Sample) -> dict[str, Any]:
    time, position, turn = sample
    transform = {"translation": dict(zip("xyz", position, strict=True))}
    transform["rotation"] = dict(zip("xyzw", turn, strict=True))
    header = {"frame_id": parent, "stamp": {"sec": time // 10**9, "nanosec": time % 10**9}}
    return {"transforms": [{"header": header, "child_frame_id": child, "transform": transform}]}


def random_samples(seed: int, n: int) -> list[Sample]:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.integers(1, 10**8, n)) + 10**9
    turns = rng.normal(size=(n, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return [(int(t), p, q) for t, p, q in zip(times, rng.normal(size=(n, 3)), turns, strict=True)]


def rotated(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    u, w = q[:3], q[3]
    return v + 2 * np.cross(u, np.cross(u, v) + w * v)


def by_hand(samples: list[Sample], time: int, point: np.ndarray) -> np.ndarray:
    """A point of the child in the parent, by spherical interpolation of quaternions (Shoemake 1985)."""
    after = bisect.bisect_left([t for t, _, _ in samples], time)
    (t0, p0, q0), (t1, p1, q1) = samples[after - 1], samples[after]
    share = (time - t0) / (t1 - t0)
    cosine = float(q0 @ q1)
    q1, cosine = (q1, cosine) if cosine >= 0 else (-q1, -cosine)
    angle = math.acos(min(cosine, 1.0))
    q = (math.sin((1 - share) * angle) * q0 + math.sin(share * angle) * q1) / math.sin(angle)
    return rotated(q, point) + p0 + share * (p1 - p0)


@pytest.mark.parametrize("keep", [None, 1000.0])
def test_a_chain_equals_interpolation_by_hand(keep):
    upper, lower = random_samples(0, 40), random_samples(1, 40)
    tree = TransformTree(keep)
    for sample in upper:
        tree.add(message("odom", "base", sample), static=False)
    for sample in lower:
        tree.add(message("base", "/lidar", sample), static=False)
    low, high = max(upper[0][0], lower[0][0]), min(upper[-1][0], lower[-1][0])
    times = np.random.default_rng(2).integers(low + 1, high, 60)
    poses = tree.lookup(tree.chain("lidar"), times, np.inf)
    assert poses.known.all()
    point = np.array([1.0, -2.0, 3.0])
    for time, matrix in zip(times.tolist(), poses.poses.matrix.numpy(), strict=True):
        expected = by_hand(upper, time, by_hand(lower, time, point))
        assert np.allclose(matrix[:3, :3] @ point + matrix[:3, 3], expected, atol=1e-9)


def test_a_growing_tree_answers_as_a_complete_one():
    """To the bit: a live map equals that of a recording."""
    samples = random_samples(3, 30)
    whole, growing = TransformTree(), TransformTree(keep=1000.0)
    for sample in samples:
        whole.add(message("odom", "base", sample), static=False)
    for before, sample in itertools.pairwise(samples):
        growing.add(message("odom", "base", before), static=False)
        time = np.array([(before[0] + sample[0]) // 2])
        assert not growing.lookup(["base", "odom"], time, np.inf).known[0]
        growing.add(message("odom", "base", sample), static=False)
        found = growing.lookup(["base", "odom"], time, np.inf)
        assert torch.equal(found.poses.matrix, whole.lookup(["base", "odom"], time, np.inf).poses.matrix)


def test_old_transforms_are_forgotten_and_memory_is_bounded():
    tree = TransformTree(keep=1.0)
    for i in range(5000):
        tree.add(
            message("odom", "base", (10**9 + i * 10**7, np.zeros(3), np.array([0, 0, 0, 1.0]))), static=False
        )
    times, numbers = tree._samples["base"]
    assert 100 <= len(times) <= 203
    assert len(numbers) == 7 * len(times)
    newest = times[-1]
    known = tree.lookup(["base", "odom"], np.array([newest - 10**9, newest - 10**10]), np.inf).known
    assert known.tolist() == [True, False]


def test_a_clock_that_is_set_back_starts_again():
    tree = TransformTree(keep=1.0)
    for time in (50 * 10**9, 51 * 10**9, 10**9, 10**9 + 10):
        tree.add(message("odom", "base", (time, np.ones(3), np.array([0, 0, 0, 1.0]))), static=False)
    assert list(tree._samples["base"][0]) == [10**9, 10**9 + 10]
