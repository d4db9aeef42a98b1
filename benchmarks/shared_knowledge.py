"""What a team knows for its bytes: mixtures beside octrees, count grids, Draco and range images.

    python benchmarks/shared_knowledge.py                      # three robots in the warehouse, 150 s
    python benchmarks/shared_knowledge.py --world tunnels      # in a mine
    python benchmarks/shared_knowledge.py --figure known.png   # the picture of the table, too
    python benchmarks/shared_knowledge.py --only replayed-lidar --data FOLDER   # with hall/ and street/

A mission of E0 is recorded. Then the robots fly the same paths again, once for each way to share. A robot
sends the beams that are novel to its map, and all robots, the sender too, learn only what the receivers of
its messages can. So novelty follows from what was sent, and all maps are equal. Plans and views are not sent.

An octree has the cells of the returns of a frame, and of the ends of its other beams; a receiver casts a ray
from the camera to the centre of each cell. Its bytes are those of zstd, or the entropy of its bits given
contexts: the place of the child, which cells beside it its parent's neighbours and earlier children occupy,
and the level. The chances are those of the whole mission, so an adaptive coder takes more. A count grid adds
the number of beams of each cell, as a power of two, at its entropy. Draco codes the same points at an RMS
error; a range image has every third or sixth pixel of a row and a column, in whole centimetres, with zstd.

Real lidar is replayed as two robots with half of a recording each, which send mixtures, or octrees of whole
scans or of the cells that neither has sent. A receiver has no more than what was sent, and is the best of
three: a grid of the octree's cells, of twice these, and a map that learns from their centres.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rate_distortion_figures import knowledge_figure
from torch import Tensor

from gmmtorch import GaussianMap, IncrementalRule
from gmmtorch.experiments.evaluation.queries import hit_and_free, split_indices, test_beams
from gmmtorch.experiments.harness import Case, Row, recording, run, score
from gmmtorch.mapping.codec.quantization import quantized
from gmmtorch.occupancy.occupancy_grid import OccupancyGrid
from gmmtorch.occupancy.protocol import OccupancyMap
from gmmtorch.report.style import save_figure
from gmmtorch.scan import Scan
from gmmtorch.simulation import DepthFrame
from gmmtorch.team.exploration.mission.mission import Mission
from gmmtorch.team.exploration.mission.options import FrameRule, TeamOptions, WorldOptions
from gmmtorch.team.exploration.mission.trials import Trial, assemble, run_mission
from gmmtorch.team.exploration.robot.agent import Agent
from gmmtorch.team.exploration.robot.mapper import FrameUpdate, GridMapper, novel_beams
from gmmtorch.team.exploration.world.scoring import accuracy
from gmmtorch.team.exploration.world.world import World
from gmmtorch.team.sharing import Replica
from gmmtorch.team.sharing.point_codecs import DepthImage, Draco, Octree, header, morton_codes

Ints = NDArray[np.int64]
_CHILDREN = np.arange(8)
Record = list[tuple[float, int, Tensor, DepthFrame]]
"""Time, robot, its state (7,), and its frame."""


class Points(ABC):
    """Counts the bytes of the beams of frames, and returns them as receivers decode them."""

    def __init__(self) -> None:
        self.n_bytes = 0.0

    @abstractmethod
    def send(self, ends: Tensor, pixel: Tensor) -> Tensor:
        """The decoded ends of some beams, which are all hits or all not; `pixel`: theirs."""

    def finish(self) -> dict[str, float]:
        """Bytes by the name of the code."""
        return {"": self.n_bytes}


class Cells(Points):
    """An octree with cells of `side` (m); with the number of beams of each cell, if `counts`."""

    def __init__(self, side: float, counts: bool) -> None:
        super().__init__()
        self.codec, self.counts = Octree(side), counts
        self.bits = np.zeros(2 * 4**3 * 32, np.int64)
        self.numbers: Counter[int] = Counter()
        self.headers = 0

    def send(self, ends: Tensor, pixel: Tensor) -> Tensor:
        data = self.codec.encode(ends)
        self.n_bytes += len(data)
        corner, codes, depth = morton_codes(ends, self.codec.resolution)
        self.headers += len(header(corner, depth))
        nodes, n_each = np.unique(codes, return_counts=True)
        self._count(nodes, depth)
        decoded = self.codec.decode(data)
        if not self.counts:
            return decoded
        powers = np.round(np.log2(n_each)).astype(np.int64)
        self.numbers.update(powers.tolist())
        order = np.argsort(morton_codes(decoded, self.codec.resolution)[1], kind="stable")
        return decoded[torch.from_numpy(order)].repeat_interleave(torch.from_numpy(1 << powers), 0)

    def _count(self, nodes: Ints, depth: int) -> None:
        """Counts the bits of the levels of an octree with these leaves, by context."""
        child = np.stack([_CHILDREN >> 2, _CHILDREN >> 1 & 1, _CHILDREN & 1], 1)
        for level in range(depth):
            parents = np.unique(nodes >> 3)
            known, cells = _keys(_places(parents)), _keys(_places(nodes))
            above = np.broadcast_to(_places(parents)[:, None], (len(parents), 8, 3))
            here = 2 * above + child
            context = np.broadcast_to(_CHILDREN * 4 + min(level, 3), here.shape[:2])
            for axis, unit in enumerate(np.eye(3, dtype=np.int64)):
                beside = np.isin(_keys(above + (2 * child[:, axis, None] - 1) * unit), known)
                earlier = np.isin(_keys(here - unit), cells) & (child[:, axis] == 1)
                context = context * 4 + beside * 2 + earlier
            bits = 2 * context + np.isin(_keys(here), cells)
            self.bits += np.bincount(bits.reshape(-1), minlength=len(self.bits))
            nodes = parents

    def finish(self) -> dict[str, float]:
        coded = self.headers + sum(map(_entropy, self.bits.reshape(-1, 2))) / 8
        if self.counts:
            return {"contexts": coded + _entropy(np.array([*self.numbers.values()])) / 8}
        return {"zstd": self.n_bytes, "contexts": coded}


class Thinned(Points):
    """All points, with Draco at this RMS error (m)."""

    def __init__(self, error: float) -> None:
        super().__init__()
        self.codec = Draco(error)

    def send(self, ends: Tensor, pixel: Tensor) -> Tensor:
        data = self.codec.encode(ends)
        self.n_bytes += len(data)
        return self.codec.decode(data)


class Ranges(Points):
    """A range image of every `stride`-th pixel of every `stride`-th row, in whole centimetres."""

    def __init__(self, stride: int, width: int, height: int) -> None:
        super().__init__()
        self.stride, self.width, self.height = stride, width, height
        self.codec = DepthImage(0.01)
        self.origin = torch.zeros(3)

    def send(self, ends: Tensor, pixel: Tensor) -> Tensor:
        row, column = pixel // self.width, pixel % self.width
        kept = (row % self.stride == 0) & (column % self.stride == 0)
        far = (ends - self.origin).norm(dim=1)
        shape = -(-self.height // self.stride), -(-self.width // self.stride)
        image = torch.zeros(shape, dtype=torch.float64)
        where = row[kept] // self.stride, column[kept] // self.stride
        image[where] = far[kept]
        data = self.codec.encode(image)
        self.n_bytes += len(data)
        ways = (ends[kept] - self.origin) / far[kept, None]
        return self.origin + ways * self.codec.decode(data)[where][:, None]


def _places(codes: Ints) -> Ints:
    """The cells (N, 3) of Morton codes (N,)."""
    found = np.zeros((len(codes), 3), np.int64)
    for bit in range(21):
        for axis in range(3):
            found[:, axis] |= (codes >> (3 * bit + 2 - axis) & 1) << bit
    return found


def _keys(cells: Ints) -> Ints:
    """A number for each cell (…, 3) from −1 to 2²⁰."""
    return ((cells[..., 0] + 1) << 42) + ((cells[..., 1] + 1) << 21) + cells[..., 2] + 1


def _entropy(numbers: Ints) -> float:
    """Bits of symbols that come this often."""
    n = numbers[numbers > 0].astype(np.float64)
    return float((n * np.log2(n.sum() / n)).sum())


def shares(points: Points, mapper: GridMapper) -> Callable[[DepthFrame], FrameUpdate]:
    """A `sense` for a map of cells that learns only what the receivers of `points` can."""

    def sense(frame: DepthFrame) -> FrameUpdate:
        box = mapper.belief.grid.box
        novel = novel_beams(mapper.local, frame, mapper._width, mapper._novelty, box)
        if isinstance(points, Ranges):
            points.origin = frame.origin
        parts = []
        for is_hit in (True, False):
            chosen = novel & (frame.is_hit == is_hit)
            if bool(chosen.any()):
                ends = points.send(frame.ends[chosen], frame.pixel[chosen])
                parts.append((ends, torch.full((len(ends),), is_hit)))
        if not parts:
            return FrameUpdate([], novel)
        ends, hits = (torch.cat(column) for column in zip(*parts, strict=True))
        decoded = DepthFrame(frame.origin, ends, hits, torch.arange(len(ends)))
        datagrams = mapper.shared.add(decoded, torch.ones_like(hits))
        evidence = [mapper._evidence_of(datagrams)] if datagrams else []
        for part in evidence:
            mapper._add(part)
        return FrameUpdate(evidence, novel)

    return sense


def recorded(world: World, place: WorldOptions, team: TeamOptions) -> Record:
    """The frames of a mission of E0."""
    record: Record = []
    learn = Agent.learn

    def noted(agent: Agent, frame: DepthFrame, now: float) -> FrameUpdate:
        thin = replace(frame, ends=frame.ends.float())
        record.append((now, agent.number, agent.robot.state.clone(), thin))
        return learn(agent, frame, now)

    Agent.learn = noted  # type: ignore[method-assign]
    try:
        run_mission(Trial(place, team), world)
    finally:
        Agent.learn = learn  # type: ignore[method-assign]
    return record


def replayed(mission: Mission, record: Record) -> None:
    """Lets the robots of a mission sense the recorded frames, and exchange their maps."""
    with torch.inference_mode():
        for now, rows in itertools.groupby(record, key=lambda row: row[0]):
            for _, number, state, frame in rows:
                agent = mission.agents[number]
                agent.robot.state = state
                agent.learn(replace(frame, ends=frame.ends.double()), now)
            for agent in mission.agents:
                agent.listen(now)
        for agent in mission.agents:
            agent.listen(now + 1.0)


def knowledge(world: World, mission: Mission) -> dict[str, float]:
    """What the first robot knows."""
    belief = mission.robots[0].mapper.belief
    cells = world.observable.nonzero() + world.box.low
    quality = accuracy(belief, cells, world.occupied[world.observable])
    return {
        "AUC": quality["auc"] or 0.0,
        "entropy taken away (kbit)": (belief.observable_bits - belief.entropy_bits) / 1e3,
        "cells observed": belief.n_observed / len(cells),
    }


def measure(options: Any) -> Iterator[Row]:
    rows = []
    for row in measured(options):
        rows.append(row)
        yield row
    if options.figure is not None:
        save_figure(knowledge_figure(rows), options.figure, dpi=100)


def measured(options: Any) -> Iterator[dict[str, Any]]:
    torch.set_num_threads(1)
    place = WorldOptions(name=options.world)
    team = TeamOptions(duration=options.duration, seed=options.seed)
    world = place.open(team)
    record = recorded(world, place, team)
    options.about = f"{options.world}, {team.size} robots, {options.duration:g} s, seed {options.seed}."
    for side in (0.1, 0.2, 0.3):
        mission = assemble(world, replace(team, frame=replace(FrameRule(), side=side)))
        replayed(mission, record)
        kinds = mission.network.bytes_by_kind
        size = sum(kinds.get(kind, 0) for kind in ("components", "counts", "supersessions"))
        yield {"shared": f"E0, `map.side={side}`", "kB": size / 1e3, **knowledge(world, mission)}
    camera = team.camera
    others: dict[str, Callable[[], Points]] = {
        **{f"octree, {side} m": lambda side=side: Cells(side, False) for side in (0.1, 0.2, 0.3)},
        "octree and counts, 0.2 m": lambda: Cells(0.2, True),
        "Draco, 0.1 m": lambda: Thinned(0.1),
        **{
            f"range image, 1/{stride}": lambda stride=stride: Ranges(stride, camera.width, camera.height)
            for stride in (3, 6)
        },
    }
    for name, make in others.items():
        mission, points = assemble(world, replace(team, framework="grid_shared")), make()
        for robot in mission.robots:
            assert isinstance(robot.mapper, GridMapper)
            robot.mapper.sense = shares(points, robot.mapper)  # type: ignore[method-assign]
        replayed(mission, record)
        known = knowledge(world, mission)
        for code, size in points.finish().items():
            yield {"shared": ", ".join(filter(None, (name, code))), "kB": size / 1e3, **known}


def replayed_lidar(options: Any) -> Iterator[Row]:
    """What two robots with halves of a recording know of each other's beams, held out, and for how much."""
    torch.set_num_threads(1)
    for name, share in (("hall", 1.0), ("street", 0.5)):
        data = recording(options.data, name)
        train, test = split_indices(int(share * len(data)), 5)
        asked = hit_and_free(*test_beams([data[i] for i in test], 50_000, 0), "uniform", _LIDAR_CELL, 0)
        scans, half = [data[i] for i in train], len(train) // 2
        turns = list(zip_longest(scans[:half], scans[half:]))
        size, known = _mixture_team(turns)
        yield {"data": name, "shared": "mixture", "kB": size / 1e3, "AUC": score(known, asked, _LIDAR_CELL)}
        for side, novel in itertools.product((0.1, 0.2), (False, True)):
            cells, sent = _octree_team(turns, side, novel)
            maps: list[OccupancyMap] = [
                OccupancyGrid(side),
                OccupancyGrid(2 * side),
                GaussianMap(IncrementalRule()),
            ]
            for built, scan in itertools.product(maps, sent):
                built.insert(scan)
            auc = max(score(built, asked, _LIDAR_CELL) for built in maps)
            what = f"octree, {side} m, {'new cells' if novel else 'whole scans'}, contexts"
            yield {"data": name, "shared": what, "kB": cells.finish()["contexts"] / 1e3, "AUC": auc}


