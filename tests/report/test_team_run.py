"""The figure of a team of processes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report.style import save_figure
from gmmtorch.team.report.mission_curves import team_run_figure


def row(robot: int, explores: bool = True, **changes: Any) -> dict[str, Any]:
    made = {
        "robot": robot,
        "digest": "ab",
        "times": [0.0, 10.0, 20.0],
        "records_over_time": [0.0, 50.0, 80.0 + robot],
        "bytes_by_kind": {"components": 4000 * (robot + 1), "plans": 1000, "announcements": 0},
    }
    if explores:
        made |= {"entropy_bits": [200.0, 120.0, 50.0 - robot], "observable_bits": 200.0}
    return {**made, **changes}


def test_team_run_draws_remaining_entropy_of_exploring_robots():
    left, right = team_run_figure([row(0), row(3)]).axes
    assert "remaining entropy" in left.get_ylabel()
    assert left.lines[1].get_xdata().tolist() == [0.0, 10.0, 20.0]
    assert left.lines[1].get_ydata().tolist() == [100.0, 60.0, 23.5]
    assert left.get_xlim() == (0.0, 20.0)  # lines end where their names are
    assert {text.get_text(): text.get_color() for text in left.texts} == {
        "0": left.lines[0].get_color(),
        "3": left.lines[1].get_color(),
    }
    assert [label.get_text() for label in right.get_yticklabels()] == ["robot 0", "robot 3"]


def test_team_run_draws_records_of_other_robots():
    left, _ = team_run_figure([row(0), row(1, explores=False)]).axes
    assert left.get_ylabel() == "number of records"
    assert left.lines[1].get_ydata().tolist() == [0.0, 50.0, 81.0]


def test_team_run_stacks_bytes_by_kind_without_empty_kinds():
    figure = team_run_figure([row(0), row(1)])
    _, right = figure.axes
    components, plans = right.containers
    assert [bar.get_width() for bar in components] == [4000, 8000]
    assert [bar.get_x() for bar in plans] == [4000, 8000]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["components", "plans"]
    assert [text.get_text().strip() for text in right.texts] == ["5.00 kB", "9.00 kB"]


@pytest.mark.parametrize(
    ("rows", "title"),
    [
        ([row(4)], "Robot 4"),
        ([row(0), row(1)], "2 robots with the same map"),
        ([row(0), row(1, digest="cd")], "2 robots with different maps"),
    ],
)
def test_team_run_title_compares_the_maps(rows, title):
    assert team_run_figure(rows).get_suptitle() == title


def test_team_run_accepts_silent_and_large_teams(tmp_path):
    silent = row(0, bytes_by_kind={}, times=[0.0], entropy_bits=[200.0])
    save_figure(team_run_figure([silent]), tmp_path / "silent.png")
    generator = np.random.default_rng(0)
    kinds = ("components", "counts", "supersessions", "corrections", "views", "plans", "announcements")
    many = [
        row(k, bytes_by_kind={kind: int(generator.integers(1, 90_000)) for kind in kinds}) for k in range(16)
    ]
    save_figure(team_run_figure(many), tmp_path / "many.png")
    with pytest.raises(InvalidArgumentError, match="rows is empty"):
        team_run_figure([])
