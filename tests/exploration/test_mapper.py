"""Novel beams, against a loop over blocks; and the cache of values."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gmmtorch.mapping.learning.novelty import beam_novelty
from gmmtorch.mapping.learning.rules import NoveltyRule
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.cell_evidence import CellEvidence
from gmmtorch.occupancy.voxels.rolling_window import RollingWindow
from gmmtorch.simulation.sensors.depth_camera import DepthFrame
from gmmtorch.team.exploration.robot.mapper import Memo, novel_beams

RULE = NoveltyRule(resolution=0.2, observed=0.5)
WITHIN = Box(torch.tensor([-7, -30, -5]), torch.tensor([9, 30, 6]))


def random_window(seed: int) -> RollingWindow:
    """A window with random evidence, of which some cells have none."""
    generator = torch.Generator().manual_seed(seed)
    local = RollingWindow(0.2, (24, 24, 16))
    local.center_on(torch.zeros(3, dtype=torch.float64))
    hits, misses = 40 * torch.rand(2, *local.shape, generator=generator)
    blank = torch.rand(local.shape, generator=generator) < 0.03
    local.add(
        CellEvidence.from_dense(local.box.low, hits.masked_fill(blank, 0), misses.masked_fill(blank, 0))
    )
    return local


def frame(width: int, height: int, seed: int, missing: float) -> DepthFrame:
    generator = torch.Generator().manual_seed(seed)
    pixel = (torch.rand(width * height, generator=generator) >= missing).nonzero().squeeze(1)
    ends = 1.5 * torch.randn(len(pixel), 3, generator=generator, dtype=torch.float64)
    is_hit = torch.rand(len(pixel), generator=generator) < 0.7
    origin = torch.tensor([0.05, 0.15, -0.1], dtype=torch.float64)
    return DepthFrame(origin, ends, is_hit, pixel)


def novel_by_a_loop(
    local: RollingWindow, seen: DepthFrame, width: int, short: float, side: int
) -> list[bool]:
    """Each beam gets the answer of the beam with the lowest pixel in its block."""
    speaker: dict[tuple[int, int], int] = {}
    for beam, pixel in enumerate(seen.pixel.tolist()):
        speaker.setdefault((pixel // width // side, pixel % width // side), beam)
    answers = []
    for pixel in seen.pixel.tolist():
        beam = speaker[(pixel // width // side, pixel % width // side)]
        bits, unobserved = beam_novelty(
            local, seen.origin, seen.ends[[beam]], seen.is_hit[[beam]], RULE, short=short, within=WITHIN
        )
        answers.append(bool(unobserved[0]) or float(bits[0]) >= RULE.threshold)
    return answers


@pytest.mark.parametrize(("short", "side"), [(0.0, 3), (0.5, 3), (0.5, 1)])
@pytest.mark.parametrize("missing", [0.0, 0.3, 0.9])
@pytest.mark.parametrize(("width", "height"), [(8, 6), (9, 7), (7, 1), (1, 9), (2, 2), (10, 11)])
def test_the_first_beam_of_a_block_decides_for_the_block(
    width: int, height: int, missing: float, short: float, side: int
) -> None:
    local, seen = random_window(width), frame(width, height, height, missing)
    found = novel_beams(local, seen, width, RULE, WITHIN, short, side)
    assert found.dtype == torch.bool
    assert found.tolist() == novel_by_a_loop(local, seen, width, short, side)


def test_a_frame_without_beams_has_no_novel_beams() -> None:
    empty = frame(8, 6, 0, 1.1)
    assert len(empty.pixel) == 0
    found = novel_beams(random_window(0), empty, 8, RULE, WITHIN)
    assert found.shape == (0,)
    assert found.dtype == torch.bool


def test_no_beam_is_novel_in_a_certain_map() -> None:
    local = RollingWindow(0.2, (48, 48, 48))
    local.center_on(torch.zeros(3, dtype=torch.float64))
    sides = torch.meshgrid(*[torch.arange(a, a + 48) for a in local.box.low.tolist()], indexing="ij")
    cells = torch.stack(sides, -1).reshape(-1, 3)
    assert bool(novel_beams(local, frame(8, 6, 1, 0.0), 8, RULE, WITHIN).all())
    local.add(CellEvidence(cells, torch.full((len(cells),), 1e4), torch.full((len(cells),), 1e4)))
    assert not bool(novel_beams(local, frame(8, 6, 1, 0.0), 8, RULE, WITHIN).any())


# -- memo -----------------------------------------------------------------------------------------


class Maker:
    """Records the computed values."""

    def __init__(self, memo: Memo) -> None:
        self.memo, self.made = memo, ""

    def __call__(self, keys: str) -> None:
        for key in keys:

            def make(key: str = key) -> Tensor:
                self.made += key
                return torch.tensor(ord(key))

            assert int(self.memo(key, make)) == ord(key)


@pytest.mark.parametrize(
    ("size", "asked", "made"),
    [
        (3, "aaabbbabab", "ab"),  # a stored value is not computed again
        (3, "abcabcabc", "abc"),  # as many as there is room for
        (2, "abcabcabc", "abcabcabc"),  # the least recently used goes
        (2, "abacab", "abcb"),  # asking counts as use
        (1, "abba", "aba"),
        (3, "abcadbacd", "abcdbcd"),
    ],
)
def test_memo_drops_the_least_recently_used_value(size: int, asked: str, made: str) -> None:
    maker = Maker(Memo(size))
    maker(asked)
    assert maker.made == made
