"""Cases write tables of results, from which the tables of the pages are made."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import pytest

from gmmtorch.experiments import harness

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def loaded():
    """Loads a script of the benchmarks."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        yield importlib.import_module
    finally:
        sys.path.remove(str(ROOT / "benchmarks"))


@pytest.fixture
def run(loaded, tmp_path, monkeypatch):
    """Runs cases with words of a command line; returns the tables that they write, by name."""
    monkeypatch.setenv("GMMTORCH_TABLES", str(tmp_path))
    monkeypatch.delenv("GMMTORCH_DATA", raising=False)

    def run(*cases, words="", **arguments):
        monkeypatch.setattr(sys, "argv", ["benchmarks/some.py", *words.split()])
        harness.run("About the cases.", *cases, **arguments)
        return {path.stem: json.loads(path.read_text()) for path in tmp_path.glob("*.json")}

    return run


def test_pages_have_the_tables_of_the_results(loaded):
    pages = loaded("pages")
    for page in (ROOT / "README.md", ROOT / "BENCHMARKS.md", *(ROOT / "docs").rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        assert pages.filled(text) == text, f"{page.name}: run benchmarks/pages.py"


def test_tables_that_pages_show_in_part_have_the_rows(loaded):
    pages = loaded("pages")
    for name, chosen in pages.SHOWN.items():
        texts = harness.Table.load(pages.RESULTS / f"{name}.json").texts()
        for column, values in chosen.items():
            assert set(values) <= {row[column] for row in texts}, name


def test_a_table_comes_back_from_its_file_and_shows_its_cells(loaded, tmp_path):
    table = harness.Table(
        "µ", "c", "h", {"name": "", "n": "{:.1f} mm", "s": "3"}, [["a", 1.26, 12345.0], ["b", None, "–"]]
    )
    table.save(tmp_path / "t.json")
    assert harness.Table.load(tmp_path / "t.json") == table
    rows = table.markdown().splitlines()[2:]
    assert rows == ["| a | 1.3 mm | 12,300 |", "| b |  | – |"]
    assert table.markdown({"name": ("b",)}).splitlines()[2:] == rows[1:]


def test_a_part_that_is_measured_again_replaces_its_rows_only(loaded, run):
    case = harness.Case
    values = iter((1.0, 2.0, 3.0, 4.0, 5.0))

    def measure(options):
        options.about = f"With {options.threads} thread(s)."
        for name in options.names:
            yield {"data": name, "score": next(values)}

    some = case("some", measure, "Scores.", {"score": ".1f"}, ("a", "b"), needs_data=False)
    found = run(some)["some"]
    assert found["about"] == "With 1 thread(s). Scores."
    assert found["command"] == "python benchmarks/some.py"
    assert found["rows"] == [["a", 1.0], ["b", 2.0]]
    assert run(some, words="--names b")["some"]["rows"] == [["a", 1.0], ["b", 3.0]]
    seeds = {"seed": {"type": int, "default": 0}}
    only_b = some._replace(data=("b",))
    assert run(only_b, words="--seed 1", **seeds)["some"]["rows"] == [["a", 1.0], ["b", 4.0]]
    assert run(only_b, **seeds)["some"]["rows"] == [["b", 5.0]], "a whole run leaves no other rows"


def test_the_file_is_named_after_threads_and_its_rows_are_written_one_by_one(loaded, run):
    def measure(options):
        yield {"n": 1.0}
        raise ValueError("stopped")

    case = harness.Case("some-{threads}{gpu}", measure, needs_data=False)
    with pytest.raises(ValueError, match="stopped"):
        run(case, words="--threads 2")
    assert run(case._replace(measure=lambda options: ()))["some-2"]["rows"] == [[1.0]]


def test_a_case_with_recordings_needs_their_folder(loaded, run, capsys):
    case = harness.Case("some", lambda options: ())
    with pytest.raises(SystemExit):
        run(case)
    assert "GMMTORCH_DATA" in capsys.readouterr().err


def sixth(value):
    return {"value": value / 6}


def test_work_in_a_process_of_its_own_returns_its_result_or_its_error(loaded):
    alone = harness.alone
    assert alone(sixth, 3.0) == {"value": 0.5}
    assert "TypeError" in alone(sixth, "x")["error"]
