"""Novel beams against a loop; maps of voxels: what arrives is what is counted; the cache of values."""

from __future__ import annotations

import pytest
import torch
from exploration.mapped_room import heard
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gmmtorch.mapping import NoveltyRule, beam_novelty
from gmmtorch.occupancy import Box, CellEvidence, RollingWindow, cast_evidence
from gmmtorch.simulation.robot_camera import DepthCamera, DepthFrame
from gmmtorch.team.exploration.mission.options import TeamOptions
from gmmtorch.team.exploration.robot.mapper import GridMapper, Memo, novel_beams
from gmmtorch.team.exploration.world.scoring import BeliefMap, BeliefRule
from gmmtorch.team.sharing import PointsMessage, decode
from gmmtorch.team.sharing.broadcast import MOST_INTERVALS
from gmmtorch.team.sharing.messages.mission_messages import POINTS_PER_DATAGRAM, encode_points

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


def beams_of_a_frame(width: int, height: int, seed: int, missing: float) -> DepthFrame:
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
    local, seen = random_window(width), beams_of_a_frame(width, height, height, missing)
    found = novel_beams(local, seen, width, RULE, WITHIN, short, side)
    assert found.dtype == torch.bool
    assert found.tolist() == novel_by_a_loop(local, seen, width, short, side)


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


WIDTH = 24
BOX = Box(torch.tensor([-20, -20, -10]), torch.tensor([20, 20, 10]))
MIDDLE = torch.zeros(3, dtype=torch.float64)
NOVELTY = NoveltyRule(resolution=0.2, observed=0.5)


def mapper(robot: int = 0, shared: bool = True, shape: tuple[int, int, int] = (40, 40, 20)) -> GridMapper:
    local = RollingWindow(0.2, shape, 4)
    belief = BeliefMap(0.2, BOX, torch.ones(BOX.shape, dtype=torch.bool), BeliefRule())
    framework = "grid_shared" if shared else "grid_isolated"
    team = TeamOptions(framework=framework, size=31, camera=DepthCamera(width=WIDTH), novelty=NOVELTY)
    one = GridMapper(robot, local, belief, team, Memo(64))
    one.center_on(MIDDLE)
    return one


def frame(seed: int, n: int = 400, origin: Tensor = MIDDLE) -> DepthFrame:
    """Beams all about; where they end is a number of float32, from the origin."""
    generator = torch.Generator().manual_seed(seed)
    way = 1.2 * torch.randn(n, 3, generator=generator)
    return DepthFrame(
        origin, origin + way.double(), torch.rand(n, generator=generator) < 0.7, torch.arange(n)
    )


def dense_of(parts: list[tuple[Tensor, Tensor, Tensor]], box: Box = BOX) -> Tensor:
    """Evidence (2, nx, ny, nz) of beams (origin, ends, is_hit), cast part by part."""
    both = torch.zeros(2, *box.shape)
    for origin, ends, is_hit in parts:
        evidence = cast_evidence(origin, ends, is_hit, 0.2, box)
        at = (evidence.cells - box.low).unbind(1)
        both[0][at] += evidence.hits
        both[1][at] += evidence.misses
    return both


def in_window(parts: list[tuple[Tensor, Tensor, Tensor]], one: GridMapper) -> Tensor:
    """What the window should hold of it: no more than the belief, which ends at its box."""
    sides = [torch.arange(a, b) for a, b in zip(*map(Tensor.tolist, one.local.box), strict=True)]
    cells = torch.stack(torch.meshgrid(*sides, indexing="ij"), -1)
    bounds = one.belief.grid.box
    return dense_of(parts, one.local.box) * ((cells >= bounds.low) & (cells < bounds.high)).all(-1)


def beams(*frames: DepthFrame) -> list[tuple[Tensor, Tensor, Tensor]]:
    return [(f.origin, f.ends, f.is_hit) for f in frames]


def believed(one: GridMapper) -> Tensor:
    return torch.stack(one.belief.grid.dense(BOX))


def said(view: DepthFrame, sender: int = 1, number: int = 0) -> list[bytes]:
    return encode_points(sender, number, view.origin, view.ends, view.is_hit)


# -- one's own frames ---------------------------------------------------------------------------------


def test_own_frames_count_in_full() -> None:
    for shared in (False, True):
        one = mapper(shared=shared)
        views = [frame(seed) for seed in range(4)]
        sensed = [one.sense(view) for view in views]
        torch.testing.assert_close(believed(one), dense_of(beams(*views)))
        torch.testing.assert_close(torch.stack(one.local.evidence()), in_window(beams(*views), one))
        assert bool(sensed[0].novel.all())
        total = sum(float(p.hits.sum() + p.misses.sum()) for s in sensed for p in s.evidence)
        assert total == float(torch.stack(one.belief.grid.dense(one.belief.grid.box)).sum())


