"""Studies of maps: AUC against bytes, and maps with corrected poses against those of true poses."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch
from pillar_room import room_scans

from gmmtorch import GaussianMap, Scan, WindowedRule
from gmmtorch.datasets import load
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation.held_out import Form, MapFactory, Protocol, evaluate, methods
from gmmtorch.experiments.evaluation.queries import perturb_poses, pose_perturbations
from gmmtorch.experiments.studies import evaluate_correction, run_auc_memory
from gmmtorch.experiments.studies.map_studies import build_by_scan, correct_poses

PROTOCOL = Protocol(test_every=4, resolution=(0.2,))


def sized_map(n: int) -> MapFactory:
    return Form(lambda: GaussianMap(window=5, learning=WindowedRule(n_components=n)), "point")


def test_every_sized_method_has_a_row():
    scans = room_scans(12)
    grid = methods(GaussianMap)["occupancy_grid"]
    sized = {("point", 4): sized_map(4), ("point", 12): sized_map(12), ("grid", None): grid}
    counts: list[int] = []
    rows = run_auc_memory("room", scans, sized, PROTOCOL, on_rows=lambda rows: counts.append(len(rows)))
    assert [(row["method"], row["size"]) for row in rows] == [("point", 4), ("point", 12), ("grid", None)]
    assert counts == [1, 2, 3]
    assert rows[0]["nbytes"] < rows[1]["nbytes"]
    assert rows[0]["n_components"] < rows[1]["n_components"]
    (expected,) = evaluate("room", scans, {"grid": grid}, PROTOCOL).rows
    assert rows[2]["auc"] == expected["auc"]
    assert rows[2]["nbytes"] == expected["nbytes"]


# -- corrected poses -------------------------------------------------------------------------------------

NOISE = (0.3, 0.1)


def per_scan() -> GaussianMap:
    return GaussianMap(WindowedRule(window=1), n_samples=100_000, prior=1.0)


@pytest.fixture(scope="module")
def building() -> list[Scan]:
    torch.set_num_threads(1)
    dataset = load("synthetic_building_2d", n_scans=12)
    return [dataset[i] for i in range(len(dataset))]


def corrected(scans: Sequence[Scan]) -> tuple[GaussianMap, GaussianMap, list[torch.Tensor]]:
    """A corrected map of perturbed poses, a map of the true poses, and the latter's ids by scan."""
    motions = pose_perturbations(scans, NOISE, seed=3)
    wrong, right = per_scan(), per_scan()
    born = build_by_scan(wrong, [s.transformed(m) for s, m in zip(scans, motions, strict=True)])
    truth = build_by_scan(right, scans)
    correct_poses(wrong, born, motions)
    assert [len(ids) for ids in born] == [len(ids) for ids in truth]
    return wrong, right, truth


@pytest.mark.parametrize("dim", [2, 3])
def test_corrected_components_match_a_map_from_true_poses(dim, building):
    scans = building[:6] if dim == 2 else room_scans(4, 300, dim=3)
    wrong, right, by_scan = corrected(scans)
    found, truth = wrong.components(), right.components()
    assert torch.equal(found.ids, truth.ids)
    for ids in by_scan:
        here = (found.ids[:, None] == ids[None]).all(2).any(1)
        # The order of two pieces depends on the sign of an axis, so the nearest components are compared.
        pair = torch.cdist(found.means[here], truth.means[here]).argmin(1)
        assert len(set(pair.tolist())) == len(ids)
        for name, tolerance in (("means", 1e-4), ("covariances", 1e-6), ("support", 1e-3)):
            value, expected = (getattr(part, name)[here] for part in (found, truth))
            torch.testing.assert_close(value, expected[pair], rtol=1e-3, atol=tolerance)
        torch.testing.assert_close(
            found.cones().origins[here], truth.cones().origins[here], rtol=0, atol=2**-15
        )


def test_correction_restores_the_auc(building):
    protocol = Protocol(test_every=4, resolution=(0.2,), kept=(1.0, 0.5), pose_noise=NOISE)
    rows = evaluate_correction("building", building, per_scan, protocol, ("point", "monte_carlo"))
    order = [(row["kept"], row["method"], row["resolution"]) for row in rows]
    assert order == [(k, m, r) for k in (1.0, 0.5) for m in ("point", "monte_carlo") for r in (0.2,)]
    for row in rows:
        assert row["auc"] < row["auc_clean"] - 0.02
        exact = 1e-4 if row["method"] == "point" else 0.02  # Monte Carlo draws its rays in another order
        assert row["auc_corrected"] == pytest.approx(row["auc_clean"], abs=exact)
        assert (row["pose_noise_m"], row["pose_noise_rad"]) == NOISE
        assert row["dataset"] == "building"
        assert row["n_components"] > 0


def test_without_noise_all_aucs_are_equal(building):
    (row,) = evaluate_correction("building", building, per_scan, Protocol(test_every=4, resolution=(0.1,)))
    assert row["auc"] == row["auc_corrected"] == row["auc_clean"]


def test_perturb_poses_applies_the_motions(building):
    motions = pose_perturbations(building, NOISE, seed=5)
    for scan, motion, moved in zip(building, motions, perturb_poses(building, NOISE, seed=5), strict=True):
        assert torch.equal(scan.transformed(motion).points, moved.points)
        homogeneous = torch.cat([scan.origin.double(), torch.ones(1, dtype=torch.float64)])
        assert (motion @ homogeneous)[:-1].sub(scan.origin).norm() < 5 * NOISE[0]


def test_a_scan_without_points_has_no_components():
    empty = Scan(torch.empty(0, 2), torch.zeros(2))
    scans = [*room_scans(2), empty]
    wrong, right, by_scan = corrected(scans)
    assert len(by_scan[2]) == 0
    assert wrong.n_components == right.n_components


def test_windows_of_several_scans_raise():
    with pytest.raises(InvalidArgumentError, match=r"window=None.*map=per_scan"):
        build_by_scan(GaussianMap(), room_scans(2))
