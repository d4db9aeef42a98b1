"""The files of gmmtorch-map: trajectory, exports, pictures and TensorBoard."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

import gmmtorch
from gmmtorch import localization, report  # whose parts load when they are used
from gmmtorch.cli import common, schema
from gmmtorch.cli.export import ExportOptions
from gmmtorch.datasets import Dataset, Reposed, read_trajectory
from gmmtorch.errors import GmmTorchError, InvalidArgumentError, MemoryLimitError, check_number
from gmmtorch.export import write_pose_table, write_tum
from gmmtorch.mapping import Components, GaussianMap, MapBuilder, TiledMap
from gmmtorch.occupancy import reliability_of, scores_of
from gmmtorch.optional_packages import load_pyoctomap
from gmmtorch.pose import Pose
from gmmtorch.report import Event, Row

EXPORTS = {
    "map_server": ("map_server", "navigation.yaml"),
    "octomap": ("octomap", "map.ot"),
    "cloud": ("ply", "cloud.ply"),
    "mesh": ("mesh", "mesh.ply"),
    "distance_field": ("distance_field", "distance_field.npz"),
}
"""The format of gmmtorch-export and the file of each export."""

_MESH_CELLS = 0.5  # sides of a mesh's cells, relative to the resolution of the map
_MOST_CELLS = 1600  # along a side of a picture
_STANDING = 1.0  # m of a path, below which bytes a metre say nothing


def check_exports(names: Sequence[str]) -> None:
    """Raises `InvalidArgumentError` for an unknown export, `GmmTorchError` if its package is missing."""
    for name in names:
        if name not in EXPORTS:
            raise InvalidArgumentError(f"export={list(names)}: {name!r} is not one of {', '.join(EXPORTS)}.")
    if "octomap" in names:
        load_pyoctomap()


def run_facts(config: DictConfig, source: str) -> dict[str, Any]:
    """What the map of a run depends on; source: the group of options of its scans."""
    return {
        "version": gmmtorch.__version__,
        source: common.as_options(config[source]),
        "map": common.as_options(config.map),
        "seed": config.seed,
        "dtype": config.runtime.dtype,
    }


def checkpoint_of(folder: Path) -> Path:
    """The file of a `Checkpoint` in a run directory."""
    return folder / "checkpoint.safetensors"


class Checkpoint:
    """The file in a run directory from which a run that was stopped or killed goes on.

    If the file exists, the map continues from it. Raises `InvalidArgumentError` if it is of another run.

    Args:
        source: see `run_facts`.
        clock: the time (s) by which `checkpoint_seconds` pass.

    Attributes:
        is_continued: whether the file existed.
    """

    def __init__(
        self, config: DictConfig, builder: MapBuilder[Any], source: str, clock: Callable[[], float]
    ) -> None:
        check_number("checkpoint_seconds", config.checkpoint_seconds)
        self._builder, self._clock, self._period = builder, clock, config.checkpoint_seconds
        self._facts = run_facts(config, source)
        self._path = checkpoint_of(common.run_dir())
        self.is_continued = self._path.exists()
        if self.is_continued:
            builder.load(self._path, self._facts)
            print(f"continues after scan {builder.record.n_read} of {self._path}", flush=True)
        elif isinstance(builder.map, TiledMap):
            self.save()  # says of which run the map is
        self._saved = clock()

    def save_when_due(self) -> None:
        """Writes the file if enough time has passed since the last one."""
        if self._clock() - self._saved >= self._period:
            self.save()

    def save(self) -> None:
        """Writes the file."""
        self._builder.save(self._path, self._facts)
        self._saved = self._clock()

    def remove(self) -> None:
        """Deletes the file of a finished run."""
        self._path.unlink(missing_ok=True)


TRAJECTORY, POSE_TABLE = "trajectory.tum", "trajectory.csv"
RECORDINGS = "recordings"
"""Folder of a run with `inputs`: one folder for each recording."""


def write_trajectory(builder: MapBuilder[Any], folder: Path) -> Tensor:
    """Write the trajectory as TUM; returns the sensor positions (S, D)."""
    write_tum(folder / TRAJECTORY, builder.times, builder.poses)
    return builder.poses[:, :-1, -1]


def write_estimated_poses(dataset: Dataset, estimated: localization.Trajectory, folder: Path) -> None:
    """Write the estimated poses of all scans with their covariances, if the method gives some."""
    if bool(estimated.covariances.isnan().any()):
        return
    dim = estimated.poses.shape[1] - 1
    turn = estimated.poses[:, :dim, :dim]
    axes = Pose(turn, turn.new_zeros(len(turn), dim)).adjoint()
    columns = {"scan": range(len(turn)), "found": estimated.found.int().tolist(), "doubts": estimated.doubts}
    spread = axes @ estimated.covariances @ axes.mT  # of the sensor's axes, in those of the world
    write_pose_table(folder / POSE_TABLE, localization.scan_times(dataset), estimated.poses, spread, columns)


def trajectories(run: Path, dim: int) -> list[Tensor]:
    """The sensor positions (S, D) of each recording of a map. run: the run directory, or a file in it."""
    folder = run if run.is_dir() else run.parent
    files = [folder / TRAJECTORY, *sorted(folder.glob(f"{RECORDINGS}/*/{TRAJECTORY}"))]
    return [positions(file, dim) for file in files if file.is_file()]


def positions(trajectory: Path, dim: int) -> Tensor:
    """The sensor positions (S, D) of a trajectory file. Raises `DataError` if it is damaged."""
    return read_trajectory(trajectory).poses.translation[:, :dim]


def print_skipped(skipped: Mapping[str, int]) -> None:
    """Print the numbers of scans that were left out, by the reason."""
    for reason, count in skipped.items():
        print(f"skipped   {count} scans: {reason}")


def write_exports(
    config: DictConfig, built: GaussianMap | TiledMap, folder: Path, on_event: Event
) -> tuple[GaussianMap | None, list[str], list[str]]:
    """Write the exports that the options name; returns the map that pictures show, messages, and the errors
    of the exports that failed. A tiled map that does not fit into `runtime.memory_limit` has neither."""
    try:
        source = built.open() if isinstance(built, TiledMap) else built
    except MemoryLimitError as error:
        return None, [f"pictures  none: {error!s}"], [str(error)] if config.export else []
    messages, errors = [], []
    for name in config.export:
        from gmmtorch.cli.reporting import exported_files

        form, file = EXPORTS[name]
        options = {
            "format": form,
            "path": str(folder / "map.safetensors"),
            "output": str(folder / file),
            "resolution": config.resolution * (_MESH_CELLS if name == "mesh" else 1),
            "runtime": {key: config.runtime[key] for key in ("device", "threads", "memory_limit")},
            **({"z_min": config.z_min, "z_max": config.z_max} if name == "map_server" else {}),
        }
        merged: Any = OmegaConf.merge(OmegaConf.structured(schema.schema_of(ExportOptions)), options)
        try:
            written = exported_files.write_space(merged, source, on_event)
        except GmmTorchError as error:
            errors.append(f"{name}: {error}")
            continue
        messages.append("export    " + written.replace("\n", "\n          "))
    return source, messages, errors


def check_exported(config: DictConfig, errors: Sequence[str]) -> None:
    """Raises `GmmTorchError` if an export of the options has failed."""
    if errors:
        raise GmmTorchError(f"not all of export={list(config.export)} was written: {' '.join(errors)}")


def result_row(name: str, builder: MapBuilder[Any], config: DictConfig, odometry: Row | None = None) -> Row:
    """The row of results.json of a recording. odometry: facts of the estimated trajectory."""
    now, record, built = builder.progress(), builder.record, builder.map
    nbytes, seconds = built.nbytes, max(now.seconds, 1e-9)
    return {
        "dataset": name,
        "n_scans": len(record.indices),
        "n_skipped": now.n_skipped,
        "skipped": [{"reason": reason, "n_scans": n} for reason, n in builder.skipped.items()],
        "n_points": now.n_points,
        "metres": now.metres,
        "n_components": built.n_components,
        "nbytes": nbytes,
        "bytes_per_metre": bytes_per_metre(nbytes, now.metres),
        "resolution": config.resolution,
        "seconds": now.seconds,
        "scans_per_second": now.n_read / seconds,
        "metres_per_second": now.metres / seconds,
        "memory_bytes": max(row["memory_bytes"] for row in record.history),
        "predictions": [
            {"side": side, "n_predictions": round(float(tally[:, 0].sum())), **scores_of(tally)}
            for side, tally in built.predictions.items()
        ],
        "history": record.history,
        **({} if odometry is None else {"odometry": odometry}),
    }


def bytes_per_metre(nbytes: int, metres: float) -> float | None:
    """Bytes of a map for each metre of the sensor's path; None if the sensor stood."""
    return nbytes / metres if metres >= _STANDING else None