def _mixture_team(turns: Sequence[tuple[Scan | None, ...]]) -> tuple[int, GaussianMap]:
    """Bytes of all records that the two robots send, rounded as exploring robots do; their map."""
    maps = [GaussianMap(IncrementalRule(), robot=robot) for robot in (0, 1)]
    team, size = [Replica(robot, incarnation=0) for robot in (0, 1)], 0
    for turn in [*turns, (None, None)]:
        is_over = turn == (None, None)
        for own, replica, scan in zip(maps, team, turn, strict=True):
            if scan is not None:
                own.insert(scan)
            if is_over:
                own.finish()
            if not own.n_pending and own.dim is not None:
                replica.publish(quantized(own.components(), coarse=True), whole=False)
        for sender, receiver in (team, team[::-1]):
            for datagram in sender.datagrams():
                size += len(datagram)
                assert receiver.receive(datagram)
    return size, team[0].map()


def _octree_team(
    turns: Sequence[tuple[Scan | None, ...]], side: float, novel: bool
) -> tuple[Cells, list[Scan]]:
    """The octrees of all scans, without the cells that were sent before if `novel`; what receivers decode."""
    cells, sent, known = Cells(side, False), [], np.zeros(0, np.int64)
    for scan in (scan for turn in turns for scan in turn if scan is not None):
        points = scan.points.double()
        keys = _keys((points / side).floor().long().numpy() + (1 << 19))
        new = ~np.isin(keys, known) if novel else np.ones(len(keys), np.bool_)
        known = np.union1d(known, keys)
        if new.any():
            sent.append(Scan(cells.send(points[torch.from_numpy(new)], torch.zeros(0)), scan.origin))
    return cells, sent


_LIDAR_CELL = 0.2  # metres, of the cells that are asked about
CASES = (
    Case(
        "shared-knowledge",
        measure,
        "Bytes of the map alone: no plans, views or announcements.",
        {"kB": ".0f", "AUC": ".4f", "entropy taken away (kbit)": ".0f", "cells observed": ".3f"},
        needs_data=False,
    ),
    Case(
        "replayed-lidar",
        replayed_lidar,
        "Every fifth scan is held out.",
        {"kB": ".1f", "AUC": ".4f"},
        ("hall", "street"),
        key=2,
    ),
)

if __name__ == "__main__":
    run(
        __doc__ or "",
        *CASES,
        world={"default": "warehouse", "choices": ("warehouse", "tunnels")},
        duration={"type": float, "default": 150.0},
        seed={"type": int, "default": 0},
        figure={"type": Path, "default": None},
    )