def test_only_novel_beams_are_sent() -> None:
    one = mapper(robot=5)
    counts = []
    for number in range(12):
        view = frame(number % 2)
        sensed = one.sense(view)
        messages = [decode(datagram) for datagram in one.shared.datagrams()]
        ends = [m.ends for m in messages if isinstance(m, PointsMessage)]
        assert len(ends) == len(messages)
        for message in messages:
            assert isinstance(message, PointsMessage)
            assert (message.sender, message.frame) == (5, number)
        found = torch.cat([torch.zeros(0, 3, dtype=torch.float64), *ends])
        torch.testing.assert_close(found, view.ends[sensed.novel], rtol=0, atol=1e-6)
        counts.append(len(found))
    assert counts[0] == 400
    assert 0 < counts[2] < 400
    assert counts[-1] < counts[2] / 2
    torch.testing.assert_close(believed(one), dense_of(beams(*[frame(n % 2) for n in range(12)])))


def test_a_grid_frame_without_beams_sends_nothing() -> None:
    for shared in (False, True):
        one = mapper(shared=shared)
        sensed = one.sense(frame(0, n=0))
        assert one.shared.datagrams() == []
        assert sensed.novel.shape == (0,)
        assert float(believed(one).sum()) == 0


# -- what others say ------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=12)
@given(arrived=st.lists(st.integers(0, 9), unique=True, max_size=10), at_once=st.booleans())
def test_each_part_of_a_frame_counts_when_it_arrives(arrived: list[int], at_once: bool) -> None:
    views = [frame(seed, n=5 * POINTS_PER_DATAGRAM - 17) for seed in range(2)]
    datagrams = [data for number, view in enumerate(views) for data in said(view, number=number)]
    assert len(datagrams) == 10
    one = mapper()
    if at_once:
        one.receive(heard(*[datagrams[k] for k in arrived]))
    else:
        for k in arrived:
            one.receive(heard(datagrams[k]))
    parts = []
    for k in arrived:
        view, begin = views[k // 5], k % 5 * POINTS_PER_DATAGRAM
        part = slice(begin, begin + POINTS_PER_DATAGRAM)
        parts.append((view.origin, view.ends[part], view.is_hit[part]))
    torch.testing.assert_close(believed(one), dense_of(parts))
    torch.testing.assert_close(torch.stack(one.local.evidence()), in_window(parts, one))
    assert (float(believed(one).sum()) > 0) == bool(arrived)


def test_frames_of_two_robots_with_one_number_are_distinguished() -> None:
    far = torch.tensor([1.0, -0.6, 0.4], dtype=torch.float64)
    views = [frame(0, n=200), frame(1, n=200, origin=far)]
    one = mapper()
    one.receive(heard(*said(views[0], sender=1), *said(views[1], sender=2)))
    torch.testing.assert_close(believed(one), dense_of(beams(*views)))


def test_repeated_parts_count_once() -> None:
    view = frame(0, n=3 * POINTS_PER_DATAGRAM)
    first, second, third = said(view)
    one = mapper()
    assert one.receive(heard(first, first)) == [first]
    assert one.receive(heard(third, first, third)) == [third]
    one.receive(heard(second))
    one.receive(heard(second, sender=2))  # passed on by another
    torch.testing.assert_close(believed(one), dense_of(beams(view)))


def test_points_of_strangers_are_dropped_and_counted() -> None:
    one, view = mapper(robot=3), frame(0, n=5)
    for sender in (3, 31, 32, 65535):
        assert one.receive(heard(*said(view, sender=sender))) == []
    assert one.shared.refused == {"stranger": 4}
    assert float(believed(one).sum()) == 0
    assert one.receive(heard(*said(view, sender=30))) != []


def test_memory_is_bounded_for_invented_frame_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gmmtorch.team.sharing.broadcast.MOST_INTERVALS", 20)
    one, view = mapper(), frame(0, n=1)
    datagrams = [said(view, number=7 * k)[0] for k in range(60)]
    assert one.receive(heard(*datagrams)) == datagrams
    assert one.receive(heard(*said(view, number=3))) == []  # a gap that was closed
    assert one.receive(heard(*said(view, number=7 * 59 - 1))) != []  # and one that is open
    assert one.shared.refused == {"repeated": 1}
    assert MOST_INTERVALS > 3 * 1600  # three parts of each frame of a mission lost


# -- the window -----------------------------------------------------------------------------------------


def test_a_moving_window_equals_a_new_cast(generator: torch.Generator) -> None:
    one = mapper(shape=(12, 16, 10))
    position, views = MIDDLE, []
    for seed in range(12):
        step = 0.7 * torch.randn(3, generator=generator, dtype=torch.float64)
        position = (position + step).clamp(-1.8, 1.8)
        one.center_on(position)
        views.append(frame(seed, n=60, origin=position))
        if seed % 3:
            one.sense(views[-1])
        else:
            one.receive(heard(*said(views[-1], number=seed)))
        expected = in_window(beams(*views), one)
        torch.testing.assert_close(torch.stack(one.local.evidence()), expected)
    assert float(expected.sum()) > 100
