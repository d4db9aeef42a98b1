"""The pages have the numbers that benchmarks/claims.py measures again, and it compares them."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def claims():
    sys.path.insert(0, str(BENCHMARKS))
    try:
        yield importlib.import_module("claims")
    finally:
        sys.path.remove(str(BENCHMARKS))


def test_every_page_has_the_text_of_its_claims_once(claims):
    for run in claims.RUNS.values():
        assert run.claims
        for claim in run.claims:
            found = claims.numbers(claim.text, claims.section(claim.page))
            if claim.read is not None:
                assert found, claim.text
            if not callable(claim.intervals):
                assert len(claim.intervals) == len(found), claim.text


def test_a_claim_holds_within_its_interval_only(claims, tmp_path):
    (tmp_path / "stdout").write_text("ratio 1,240.5\n")
    claim = claims.Claim(
        "README.md", "median # on these surface points", lambda out: [0.95], claims.within(0.05)
    )
    assert claims.checked(claim, tmp_path)[-1] == "yes"
    assert "0.7" in claims.checked(claim._replace(read=lambda out: [0.7]), tmp_path)[-1]
    assert "2 numbers" in claims.checked(claim._replace(read=lambda out: [0.95, 0.95]), tmp_path)[-1]
    assert claims.checked(claim, None)[-1].startswith("no")
    assert claims.checked(claim._replace(read=claims.published("t", ["x"], "y")), tmp_path)[-1].startswith(
        "no"
    )
    assert claims.checked(claim._replace(text="no such # text"), tmp_path)[-1].startswith("no")
    with pytest.raises(ValueError, match="not once"):
        claims.numbers("| intel | # m |", claims.section("README.md"))  # twice in the table


def test_numbers_of_a_text_a_table_and_rows_of_results(claims, tmp_path):
    assert claims.numbers("costs # dB … of # kB", "it costs −1,234.5 dB (most) of .25 kB") == [-1234.5, 0.25]
    claims.Table("", "", "", {"map": "", "AUC (kB)": ""}, [["a", "0.98 (8 kB)"], ["b", "0.99 (9)"]]).save(
        tmp_path / "sizes.json"
    )
    assert claims.published("sizes", ["b"], "AUC (kB)")(tmp_path) == [0.99, 9.0]
    rows = [
        {"team": name, "sent": sent} for name, sent in (("a", 1000), ("a", 3000), ("b", None), ("b", 500))
    ]
    (tmp_path / "results.json").write_text(json.dumps({"rows": rows}))
    assert claims.result("sent", 1e-3, team=("a", "b"))(tmp_path) == [2.0, 0.5]


def test_a_finished_run_is_not_repeated_and_a_failed_one_is_reported(claims, tmp_path, monkeypatch):
    monkeypatch.setitem(claims.RUNS, "once", claims.Run("echo again >> $OUT/count", []))
    monkeypatch.setitem(claims.RUNS, "broken", claims.Run("exit 3", []))
    for _ in range(2):
        assert claims.measure("once", tmp_path, tmp_path / "once", again=False)
    assert (tmp_path / "once" / "count").read_text() == "again\n"
    assert claims.measure("once", tmp_path, tmp_path / "once", again=True)
    assert (tmp_path / "once" / "count").read_text() == "again\nagain\n"
    assert not claims.measure("broken", tmp_path, tmp_path / "broken", again=False)
