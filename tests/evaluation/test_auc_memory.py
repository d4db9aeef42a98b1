"""AUC against bytes: the rows match those of `evaluate`, with sizes."""

from __future__ import annotations

from evaluation.pillar_room import room_scans

from gmmtorch.experiments.evaluation.held_out import Form, MapFactory, Protocol, evaluate, methods
from gmmtorch.experiments.studies import map_studies
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import WindowedRule

PROTOCOL = Protocol(test_every=4, resolution=(0.2,))


def sized_map(n: int) -> MapFactory:
    return Form(lambda: GaussianMap(window=5, learning=WindowedRule(n_components=n)), "point")


def test_every_sized_method_has_a_row():
    scans = room_scans(12)
    grid = methods(GaussianMap)["occupancy_grid"]
    sized = {("point", 4): sized_map(4), ("point", 12): sized_map(12), ("grid", None): grid}
    counts: list[int] = []
    rows = map_studies.run_auc_memory(
        "room", scans, sized, PROTOCOL, on_rows=lambda rows: counts.append(len(rows))
    )
    assert [(row["method"], row["size"]) for row in rows] == [("point", 4), ("point", 12), ("grid", None)]
    assert counts == [1, 2, 3]
    assert rows[0]["nbytes"] < rows[1]["nbytes"]
    assert rows[0]["n_components"] < rows[1]["n_components"]
    (expected,) = evaluate("room", scans, {"grid": grid}, PROTOCOL).rows
    assert rows[2]["auc"] == expected["auc"]
    assert rows[2]["nbytes"] == expected["nbytes"]
