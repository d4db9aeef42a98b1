"""The poses that gmmtorch-localize is given, and its files: trajectories, scores, a picture, TensorBoard."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig, ListConfig
from torch import Tensor

from gmmtorch import localization
from gmmtorch.cli import common, schema
from gmmtorch.cli.reporting import map_outputs
from gmmtorch.datasets import Dataset, read_trajectory, to_nanoseconds
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.export import write_pose_table, write_tum
from gmmtorch.mapping import GaussianMap
from gmmtorch.pose import Pose
from gmmtorch.report import Board, Row, map_figure

_FORMS = {2: "[x,y,yaw]", 3: "[x,y,z,yaw] or [x,y,z,qx,qy,qz,qw]"}
FOUND, ALL = "trajectory.tum", "trajectory.csv"
_SHOWN = 3  # reasons of lost scans that are printed


class Truth(NamedTuple):
    """True poses (S, D+1, D+1) of all scans, and whether each is known (S,)."""

    poses: Tensor
    known: Tensor


def first_pose(config: DictConfig, dataset: Dataset, dim: int) -> Tensor | None:
    """The first pose (D+1, D+1), map ← sensor, of the option `pose`; None: unknown."""
    given = config.pose
    if given is None or given == "dataset":
        known = None if given is None else dataset.pose(0)
        if given is not None and known is None:
            raise InvalidArgumentError(
                f"pose=dataset, but {dataset.name} has no poses; give pose={_FORMS[dim]}."
            )
        return known
    numbers = list(given) if isinstance(given, ListConfig) else []
    try:
        values = [float(value) for value in numbers]
        if len(values) not in {2: (3,), 3: (4, 7)}[dim] or not all(map(math.isfinite, values)):
            raise ValueError
        turned = Pose.from_quaternion if len(values) == 7 else lambda at, yaw: Pose.from_yaw(yaw[0], at)
        return turned(values[:dim], values[dim:]).matrix
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(
            f"pose={given} is not a pose in a {dim}D map; give {_FORMS[dim]} (m, rad), dataset or null."
        ) from error


def true_poses(config: DictConfig, dataset: Dataset, dim: int) -> Truth | None:
    """The poses of the option `truth`. Raises `InvalidArgumentError` if no scan has one."""
    if config.truth in (None, "none"):
        return None
    if config.truth == "dataset":
        poses = [dataset.pose(number) for number in range(len(dataset))]
        known = [pose for pose in poses if pose is not None]
        blank = torch.eye(dim + 1).double()
        matrices = torch.stack([blank if pose is None else pose.double() for pose in poses])
        truth = Truth(matrices, torch.tensor([pose is not None for pose in poses]))
    else:
        with schema.naming({"poses": "truth"}):
            trajectory = read_trajectory(config.truth, len(dataset))
        is_timed = bool((trajectory.times >= len(trajectory)).any()) or len(trajectory) != len(dataset)
        times = to_nanoseconds(localization.scan_times(dataset).numpy()) if is_timed else trajectory.times
        found = trajectory.at(times)
        true = found.poses if dim == 3 else found.poses.in_plane()
        truth, known = Truth(true.matrix, torch.from_numpy(found.known)), list(found.known.nonzero()[0])
    if not known:
        raise InvalidArgumentError(
            f"truth={config.truth} has no pose at the time of a scan of {dataset.name}; give a file of the "
            "same clock, or truth=none."
        )
    return truth


def result_row(
    config: DictConfig, dataset: Dataset, located: Sequence[localization.ScanLocation], truth: Truth | None
) -> Row:
    """The row of results.json. `messages`: what the user must know, one sentence each."""
    found = [scan for scan in located if scan.location.found]
    dim = located[0].location.pose.shape[0] - 1 if located else 3
    deviations = [float(s.location.covariance[:dim, :dim].trace().sqrt()) for s in found]
    lost = _lost_runs(located)
    faults = localization.clock_faults(localization.scan_times(dataset))
    seconds = sum(scan.seconds for scan in located)
    return {
        "dataset": dataset.name,
        "map": str(config.map.path),
        "n_scans": len(located),
        "n_found": len(found),
        "n_lost_runs": len(lost),
        "lost": lost,
        "clock_faults": [{"scan": scan, "reason": text} for scan, text in faults],
        "deviation": float(torch.tensor(deviations).median()) if deviations else None,
        "seconds": seconds,
        "scans_per_second": len(located) / max(seconds, 1e-9),
        **_scores(found, truth),
        "messages": _messages(located, lost, faults),
    }


def _scores(found: Sequence[localization.ScanLocation], truth: Truth | None) -> dict[str, Any]:
    """ATE and RPE of the found scans whose true pose is known; None without one."""
    scores: dict[str, Any] = dict(localization.UNSCORED)
    used = [scan for scan in found if truth is not None and bool(truth.known[scan.number])]
    scores["n_scored"] = len(used)
    if truth is None or not used:
        return scores
    estimate = torch.stack([scan.location.pose for scan in used])
    true = truth.poses[[scan.number for scan in used]]
    scores |= localization.absolute_trajectory_error(estimate, true, "none").scores("ate")
    if len(used) > 1:
        scores |= localization.relative_pose_error(estimate, true).scores("rpe")
    return scores


def _lost_runs(located: Sequence[localization.ScanLocation]) -> list[dict[str, Any]]:
    """Runs of scans that were not found: first and last number, and the reasons of the first."""
    runs = []
    for is_found, group in itertools.groupby(located, lambda scan: scan.location.found):
        scans = list(group)
        if not is_found:
            reasons = "; ".join(scans[0].location.doubts)
            runs.append({"first": scans[0].number, "last": scans[-1].number, "reason": reasons})
    return runs


def _messages(
    located: Sequence[localization.ScanLocation],
    lost: Sequence[dict[str, Any]],
    faults: Sequence[tuple[int, str]],
) -> list[str]:
    messages = []
    for run in lost[:_SHOWN]:
        scans = (
            f"scan {run['first']}"
            if run["first"] == run["last"]
            else f"scans {run['first']} to {run['last']}"
        )
        messages.append(f"lost      {scans}: {run['reason']}")
    if len(lost) > _SHOWN:
        messages.append(f"lost      {len(lost) - _SHOWN} more times; {ALL} has the reasons")
    if lost and len(lost) == 1 and lost[0]["last"] - lost[0]["first"] + 1 == len(located):
        messages.append(
            "No scan was found: give the map of this place, a first pose (pose=) within 0.5 m and 0.175 rad "
            "of the truth, or a lower least_explained= where much has changed."
        )
    return messages + [f"clock     scan {scan}: {text}" for scan, text in faults[:_SHOWN]]


def write(
    config: DictConfig,
    built: GaussianMap,
    located: Sequence[localization.ScanLocation],
    truth: Truth | None,
    row: Row,
    folder: Path,
) -> None:
    """Write both trajectories, the picture and TensorBoard's events."""
    found = [scan for scan in located if scan.location.found]
    blank = torch.zeros(0, (built.dim or 3) + 1, (built.dim or 3) + 1)
    poses = torch.stack([scan.location.pose for scan in found]) if found else blank
    write_tum(folder / FOUND, torch.tensor([scan.time for scan in found]).double(), poses)
    if located:
        columns: dict[str, Sequence[object]] = {
            "scan": [scan.number for scan in located],
            "found": [int(scan.location.found) for scan in located],
            "explained": [f"{scan.location.explained:.4f}" for scan in located],
            "doubts": ["; ".join(scan.location.doubts) for scan in located],
        }
        write_pose_table(
            folder / ALL,
            torch.tensor([scan.time for scan in located]).double(),
            torch.stack([scan.location.pose for scan in located]),
            torch.stack([scan.location.covariance for scan in located]),
            columns,
        )

    def write_board(board: Board) -> None:
        for scan in located:
            board.scalars(_scalars(scan, truth), "localize", step=scan.number)
        board.hparams(common.chosen_options(config), {"found": row["n_found"] / max(row["n_scans"], 1)})

    common.show(config, folder, lambda: {"path": _figure(built, located, truth, row)}, write_board)


