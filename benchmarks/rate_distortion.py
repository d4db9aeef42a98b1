"""Bytes of a frame against what comes back of it: mixtures and codecs of points.

    OMP_NUM_THREADS=1 python benchmarks/rate_distortion.py --data FOLDER [--jobs 2]

FOLDER holds kinect/ and hall/; the warehouse is simulated. Every frame is a message by itself: encoded,
decoded, and only what was decoded is measured.

PSNR2: of the frame's points and those decoded, or as many drawn from the mixture decoded. AUC: every fifth
frame is held out, and its beams are asked about in the map of all others. Each codec is credited with its
best receiver: who has points counts their beams on a grid of once, twice or four times the resolution
or of the codec's own cells, or learns a mixture from them; mixtures are asked about cubes of once or
twice the resolution.

Needs the extra [baselines]. Draws docs/images/rate_distortion.png.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import joblib
import torch
from frames import RESOLUTIONS, SEED, Frame, material
from pages import ROOT
from rate_distortion_figures import QUALITIES, bytes_for, figures, leads
from torch import Tensor

from gmmtorch import GaussianMap, IncrementalRule
from gmmtorch.experiments.evaluation.metrics import psnr_terms
from gmmtorch.experiments.evaluation.queries import Queries
from gmmtorch.experiments.harness import Case, Row, run, score
from gmmtorch.mapping.codec.quantization import spatial_order
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.fitting import SurfaceFit, fit_points
from gmmtorch.mapping.learning.merging import all_origins, compact
from gmmtorch.mapping.learning.windows import surface_fit
from gmmtorch.occupancy.occupancy_grid import OccupancyGrid
from gmmtorch.occupancy.protocol import OccupancyMap
from gmmtorch.report.style import label_of, save_figure
from gmmtorch.scan import Scan
from gmmtorch.team.sharing.messages.component_messages import ComponentsMessage, encode_components
from gmmtorch.team.sharing.messages.message_registry import decode
from gmmtorch.team.sharing.point_codecs import (
    DepthImage,
    Draco,
    Octree,
    PointCodec,
    QuantizedPoints,
    RawPoints,
    compressed,
)

COMPONENTS = (8, 16, 32, 64, 128, 256, 384)  # of a frame at most: our knob
FINER = 3  # than a map's rule: a frame by itself has more components than its share of a window
RECEIVED = 1500  # components that a receiver merges all it got into, about as many as it learns from points
_IDS_APART = 1 << 13


class Task(NamedTuple):
    dataset: str
    codec: str
    setting: float
    folder: Path | None
    n_frames: int | None


Rows = list[dict[str, Any]]


# -- codecs of points --------------------------------------------------------------------------------------


def point_settings(name: str) -> dict[str, list[float]]:
    """The knob of each codec, in metres: side of cells, Draco's error, step of depth; or every n-th pixel."""
    r = RESOLUTIONS[name]
    settings = {
        "raw": [0.0],
        "quantized": [c * r for c in (4, 1, 0.25)],
        "octree": [c * r for c in (8, 4, 2, 1, 0.5, 0.25)],
        "draco": [c * r for c in (2, 1, 0.5, 0.25)],
    }
    if name != "hall":  # its scans are no images
        settings["depth_image"] = [c * r for c in (2, 0.5, 0.2, 0.02)]
        settings["depth_image_thinned"] = [16.0, 8.0, 4.0, 2.0]
    return settings


def point_messages(task: Task, frames: Sequence[Frame]) -> tuple[list[bytes], list[Tensor]]:
    if not task.codec.startswith("depth_image"):
        makers: dict[str, Callable[[float], PointCodec]] = {
            "raw": lambda _: RawPoints(),
            "quantized": QuantizedPoints,
            "octree": Octree,
            "draco": Draco,
        }
        codec = makers[task.codec](task.setting)
        data = [codec.encode(frame.scan.points) for frame in frames]
        return data, [codec.decode(message) for message in data]
    thinned = task.codec == "depth_image_thinned"
    every = int(task.setting) if thinned else 1
    images = DepthImage(step=0.2 * RESOLUTIONS[task.dataset] if thinned else task.setting)
    data, points = [], []
    for frame in frames:
        assert frame.depth is not None
        assert frame.points_of is not None
        data.append(images.encode(frame.depth[::every, ::every]))
        whole = torch.zeros_like(frame.depth)
        whole[::every, ::every] = images.decode(data[-1])
        points.append(frame.points_of(whole))
    return data, points


def measure_points(task: Task) -> Rows:
    frames, asked = material(task.dataset, task.folder, task.n_frames)
    data, points = point_messages(task, frames)
    scans = [Scan(cloud, frame.scan.origin) for cloud, frame in zip(points, frames, strict=True)]
    r = RESOLUTIONS[task.dataset]
    own = {"octree": 1.0, "quantized": 1.0, "draco": 2.0}.get(task.codec, 0.0) * task.setting
    scores = {}
    for cell in sorted({r, 2 * r, 4 * r, max(r, own)}):
        scores |= answers(filled(OccupancyGrid(cell), scans), asked, "grid", [cell])
    scores |= answers(filled(GaussianMap(cutoff=5.0, prior=1.0), scans), asked, "mixture", [r, 2 * r])
    return [row(task, data, frames, points, scores)]