def draw(
    config: DictConfig,
    built: GaussianMap,
    trajectories: Sequence[Tensor],
    row: Row,
    folder: Path,
    odometry: Any = None,
) -> None:
    """Write the figures as PNG, and figures and numbers to TensorBoard.

    trajectories: sensor positions (S, D) of each recording. row: of results.json. odometry: of
    `odometry_figure`.
    """

    def write(board: report.Board) -> None:
        for entry in row.get("history", ()):
            board.scalars(entry, "map", step=entry["n_read"])
        surfaces = surfaces_of(built.components())
        board.ellipsoids("components", surfaces.means, surfaces.covariances)
        board.paths("trajectory", trajectories)
        board.hparams(common.chosen_options(config), {key: row[key] for key in ("n_components", "nbytes")})

    def figures() -> dict[str, Any]:
        return _figures(built, trajectories, row) | ({} if odometry is None else {"odometry": odometry})

    common.show(config, folder, figures, write)


def odometry_figure(dataset: Dataset, estimated: localization.Trajectory | None, row: Row) -> Any:
    """A figure of the estimated path beside that of the data set; None if one of them is missing."""
    facts = row.get("odometry")
    if estimated is None or facts is None or facts["ate"] is None or not isinstance(dataset, Reposed):
        return None
    true = torch.stack([dataset.own_pose(index) for index in range(len(dataset))])
    moved = localization.aligned(estimated.poses, true, facts["align"])
    path, true_path = (poses[:, :-1, -1].numpy() for poses in (moved, true))
    title = f"{row['dataset']}: ATE {facts['ate']:.3g} m, RPE {facts['rpe']:.3g} m, {facts['n_lost']} lost"
    return report.trajectory_figure(path, true_path, estimated.found.numpy(), title)


