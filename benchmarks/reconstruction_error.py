"""How far off are the surfaces that robots tell one another: mixtures, octrees and Draco, and their bytes.

    OMP_NUM_THREADS=1 python benchmarks/reconstruction_error.py              # two minutes of three robots
    OMP_NUM_THREADS=1 python benchmarks/reconstruction_error.py --duration 600

E0 in the embedded warehouse. Every frame's novel points, of which E0 learns, also go through the codecs, and
what comes back of all frames is a cloud. E0's is drawn from the mixture that a robot holds at the end, as it
was decoded from datagrams: as many points as there were, each component's in proportion to its support.
Ends of beams without a return are in the bytes, not in the errors; `of_returns` leaves them out (of E0's
bytes, in proportion to the components). Root mean squares, in brackets median, 90 % and 95 %, in cm:

- off the surface: from the cloud's points to the mesh. Of points as the camera saw them, its noise.
- across: from the camera's points to the nearest decoded of their frame, along the normal of the mesh; of the
  mixture to the plane of a component, through its mean and across its thinnest axis: of the 32 components
  with the nearest means, that at the least Mahalanobis distance.
- to the cloud, from the cloud: from the camera's points to the nearest of the cloud; and the other way round.

Then, for every measure, the bytes of Draco and of octrees that are as far off as E0, between those tried.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import open3d
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from gmmtorch.experiments.harness import Case, Row, run
from gmmtorch.linalg import safe_cholesky
from gmmtorch.mapping.components import Components
from gmmtorch.simulation.mesh_world import MeshWorld
from gmmtorch.simulation.robot_camera import DepthFrame
from gmmtorch.simulation.warehouses import warehouse
from gmmtorch.team.exploration.mission.driver import SimulatedClock, drive
from gmmtorch.team.exploration.mission.mission import Mission
from gmmtorch.team.exploration.mission.options import TeamOptions
from gmmtorch.team.exploration.mission.trials import assemble
from gmmtorch.team.exploration.robot.agent import Robot
from gmmtorch.team.exploration.robot.mapper import FrameUpdate
from gmmtorch.team.exploration.world.world import open_world
from gmmtorch.team.sharing.point_codecs import Draco, Octree, PointCodec

RIVALS: Mapping[str, Mapping[float, PointCodec]] = {
    "octree": {side: Octree(side) for side in (0.05, 0.07, 0.1, 0.14, 0.2, 0.3)},
    "draco": {error: Draco(error) for error in (0.01, 0.02, 0.03, 0.045, 0.06, 0.08, 0.1, 0.15)},
}
"""By family, and metres: the side of the cells, or the root mean square error."""
MEASURES = {
    "off_surface": "off the surface",
    "across": "across",
    "to_cloud": "return to the cloud",
    "from_cloud": "cloud to a return",
}
QUANTILES = (0.5, 0.9, 0.95)
NEIGHBOURS = 32
SAMPLE = 200_000  # points of a cloud that are looked at

Rows = NDArray[np.float64]
Distances = dict[str, Rows]


class Recorder:
    """Keeps the novel returns, and the ends of novel no-return beams, of each frame of a mission."""

    def __init__(self, mission: Mission) -> None:
        self.returns: list[Tensor] = []
        self.ends: list[Tensor] = []
        self._note = mission.score.note
        mission.score.note = self.note  # type: ignore[method-assign]

    def note(self, robot: Robot, frame: DepthFrame, update: FrameUpdate) -> None:
        for kept, kind in ((self.returns, frame.is_hit), (self.ends, ~frame.is_hit)):
            ends = frame.ends[update.novel & kind]
            if len(ends):
                kept.append(ends)
        self._note(robot, frame, update)


class Truth:
    """What clouds are held against: the mesh, and a camera's points, frame by frame."""

    def __init__(self, mesh: MeshWorld, triangles: Tensor, frames: Sequence[Rows]) -> None:
        stride = max(1, sum(map(len, frames)) // SAMPLE)
        self.some = [frame[::stride] for frame in frames]
        self.points = np.concatenate(self.some)
        self._mesh, self._tree = mesh, cKDTree(np.concatenate(frames))
        core: Any = open3d.core
        scene: Any = open3d.t.geometry.RaycastingScene()
        corners = triangles.reshape(-1, 3).float().numpy()
        scene.add_triangles(corners, np.arange(len(corners), dtype=np.uint32).reshape(-1, 3))
        closest = scene.compute_closest_points(core.Tensor(self.points.astype(np.float32)), nthreads=1)
        self._normals = closest["primitive_normals"].numpy()

    def distances(self, cloud: Rows, across: Rows) -> Distances:
        """Metres, by measure; those `across` (N,) are known."""
        some = cloud[:: max(1, len(cloud) // SAMPLE)]
        return {
            "off_surface": self._mesh.clearance(torch.from_numpy(some)).numpy(),
            "across": across,
            "to_cloud": cKDTree(cloud).query(self.points)[0],
            "from_cloud": self._tree.query(some)[0],
        }

    def across(self, decoded: Sequence[Rows]) -> Rows:
        """Metres (N,) along the normal of the mesh from points to the nearest decoded of their frame."""
        pairs = zip(self.some, decoded, strict=True)
        places = [back[cKDTree(back).query(points)[1]] for points, back in pairs]
        return np.abs(((np.concatenate(places) - self.points) * self._normals).sum(1))


def drawn(surfaces: Components, n: int) -> Rows:
    """About `n` points, each component's in proportion to its support."""
    generator = torch.Generator().manual_seed(0)
    share = surfaces.support / surfaces.support.sum() * n
    number = (share + torch.rand(share.shape, generator=generator, dtype=share.dtype)).floor().long()
    of = torch.repeat_interleave(number)
    normal = torch.randn(len(of), 3, 1, generator=generator, dtype=torch.float64)
    points = surfaces.means[of] + (safe_cholesky(surfaces.covariances)[of] @ normal)[..., 0]
    return points[torch.randperm(len(points), generator=generator)].numpy()


def across_components(surfaces: Components, points: Rows) -> Rows:
    """Metres (N,) from points (N, 3) to the plane of the component that each is most likely of."""
    means = surfaces.means.numpy()
    variances, axes = np.linalg.eigh(surfaces.covariances.numpy())  # the thinnest axis first
    _, nearest = cKDTree(means).query(points, k=min(NEIGHBOURS, len(means)))
    found = []
    for some, near in zip(np.array_split(points, 64), np.array_split(nearest, 64), strict=True):
        along = np.einsum("nki,nkij->nkj", some[:, None] - means[near], axes[near])
        best = (along**2 / variances[near]).sum(2).argmin(1)
        found.append(np.abs(along[np.arange(len(some)), best, 0]))
    return np.concatenate(found)


def sent_and_decoded(codec: PointCodec, frames: Sequence[Tensor]) -> tuple[int, list[Rows]]:
    """Bytes of all frames, each by itself, and what comes back of each."""
    data = [codec.encode(frame) for frame in frames]
    return sum(map(len, data)), [codec.decode(one).numpy() for one in data]


class Found(NamedTuple):
    """What came of one way to send the points; metres: the side of its cells, or the error asked for."""

    family: str
    metres: float
    n_bytes: int
    n_of_returns: int
    distances: Distances

    def rms(self, measure: str) -> float:
        """Centimetres."""
        return 100 * math.sqrt(float(np.square(self.distances[measure]).mean()))

    def row(self) -> Row:
        """A line of the table: of each measure the root mean square, and quantiles."""
        title = f"{self.family}, {self.metres:g} m" if self.metres else self.family
        row: dict[str, Any] = {"": title, "bytes": self.n_bytes, "of returns": self.n_of_returns}
        for measure, distances in self.distances.items():
            quantiles = ", ".join(f"{100 * x:.1f}" for x in np.quantile(distances, QUANTILES))
            row[MEASURES[measure]] = f"{self.rms(measure):.1f} ({quantiles})"
        return row


def as_far_off(tried: Sequence[Found], own: Found, measure: str) -> str:
    """Where a family, from fine to coarse, is as far off as `own`, between two tried, log-linearly; if more
    than once, as what a lattice does to walls depends on where in it they are, with the fewest bytes. The
    bytes are multiples of those of `own`, in brackets of returns alone."""
    wanted = own.rms(measure)
    for far, near in itertools.pairwise(reversed(tried)):
        low, high = near.rms(measure), far.rms(measure)
        if low <= wanted <= high:
            share = math.log(wanted / low) / math.log(high / low)
            metres = near.metres * (far.metres / near.metres) ** share
            n_bytes = near.n_bytes * (far.n_bytes / near.n_bytes) ** share
            of_returns = near.n_of_returns * (far.n_of_returns / near.n_of_returns) ** share
            times, of = n_bytes / own.n_bytes, of_returns / own.n_of_returns
            return f"{times:.1f} ({of:.1f}), at {metres:.3f} m"
    return ""


@cache
def measured(duration: float, robots: int, seed: int) -> tuple[str, list[Found], list[list[Found]]]:
    """What the mission saw; the points as seen, and E0; and each family, from fine to coarse."""
    world = open_world("warehouse")
    mission = assemble(world, TeamOptions(size=robots, duration=duration, seed=seed))
    recorder = Recorder(mission)
    drive(mission, SimulatedClock())
    mixture = mission.robots[0].mapper.components()
    assert mixture is not None
    surfaces = mixture.selected((~mixture.max_range).nonzero().squeeze(1))
    frames = [frame.numpy() for frame in recorder.returns]
    truth, n_points = Truth(world.mesh, warehouse(), frames), sum(map(len, frames))
    kinds = mission.network.bytes_by_kind
    about = (
        f"{n_points:,} novel returns and {sum(map(len, recorder.ends)):,} ends of beams without one, "
        f"{len(frames)} frames; {len(surfaces):,} components of surfaces, "
        f"{len(mixture) - len(surfaces):,} of empty beams, {kinds['components']:,} B; "
        f"{sum(kinds.values()):,} B were sent in all."
    )
    n_raw = 12 * sum(map(len, (*recorder.returns, *recorder.ends)))
    distances = truth.distances(np.concatenate(frames), truth.across(frames))
    seen = Found("points as seen", 0, n_raw, 12 * n_points, distances)
    n_bytes = kinds["components"]
    distances = truth.distances(drawn(surfaces, n_points), across_components(surfaces, truth.points))
    own = Found("E0", 0, n_bytes, round(n_bytes * len(surfaces) / len(mixture)), distances)
    families = []
    for family, codecs in RIVALS.items():
        families.append([])
        for metres, codec in codecs.items():
            of_returns, decoded = sent_and_decoded(codec, recorder.returns)
            n_bytes = of_returns + sent_and_decoded(codec, recorder.ends)[0]
            distances = truth.distances(np.concatenate(decoded), truth.across(decoded))
            families[-1].append(Found(family, metres, n_bytes, of_returns, distances))
    return about, [seen, own], families


def errors(options: Any) -> Iterator[Row]:
    options.about, first, families = measured(options.duration, options.robots, options.seed)
    yield from (found.row() for found in itertools.chain(first, *families))


def equal(options: Any) -> Iterator[Row]:
    _, (_, own), families = measured(options.duration, options.robots, options.seed)
    for tried in families:
        yield {
            "": tried[0].family,
            **{f"{title}, {own.rms(m):.1f} cm": as_far_off(tried, own, m) for m, title in MEASURES.items()},
        }


CASES = (
    Case(
        "equal-error",
        errors,
        "Centimetres, RMS (median, 90 %, 95 %).",
        {"bytes": ",.0f", "of returns": ",.0f"},
        needs_data=False,
    ),
    Case(
        "equal-bytes",
        equal,
        "Bytes at the RMS error of E0, as multiples of the bytes of E0's components. In brackets: the same "
        "for returns alone.",
        needs_data=False,
    ),
)

if __name__ == "__main__":
    run(
        __doc__,
        *CASES,
        duration={"type": float, "default": 120.0, "help": "simulated seconds"},
        robots={"type": int, "default": 3},
        seed={"type": int, "default": 0},
    )
