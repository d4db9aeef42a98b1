"""Tables, byte texts and progress bars."""

from __future__ import annotations

import pytest

from gmmtorch.report.text import ProgressBars, byte_text, format_table, format_value, ratio_text


def test_table_is_aligned():
    rows = [
        {"method": "monte_carlo", "auc": 0.97654, "n_components": 12670, "nbytes": 28_100, "kept": 0.3},
        {"method": "occupancy_grid", "auc": 1, "n_components": None, "nbytes": 1_250_000, "kept": 1.0},
    ]
    assert format_table(rows).splitlines() == [
        "method             auc  n_components   nbytes  kept",
        "--------------  ------  ------------  -------  ----",
        "monte_carlo     0.9765        12,670  28.1 kB   0.3",
        "occupancy_grid  1.0000             -  1.25 MB     1",
    ]


def test_table_selects_columns_and_shows_missing_values_as_dashes():
    rows = [{"b": 1, "a": "x"}, {"a": "longer"}]
    assert format_table(rows, ["a", "b", "c"]) == ("a       b  c\n------  -  -\nx       1  -\nlonger  -  -")
    assert format_table(rows).splitlines()[0] == "b  a"
    assert format_table([]) == ""
    assert format_table([], ["a", "bc"]) == "a  bc\n-  --"


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("unknown_auc", 0.5, "0.5000"),
        ("brier", 0.01234, "0.0123"),
        ("seconds", 12.3456, "12.35"),
        ("log_likelihood", -1.5, "-1.5"),
        ("auc", float("nan"), "nan"),
        ("auc", None, "-"),
        ("n_points", 1136597, "1,136,597"),
        ("bytes_sent", 999, "999 B"),
        ("converged", True, "yes"),
        ("times", [1.0, 2.0], "[2 values]"),
        ("path", "two\nlines", "two lines"),
    ],
)
def test_values_are_formatted_by_their_column(name, value, text):
    assert format_value(name, value) == text


@pytest.mark.parametrize(
    ("n_bytes", "text"),
    [
        (0, "0 B"),
        (999, "999 B"),
        (1000, "1.00 kB"),
        (28_100, "28.1 kB"),
        (99_960, "100 kB"),
        (999_499, "999 kB"),
        (999_600, "1.00 MB"),
        (5e15, "5000 TB"),
    ],
)
def test_bytes_have_si_units(n_bytes, text):
    assert byte_text(n_bytes) == text


def test_tick_bytes_and_ratios_have_few_digits():
    assert [byte_text(v, digits=1) for v in (1e4, 1e6, 1e8)] == ["10 kB", "1 MB", "100 MB"]
    assert [ratio_text(v) for v in (58.04, 3.0, 123.4, 0.5, 0)] == [
        "58.0×",
        "3.00×",
        "123×",
        "0.500×",
        "0.00×",
    ]


def test_progress_bars_open_and_close_with_stages(capsys):
    with ProgressBars() as progress:
        progress("fit", 0, 3)
        progress("query", 1, None)
        assert progress.stages == ("fit", "query")
        progress("fit", 3, 3)
        assert progress.stages == ("query",)
        progress("fit", 2, 3)  # begins again
        progress("fit", 1, 3)  # and again
        progress("nothing", 0, 0)
        assert progress.stages == ("query", "fit")
    assert progress.stages == ()
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "fit" in captured.err


def test_progress_bars_close_on_errors_and_can_be_disabled(capsys):
    progress = ProgressBars()

    def work():
        with progress:
            progress("fit", 1, 3)
            raise KeyError

    with pytest.raises(KeyError):
        work()
    assert progress.stages == ()
    capsys.readouterr()
    with ProgressBars(enabled=False) as progress:
        progress("fit", 1, 3)
    captured = capsys.readouterr()
    assert captured.out + captured.err == ""
