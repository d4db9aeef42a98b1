"""Whatever ends a write, the former file or the new one is whole; a full disk is an error of one line."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from own_process import answer_of

from gmmtorch.errors import OutputError
from gmmtorch.files import write_json

pytest.importorskip("rosbags")


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_kills_and_full_disks_leave_a_whole_file():
    found = answer_of("kill_writes")
    assert len(found) == 10
    for name, counts in found.items():
        gone = name == "merged tiles"  # a merge that is stopped leaves no map; its parts are still there
        expected = {"gone", "finished"} if gone else {"killed, version 0", "full", "finished"}
        assert expected <= counts.keys() <= {*expected, "killed, version 1"}, name


def test_a_folder_that_is_read_only_is_an_error_that_names_the_file(tmp_path, monkeypatch):
    """Permissions do not stop the superuser, so the system's answer is made."""
    (tmp_path / "a.json").write_text("1")

    def refuse(path: Path, *_: object) -> int:
        raise OSError(30, "Read-only file system", str(path))

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(OutputError, match=r"a\.json cannot be written: Read-only file system; choose"):
        write_json(tmp_path / "a.json", 2)
    assert (tmp_path / "a.json").read_text() == "1"