def filled(built: OccupancyMap, scans: Sequence[Scan]) -> OccupancyMap:
    for scan in scans:
        built.insert(scan)
    return built


# -- mixtures ----------------------------------------------------------------------------------------------

MIXTURES = {  # how the same components are written, and for how many of them it is measured
    "ours": COMPONENTS,
    "thesis": COMPONENTS[::2],
    "ours_without_counts": (32, 128),
    "float": (32, 128),
}


def measure_mixtures(task: Task) -> Rows:
    """A row for each way to write the same components."""
    frames, asked = material(task.dataset, task.folder, task.n_frames)
    fitted = IncrementalRule().fitted([frame.scan for frame in frames])
    assert fitted.length is not None
    assert fitted.cell is not None
    finer = replace(
        fitted,
        length=fitted.length / FINER,
        cell=fitted.cell / FINER,
        window_components=int(task.setting),
    )
    rule = surface_fit(finer, 3)
    learned = [learn(frame.scan, rule, _IDS_APART * i) for i, frame in enumerate(frames)]
    rows = []
    for codec in (name for name, measured in MIXTURES.items() if task.setting in measured):
        sent = [without_counts(c) for c in learned] if codec == "ours_without_counts" else learned
        kind = codec if codec in ("thesis", "float") else "quantized"
        datagrams = [encode_components(components, kind) for components in sent]
        held = [Components.concatenate([components_of(d) for d in frame]) for frame in datagrams]
        points = [drawn(c, len(frame.scan.points)) for c, frame in zip(held, frames, strict=True)]
        built = GaussianMap.of(compact(Components.concatenate(held), RECEIVED), cutoff=None, prior=1.0)
        r = RESOLUTIONS[task.dataset]
        scores = answers(built, asked, "mixture", [r, 2 * r])
        data = [b"".join(frame) for frame in datagrams]
        found = row(task._replace(codec=codec), data, frames, points, scores)
        if codec == "ours":
            found["nbytes_zstd"] = statistics.mean(len(compressed(d)) for d in data)
        rows.append(found)
    return rows


def learn(scan: Scan, rule: SurfaceFit, first: int) -> Components:
    """The components of a frame, numbered in an order that takes few bytes."""
    found = fit_points([scan.points], scan.origin[None], rule, all_origins())
    found = found.rearranged(spatial_order(found))
    numbers = first + torch.arange(len(found))
    return replace(found, ids=torch.stack([torch.zeros_like(numbers), numbers], 1))


def without_counts(components: Components) -> Components:
    """All stand for as many points: one number, in place of one each."""
    same = torch.full_like(components.support, float(components.support.mean()))
    return replace(components, support=same, seen_count=same[components.seen_by])


def components_of(datagram: bytes) -> Components:
    message = decode(datagram)
    assert isinstance(message, ComponentsMessage)
    return message.components


def drawn(components: Components, n: int) -> Tensor:
    """Points (n, 3) at random of a mixture weighed by support."""
    generator = torch.Generator().manual_seed(SEED)
    which = torch.multinomial(components.support, n, replacement=True, generator=generator)
    normal = torch.randn(n, 3, 1, generator=generator, dtype=torch.float64)
    factor = torch.linalg.cholesky(components.covariances)
    return components.means[which] + (factor[which] @ normal).squeeze(2)


# -- measuring ---------------------------------------------------------------------------------------------


def answers(built: OccupancyMap, asked: Queries, name: str, resolutions: Sequence[float]) -> dict[str, float]:
    """AUC of a map's answers about cells of each side (m)."""
    return {f"{name}, {r:g} m": score(built, asked, r) for r in resolutions}


def row(
    task: Task,
    data: Sequence[bytes],
    frames: Sequence[Frame],
    points: Sequence[Tensor],
    scores: dict[str, float],
) -> dict[str, Any]:
    """Means over the frames; PSNR2 over every other, which is most of the time."""
    terms = [psnr_terms(f.scan.points, p) for f, p in list(zip(frames, points, strict=True))[::2]]
    best = max(scores, key=lambda name: scores[name])
    return {
        "dataset": task.dataset,
        "codec": task.codec,
        "setting": task.setting,
        "n_points": statistics.mean(len(frame.scan.points) for frame in frames),
        "nbytes": statistics.mean(map(len, data)),
        "psnr2_db": statistics.mean(map(sum, terms)),  # infinite where nothing is lost
        "psnr_lesser_db": statistics.mean(map(min, terms)),
        "psnr_forward_db": statistics.mean(forward for forward, _ in terms),
        "psnr_backward_db": statistics.mean(backward for _, backward in terms),
        "auc": scores[best],
        "receiver": best,
        "auc_of_receivers": scores,
    }


