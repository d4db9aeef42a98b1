"""What sharing costs: bytes of every message, times of a replica, times of sealing and opening frames.

    OMP_NUM_THREADS=1 python benchmarks/sharing_costs.py [--repeats 5]

Needs no data: a simulated depth camera of 160 × 120 pixels walks through the embedded warehouse, and every
pixel is learned. Times are of the processor, the least of some repeats.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import torch
from frames import Frame, simulated
from torch import Tensor

from gmmtorch.experiments.harness import Case, Row, run
from gmmtorch.mapping.codec.quantization import quantized, spatial_order
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.fitting import fit_window
from gmmtorch.mapping.learning.merging import all_origins
from gmmtorch.team.exploration.mission.options import FrameRule
from gmmtorch.team.sharing.messages.component_messages import encode_components, encode_counts
from gmmtorch.team.sharing.messages.datagrams import CODECS, pose_of
from gmmtorch.team.sharing.messages.message_registry import decode
from gmmtorch.team.sharing.messages.mission_messages import (
    ViewsMessage,
    encode_plan,
    encode_points,
    encode_views,
    quantized_views,
)
from gmmtorch.team.sharing.messages.record_messages import (
    CorrectionMessage,
    SupersessionMessage,
    counters_message,
    encode_announcements,
    encode_record,
)
from gmmtorch.team.sharing.point_codecs import bytes_of_points
from gmmtorch.team.sharing.replica.record_keys import Intervals, first_key
from gmmtorch.team.sharing.replica.replica import Replica
from gmmtorch.team.sharing.transport.security import Opener, Sealer, TeamKey

N_FRAMES, N_HELD, PER_FRAME, INCARNATION = 6, 20_000, 70, 9_876_543


@cache
def learned() -> tuple[list[Frame], list[Components]]:
    """Frames, and the components of each."""
    logging.disable()  # of what is refused
    frames, rule = simulated()[:N_FRAMES], FrameRule()
    made = [fit_window([frame.scan], rule.surface_fit(), all_origins()) for frame in frames]
    return frames, [numbered(quantized(one, coarse=True)) for one in made]


def message_sizes(options: Any) -> Iterator[Row]:
    frames, made = learned()
    n_points = sum(len(frame.scan.points) for frame in frames)
    options.about = f"{N_FRAMES} frames, {sum(map(len, made)):,} components, {n_points:,} points."
    for content, n_bytes in (*frame_sizes(frames, made), *record_sizes()):
        yield str(content), str(n_bytes)


def replica_costs(options: Any) -> Iterator[Row]:
    frame = Components.concatenate(learned()[1]).selected(torch.arange(PER_FRAME))
    small, large = (replica_times(frame, n, options.repeats) for n in (40 * PER_FRAME, N_HELD))
    for name in small:
        yield name, small[name], large[name]


def frame_costs(options: Any) -> Iterator[Row]:
    yield from frame_times(options.repeats).items()


def numbered(components: Components) -> Components:
    """In spatial order, as a robot sends them."""
    ids = torch.stack([torch.zeros(len(components)), torch.arange(len(components))], 1).long()
    return replace(components.rearranged(spatial_order(components)), ids=ids)


def frame_sizes(frames: list[Frame], learned: list[Components]) -> list[list[object]]:
    """Bytes of what a frame is sent as, the mean over the frames."""
    n = sum(map(len, learned))
    rows: list[list[object]] = []
    for codec in CODECS:
        total = sum(len(datagram) for made in learned for datagram in encode_components(made, codec))
        rows.append([f"components, {codec}", f"{total / n:.1f} each; {total / len(frames):.0f} a frame"])
    points = [frame.scan.points for frame in frames]
    sent = [
        encode_points(1, i, frame.scan.origin, frame.scan.points, torch.ones(len(frame.scan.points)).bool())
        for i, frame in enumerate(frames)
    ]
    total = sum(len(datagram) for datagrams in sent for datagram in datagrams)
    rows.append(["points", f"{total / sum(map(len, points)):.1f} each; {total / len(frames):.0f} a frame"])
    for resolution, error in ((0.2, 0.1), (0.05, 0.025)):
        sizes = [bytes_of_points(frame.scan.points, resolution, error, frame.depth) for frame in frames]
        for name in sizes[0]:
            where = {"octree": f", {resolution:g} m", "quantized": f", {resolution:g} m"}
            where["draco"] = f", {error:g} m"
            if name in where or resolution == 0.2:
                mean = sum(size[name] for size in sizes) / len(sizes)
                rows.append([f"the same points: {name}{where.get(name, '')}", f"{mean:.0f} a frame"])
    return rows


def record_sizes() -> list[list[object]]:
    """Bytes of the other messages. Incarnations have as many digits as those that are drawn."""
    rows: list[list[object]] = []
    steps = [2.0 ** (i % 20) for i in range(50)]
    for name, ids in (
        ("5 components", [(0, 7 * i) for i in range(5)]),
        ("50 components of three robots", [(i % 3, 97 * (i // 3)) for i in range(50)]),
        ("50 components in a row", [(1, 400 + i) for i in range(50)]),
    ):
        counts = dict(zip(ids, steps, strict=False))
        sizes = ", ".join(f"{size(encode_counts(1, counts, codec))} ({codec})" for codec in CODECS)
        rows.append([f"counts of {name}", sizes])
    runs = [np.arange(400) + key(7, 1000 * i) for i in range(10)]
    one = span(0, 0, 5000)
    team = one
    for robot in range(1, 16):
        team = team | span(robot, 0, 5000)
    path = torch.stack(
        [torch.linspace(0, 3, 10)] * 2 + [torch.ones(10), torch.linspace(0, 1, 10)], 1
    ).double()
    gains = {key(4, 7 * i): points for i, points in enumerate(steps)}
    motion = CorrectionMessage(key(2, 9), 3, 1, span(2, 0, 10), pose_of(torch.eye(4)))
    merged = SupersessionMessage(key(2, 60), span(2, 0, 10), span(2, 30, 35))
    return [
        *rows,
        ["one view", size(encode_views(views(1)))],
        ["50 views", size(encode_views(views(50)))],
        [
            "4,000 removed views in ten runs",
            size(encode_views(replace(views(0), removed=Intervals.of(np.concatenate(runs))))),
        ],
        ["a path of ten poses", size(encode_plan(2, 5, 12.0, 0.2, path, path[:0]))],
        ["the same with three views", size(encode_plan(2, 5, 12.0, 0.2, path, views(3).poses))],
        ["an announcement of 5,000 records of one robot", size(encode_announcements(1, INCARNATION, one))],
        ["the same of 16 robots", size(encode_announcements(1, INCARNATION, team))],
        ["a supersession of ten records in a row by five", len(encode_record(merged))],
        ["counters of 50 components of one robot", len(encode_record(counters_message(key(1, 9), gains)))],
        ["a correction in 3D", len(encode_record(motion))],
    ]


def key(robot: int, number: int) -> int:
    return first_key(robot, INCARNATION) + number


def span(robot: int, begin: int, end: int) -> Intervals:
    return Intervals.span(key(robot, begin), key(robot, end))


def size(datagrams: list[bytes]) -> int:
    return sum(map(len, datagrams))


def views(n: int) -> ViewsMessage:
    generator = torch.Generator().manual_seed(0)
    poses = torch.rand(n, 4, generator=generator, dtype=torch.float64) * 40 - 20
    return ViewsMessage(
        ids=torch.stack([torch.arange(n) % 3, torch.arange(n) * 2], 1),
        poses=quantized_views(poses),
        values=(torch.rand(n, generator=generator) * 200).half().double(),
        stamps=torch.arange(n, dtype=torch.float64) / 8,
        removed=Intervals.of(np.zeros(0, np.int64)),
    )


def replica_times(frame: Components, n_held: int, repeats: int) -> dict[str, float]:
    """Milliseconds of each operation of replicas that hold n_held components, for a frame."""
    ours, theirs, third = Replica(0, incarnation=1), Replica(1, incarnation=1), Replica(2, incarnation=1)
    for _ in range(n_held // len(frame)):
        ours.add(frame)
        for datagram in ours.datagrams():
            message = decode(datagram)
            theirs.receive(datagram, message)
            third.receive(datagram, message)
    ours.changes(), theirs.changes()
    found: dict[str, list[float]] = {}

    def timed(name: str, work: Callable[[], object]) -> object:
        begin = time.process_time()
        made = work()
        found.setdefault(name, []).append(1e3 * (time.process_time() - begin))
        return made

    for _ in range(repeats):
        ids = timed("add a frame, which encodes its datagram", lambda: ours.add(frame))
        assert isinstance(ids, Tensor)
        datagrams = timed("send it", ours.datagrams)
        assert isinstance(datagrams, list)
        timed("receive it", lambda made=datagrams: [theirs.receive(datagram) for datagram in made])
        messages = [(datagram, decode(datagram)) for datagram in datagrams]
        timed("receive it, already decoded", lambda made=messages: [third.receive(*pair) for pair in made])
        five = {(int(robot), int(number)): 3.0 for robot, number in ids[:5].tolist()}
        timed("count five components", lambda gains=five: theirs.count(gains))
        timed("`changes()`", theirs.changes)
        timed("`digest()`", theirs.digest)
    return {name: min(values) for name, values in found.items()}


def frame_times(repeats: int, n: int = 2000) -> dict[str, float]:
    """Microseconds to seal, to open and to refuse a frame of the longest datagram."""
    key, found = TeamKey.generate(), {"seal": [], "open": [], "refuse a forged one": []}
    sealer, datagram = Sealer(1, key), bytes(1200)
    for _ in range(repeats):
        opener, stranger = Opener(key), Opener(TeamKey.generate())
        begin = time.process_time()
        frames = [sealer.seal(datagram) for _ in range(n)]
        sealed = time.process_time()
        opened = [opener.open(frame) for frame in frames]
        middle = time.process_time()
        refused = [stranger.open(frame) for frame in frames]
        end = time.process_time()
        assert all(opened)
        assert not any(refused)
        for name, seconds in zip(found, (sealed - begin, middle - sealed, end - middle), strict=True):
            found[name].append(1e6 * seconds / n)
    return {name: min(values) for name, values in found.items()}


HELD = f"ms with {N_HELD:,} components held"
CASES = (
    Case("message-sizes", message_sizes, columns={"content": "", "bytes": ""}, needs_data=False),
    Case(
        "replica-costs",
        replica_costs,
        f"Processor time of each operation, for a frame of {PER_FRAME} components.",
        {"operation": "", "ms": ".2f", HELD: ".2f"},
        needs_data=False,
    ),
    Case(
        "frame-costs",
        frame_costs,
        "Processor time of a frame with the longest datagram.",
        {"1200 bytes": "", "time": "{:.1f} µs"},
        needs_data=False,
    ),
)

if __name__ == "__main__":
    run(__doc__, *CASES, repeats={"type": int, "default": 5})
