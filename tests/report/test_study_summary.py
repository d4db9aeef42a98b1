"""The summary of a study against means and intervals from scipy."""

import numpy as np
import pytest
from scipy import stats

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.team.report.trial_groups import study_summary

AUC = {"gmm_shared": [0.979, 0.98, 0.9755], "grid_shared": [0.979, 0.976, 0.975]}
T90 = {"gmm_shared": [198.0, 232.0, 240.0], "grid_shared": [249.0, 229.0, None]}


def rows(frameworks=tuple(AUC), **fields):
    return [
        {
            "framework": framework,
            "seed": seed,
            "auc": AUC[framework][seed],
            "t90": T90[framework][seed],
            "collisions": 0,
            "bytes_by_kind": {"components": 421_077} if framework == "gmm_shared" else {},
            **fields,
        }
        for framework in frameworks
        for seed in range(3)
    ]


def cells(text, title):
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {title} |")]
    return [cell.strip() for cell in line.strip("|").split("|")][1:]


def test_summary_gives_means_ranges_and_numbers_of_values():
    first = study_summary(rows()).split("\n\n")[0]
    assert first.splitlines()[0] == "| 3 seeds: mean (range) | E0 | E1 |"
    assert cells(first, "AUC, all observable cells") == ["0.978 (0.976 to 0.980)", "0.977 (0.975 to 0.979)"]
    assert cells(first, "t90 (s)") == ["223 (198 to 240)", "239 (229 to 249), 2 of 3"]
    assert cells(first, "collisions") == ["0", "0"]
    assert cells(first, "sent as components (kB)") == ["421", "–"]
    assert "overlap" not in first


def test_summary_differences_are_paired_intervals():
    second = study_summary(rows()).split("\n\n", 1)[1]
    difference = np.subtract(AUC["gmm_shared"], AUC["grid_shared"])
    low, high = stats.t.interval(0.95, 2, difference.mean(), stats.sem(difference))
    expected = f"{difference.mean():+.3f} ({low:+.3f} to {high:+.3f})".replace("-", "−")
    assert "| E0 − E1 |" in second
    assert cells(second, "AUC, all observable cells") == [expected]
    assert "t90" not in second  # a seed never reached it
    assert cells(second, "collisions") == ["0"]


def test_summary_pairs_seeds_in_any_order():
    shuffled = rows()
    assert cells(study_summary(shuffled[::-1]).split("\n\n", 1)[1], "AUC, all observable cells") != []
    one, other = study_summary(shuffled), study_summary([*shuffled[2::-1], *shuffled[3:]])
    assert one == other


def test_summary_compares_many_variants_with_the_first():
    lossy = [row for loss in (0.0, 0.1, 0.3, 0.5) for row in rows(("gmm_shared",), loss=loss)]
    text = study_summary(lossy)
    heads = [line for line in text.splitlines() if "−" in line and line.startswith("|  |")]
    assert heads == ["|  | 10 % lost − lossless | 30 % lost − lossless | 50 % lost − lossless |"]


def test_summary_escapes_vertical_bars_in_names():
    cut = {"begin": 60.0, "end": 120.0, "groups": [[0], [1, 2]]}
    text = study_summary([*rows(("gmm_shared",), partitions=[]), *rows(("gmm_shared",), partitions=[cut])])
    head, rule = text.splitlines()[:2]
    assert "partition 0 \\| 1 2" in head
    assert head.replace("\\|", "").count("|") == rule.count("|")


def test_summary_of_one_seed_has_no_differences():
    assert "Differences" not in study_summary([row for row in rows() if row["seed"] == 1])


def test_summary_needs_a_row():
    with pytest.raises(InvalidArgumentError, match="rows"):
        study_summary([])
