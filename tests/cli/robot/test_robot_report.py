"""RobotReport: displays that fail are switched off."""

from __future__ import annotations

import io
import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cli.command_runs import Disk, as_it_was, composed

from gmmtorch.cli import common
from gmmtorch.errors import OutputError
from gmmtorch.files import write_bytes
from gmmtorch.team.cli.robot_report import Outputs, RobotReport, print_refusals, terse


class Toy:
    """A robot view with fixed values."""

    robot = 3

    def status(self) -> str:
        return "all is well"

    def scalars(self) -> dict[str, float]:
        return {"records": 5.0, "refused": 0.0}


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Broken(Terminal):
    def write(self, text: str) -> int:
        raise OSError(28, "No space left on device")


@pytest.fixture
def log(caplog: pytest.LogCaptureFixture) -> Iterator[pytest.LogCaptureFixture]:
    with as_it_was(), caplog.at_level(logging.WARNING):
        yield caplog


def report(folder: Path, *options: str) -> RobotReport:
    toy: Any = Toy()
    return RobotReport(composed("robot", "evaluation.every=1", *options), toy, folder)


def test_log_records_have_their_own_lines(log, tmp_path, monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    written = logging.StreamHandler(terminal)  # a terminal shows both
    logging.getLogger().addHandler(written)
    handlers = list(common.logger.handlers)
    try:
        with report(tmp_path, "report.tensorboard=false") as shown:
            shown(0.0)
            shown(1.0)
            logging.getLogger("gmmtorch.team.sharing.transport.udp").warning("one")
            logging.getLogger("gmmtorch").warning("two")
            shown(2.0)
    finally:
        logging.getLogger().removeHandler(written)
    line = "robot 3  {:6.0f} s  all is well"
    assert terminal.getvalue() == (f"\r{line.format(0)}\r{line.format(1)}\none\ntwo\n\r{line.format(2)}\n")
    assert common.logger.handlers == handlers


def test_a_terminal_that_fails_is_switched_off(log, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stderr", Broken())
    with report(tmp_path, "report.tensorboard=false") as shown:
        for now in range(4):
            shown(float(now))
        shown.finish(4.0)
    assert [record.getMessage() for record in log.records] == [
        "report.progress is switched off, and the robot continues: [Errno 28] No space left on device"
    ]
    assert shown.series["records_over_time"] == [5.0] * 5


@pytest.mark.parametrize("when", ["at the start", "in between", "in the end"])
def test_a_failing_tensorboard_is_logged_once(when, log, tmp_path, capsys):
    if when == "at the start":
        (tmp_path / "tensorboard").write_text("no folder")
    with Disk() as disk, terse(), report(tmp_path, "report.progress=false") as shown:
        shown(0.0)
        if when == "in between":
            disk.fill()
        for now in range(1, 30):
            shown(float(now))
        if when == "in the end":
            disk.fill()
            shown.finish(30.0)
    (record,) = log.records
    assert record.getMessage().startswith("report.tensorboard is switched off, and the robot continues: ")
    assert len(shown.series["times"]) >= 30
    assert capsys.readouterr().err == ""


def test_without_standard_error_there_is_no_status_line(log, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    with report(tmp_path, "report.tensorboard=false") as shown:
        shown(0.0)
    assert not log.records


def test_refusals_are_printed_with_their_reasons(capsys):
    rows = [
        {"robot": 0, "refused": {}},
        {"robot": 1, "refused": {"wrong_key": 1200, "replayed": 2}},
        {"robot": 2, "refused": {"foreign": 1}},
    ]
    print_refusals(rows)
    one, two = capsys.readouterr().out.splitlines()
    assert one.startswith("robot 1 refused 1,202 frames: 1,200 wrong_key, 2 replayed; compare link.key_file")
    assert "$GMMTORCH_TEAM_KEY" in one
    assert two == "robot 2 refused 1 frames: 1 foreign"


def test_every_file_is_written_and_failures_are_named(tmp_path):
    (tmp_path / "taken").mkdir()

    def fails(path: Path) -> None:
        raise OSError(28, "No space left on device")

    outputs = Outputs(tmp_path)
    outputs.check()
    assert outputs.written("one", fails) is None
    assert outputs.written("two", lambda path: write_bytes(path, b"2")) == tmp_path / "two"
    assert outputs.written("three", fails) is None
    assert outputs.written("taken", lambda path: write_bytes(path, b"4")) is None
    with pytest.raises(OutputError) as caught:
        outputs.check()
    assert str(caught.value).startswith(
        f"hydra.run.dir={tmp_path} does not contain all results: one, three (No space left on device); taken"
    )
    assert (tmp_path / "two").read_bytes() == b"2"