def map_panel(built: GaussianMap, trajectories: Sequence[Tensor]) -> report.MapPanel:
    """The region of a map around its surfaces and the sensor positions (S, D), for pictures."""
    low, high = report.robust_bounds(_shown(built).means.cpu(), torch.cat(list(trajectories)))
    side = max(b - a for a, b in zip(low[:2], high[:2], strict=True))
    resolution = built.resolution * max(1, math.ceil(side / (_MOST_CELLS * built.resolution)))

    def answer(points: Tensor) -> Tensor:
        return built.occupancy(points, resolution)  # type: ignore[return-value]

    return report.MapPanel("occupancy", answer, resolution, low, high)


def surfaces_of(components: Components) -> Components:
    """The components of surfaces, without those of free space."""
    return components.selected((~components.max_range).nonzero().squeeze(1))


def _shown(built: GaussianMap) -> Components:
    """The components of surfaces; all components if there are none."""
    components = built.components()
    surfaces = surfaces_of(components)
    return surfaces if len(surfaces) else components


def _figures(built: GaussianMap, trajectories: Sequence[Tensor], row: Row) -> dict[str, Any]:
    """The map from above, its components, in 3D in space, and how reliable its predictions were."""
    surfaces = _shown(built)
    title = f"{row['dataset']}: {row['n_components']:,} components, {report.byte_text(row['nbytes'])}"
    title += f", {row['metres']:,.0f} m travelled" if row["metres"] >= _STANDING else ""
    panel = map_panel(built, trajectories)
    figures = {"above": report.map_figure([panel], trajectories, title=title)}
    if built.predictions:
        curves = {
            f"cubes of {report.metres(side)}, {float(tally[:, 0].sum()):,.0f} predictions": reliability_of(
                tally
            )
            for side, tally in built.predictions.items()
        }
        heading = f"{row['dataset']}: what each window showed, and what the map predicted"
        figures["reliability"] = report.reliability_figure(curves, heading)
    shown = surfaces.means.cpu(), surfaces.covariances.cpu()
    if surfaces.dim == 3:
        seen_from = report.first_viewpoints(surfaces).cpu()
        figures["components"] = report.mixture_scene_figure(
            *shown, seen_from=seen_from, trajectories=trajectories, traveller="recording", title=title
        )
    else:
        figures["components"] = report.mixture_figure(
            surfaces.means[:0].cpu(),
            *shown,
            surfaces.support.cpu(),
            title=str(row["dataset"]),
            max_components=max(len(surfaces), 1),
        )
    return figures