def _figure(
    built: GaussianMap, located: Sequence[localization.ScanLocation], truth: Truth | None, row: Row
) -> Any:
    """The map with the path of the scans that were found, the true path, and places of lost scans."""
    path, lost, true = _positions(located, truth)
    shown = [positions for positions in (path, true) if positions is not None and len(positions)]
    title = f"{row['dataset']}: {row['n_found']:,} of {row['n_scans']:,} scans found"
    title += f", ATE {row['ate']:.3f} m" if row["ate"] is not None else ""
    return map_figure(
        [map_outputs.map_panel(built, shown or [built.components().means[:0].double()])],
        [path] if len(path) else [],
        truth=true,
        lost=lost if len(lost) else None,
        title=title,
    )


def _scalars(scan: localization.ScanLocation, truth: Truth | None) -> dict[str, float]:
    """Numbers of a scan for TensorBoard."""
    location, dim = scan.location, scan.location.pose.shape[0] - 1
    numbers = {
        "found": float(location.found),
        "explained": location.explained,
        "deviation": float(location.covariance[:dim, :dim].trace().sqrt()),
        "seconds": scan.seconds,
    }
    if truth is not None and location.found and bool(truth.known[scan.number]):
        pose, true = location.pose[None], truth.poses[scan.number][None]
        numbers["error"] = localization.absolute_trajectory_error(pose, true, "none").rmse
    return numbers


def _positions(
    located: Sequence[localization.ScanLocation], truth: Truth | None
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Positions (S, D) of the found scans, of the lost ones, and the true ones. A lost scan is shown at its
    true position, or without one at the last that was found."""
    dim = located[0].location.pose.shape[0] - 1 if located else 3
    path, lost = [], []
    for scan in located:
        position = scan.location.pose[:dim, dim].cpu()
        if scan.location.found:
            path.append(position)
        elif truth is not None and bool(truth.known[scan.number]):
            lost.append(truth.poses[scan.number][:dim, dim].cpu())
        elif path:
            lost.append(path[-1])
    empty = [torch.zeros(0, dim).double()]
    true = None if truth is None else truth.poses[truth.known][:, :dim, dim].cpu()
    found, not_found = (torch.cat([*empty, *(p[None] for p in some)]) for some in (path, lost))
    return found, not_found, true