def measure(task: Task) -> Rows:
    torch.set_num_threads(1)
    return measure_mixtures(task) if task.codec == "ours" else measure_points(task)


def tasks_of(name: str, folder: Path | None, n_frames: int | None) -> list[Task]:
    """The longest first."""
    mixtures = [Task(name, "ours", float(k), folder, n_frames) for k in reversed(COMPONENTS)]
    points = [
        Task(name, codec, setting, folder, n_frames)
        for codec, settings in point_settings(name).items()
        for setting in settings
    ]
    return mixtures + points


# -- what is written ---------------------------------------------------------------------------------------


RIVALS = ("octree", "draco", "quantized", "depth_image", "depth_image_thinned", "thesis")
SHOWN = (8, 32, 128, 384)  # components


@cache
def measured(names: tuple[str, ...], data: Path, n_frames: int | None, jobs: int, figure: Path) -> Rows:
    """The rows of all settings, and their figure."""
    tasks = [task for name in names for task in tasks_of(name, data, n_frames)]
    rows: Rows = []
    for found in joblib.Parallel(jobs, batch_size=1, return_as="generator")(
        joblib.delayed(measure)(task) for task in tasks
    ):
        rows += found
        for r in found:
            print(
                f"{r['dataset']} {r['codec']} {r['setting']:g}: {r['nbytes']:,.0f} B, "
                f"{r['psnr2_db']:.1f} dB, AUC {r['auc']:.4f} ({r['receiver']})",
                flush=True,
            )
    save_figure(figures(rows)["rate_distortion"], figure, dpi=100)
    return rows


def settings(options: Any) -> Rows:
    return measured(tuple(options.names), options.data, options.frames, options.jobs, options.figure)


def equal_rows(options: Any) -> Iterator[Row]:
    """Ours, and what every other codec takes for the same PSNR2 and for the same AUC."""
    rows = settings(options)
    for r in (r for r in rows if r["codec"] == "ours" and r["setting"] in SHOWN):
        own = [other for other in rows if other["dataset"] == r["dataset"]]
        cells: dict[str, Any] = {
            "": r["dataset"],
            "components at most": r["setting"],
            "bytes a frame": r["nbytes"],
            "PSNR2 (its terms), dB": (
                f"{r['psnr2_db']:.1f} ({r['psnr_forward_db']:.1f}, {r['psnr_backward_db']:.1f})"
            ),
            "AUC": r["auc"],
        }
        for codec in RIVALS:
            sizes = [other["nbytes"] for other in own if other["codec"] == codec]
            needed = [bytes_for(own, codec, field, r[field]) for field in ("psnr2_db", "auc")]
            cells[label_of(codec)] = " / ".join(size(n, min(sizes)) for n in needed) if sizes else ""
        yield cells


def size(needed: float, coarsest: float) -> str:
    """Bytes; "≤" where the coarsest setting is better than asked for, "–" where the finest is worse."""
    if math.isinf(needed):
        return "–"
    return f"{'≤ ' if needed <= coarsest * (1 + 1e-9) else ''}{needed:,.0f}"


def lead_rows(options: Any) -> Iterator[Row]:
    """Per data set and quality: over which rates ours is at or below every other, and who ends it."""
    rows = settings(options)
    for name in options.names:
        own = [r for r in rows if r["dataset"] == name]
        for quality, title in QUALITIES.items():
            cells: dict[str, Any] = {"": name, "quality": title}
            for left_out, columns in zip((("depth_image_thinned",), ()), LEADS, strict=True):
                lead = leads(own, quality, left_out)
                there = lead.octaves >= 0.05
                span = f"{lead.low:,.0f} to {lead.high:,.0f}: {lead.octaves:.1f}" if there else "none"
                end = f", then {label_of(lead.ended_by)}" if lead.ended_by else ""
                cells |= dict(zip(columns, (span + end, lead.most if there else None), strict=True))
            yield cells


LEADS = (
    ("ours ahead, bytes a frame: octaves", "times fewer, at most"),
    ("of thinned depth images, too", "times fewer of these"),
)
CASES = (
    Case(
        "rate-distortion",
        lead_rows,
        "The longest range of rates over which ours takes no more bytes than any other codec for the same "
        "quality.",
        {column: ".1f" for _, column in LEADS},
        tuple(RESOLUTIONS),
        key=2,
    ),
    Case(
        "rate-distortion-bytes",
        equal_rows,
        'Bytes that the others need for our PSNR2 / AUC: "≤" if their coarsest setting is already better, '
        '"–" if their finest is worse.',
        {"components at most": ".0f", "bytes a frame": ",.0f", "AUC": ".4f"},
        tuple(RESOLUTIONS),
        key=2,
    ),
)

if __name__ == "__main__":
    run(
        __doc__,
        *CASES,
        jobs={"type": int, "default": 2, "help": "processes, of a thread each"},
        frames={"type": int, "help": "of each data set at most, for a quick look"},
        figure={"type": Path, "default": ROOT / "docs" / "images" / "rate_distortion.png"},
    )
