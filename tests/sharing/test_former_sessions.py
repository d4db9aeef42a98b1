"""Sessions of former starts: what is kept of them, and what it keeps off."""

from __future__ import annotations

import secrets

import pytest

from gmmtorch.errors import DataError, OutputError
from gmmtorch.sharing.former_sessions import MOST_SESSIONS, former_sessions, known_sessions


def test_each_start_knows_those_before_it(tmp_path):
    path = tmp_path / "kept" / "sessions_3"
    sessions = [secrets.token_bytes(8) for _ in range(5)]
    for n, session in enumerate(sessions):
        assert former_sessions(path, session) == frozenset(sessions[:n])
    assert former_sessions(path, sessions[-1]) == frozenset(sessions[:-1])  # told twice, it is kept once
    assert former_sessions(path, sessions[0]) == frozenset(sessions[1:])
    assert [one.name for one in path.parent.iterdir()] == ["sessions_3"]


def test_of_many_the_newest_are_kept(tmp_path):
    path = tmp_path / "sessions"
    sessions = [n.to_bytes(8, "little") for n in range(MOST_SESSIONS + 7)]
    data = b"GMMTSES1" + b"".join(sessions[:MOST_SESSIONS])
    path.write_bytes(data)
    for n in range(MOST_SESSIONS, MOST_SESSIONS + 7):
        assert former_sessions(path, sessions[n]) == frozenset(sessions[n - MOST_SESSIONS : n])
        assert path.stat().st_size == len(data)


@pytest.mark.parametrize(
    "data", [b"", b"GMMTSES", b"GMMTSES2" + bytes(8), b"GMMTSES1" + bytes(7), b"GMMTSES1" + bytes(8 * 1025)]
)
def test_a_file_that_is_something_else_is_named_and_left(tmp_path, data):
    path = tmp_path / "sessions"
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"sessions is damaged.*Remove it"):
        former_sessions(path, bytes(8))
    assert path.read_bytes() == data


def test_what_is_kept_is_known_without_a_word(tmp_path):
    path = tmp_path / "sessions_3"
    assert known_sessions(path) == frozenset()
    assert not path.exists()
    for session in (bytes(8), b"12345678"):
        former_sessions(path, session)
    assert known_sessions(path) == {bytes(8), b"12345678"}


def test_where_it_cannot_be_written_that_is_said(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    assert known_sessions(tmp_path / "file" / "sessions") == frozenset()
    with pytest.raises(OutputError, match="sessions cannot be written"):
        former_sessions(tmp_path / "file" / "sessions", bytes(8))
