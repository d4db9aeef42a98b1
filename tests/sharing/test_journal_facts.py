"""The facts of a journal: what is kept is compared, and what is no facts is refused."""

from __future__ import annotations

import json

import pytest

from gmmtorch.errors import DataError, InvalidArgumentError, OutputError
from gmmtorch.sharing.journal_facts import check_facts, keep_facts

FACTS = {"source": "world", "world": "mesh", "world.size": (50.0, 40.0), "seed": 0, "none": None}


def test_the_same_facts_are_right_and_others_are_named(tmp_path):
    path = tmp_path / "kept" / "facts.json"
    check_facts(path, FACTS)
    keep_facts(path, FACTS)
    check_facts(path, FACTS)
    with pytest.raises(
        InvalidArgumentError, match=r"path=.*seed was 0 and is 1, world was mesh and is mine\. "
    ):
        check_facts(path, {**FACTS, "seed": 1, "world": "mine"})
    with pytest.raises(InvalidArgumentError, match="more was null and is 1"):
        check_facts(path, {**FACTS, "more": 1})
    keep_facts(path, {"source": "log"})  # what is there stays
    check_facts(path, FACTS)
    assert [file.name for file in path.parent.iterdir()] == ["facts.json"]


def about(**changed: object) -> bytes:
    return json.dumps(
        {"format": "gmmtorch.journal_facts", "version": 1, "facts": {"a": 1}, **changed}
    ).encode()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff{",
        b"[]",
        b"[" * 5000,
        about(version=2),
        about(format="gmmtorch.map"),
        about(facts=[1]),
        about(facts={}),
        about() + b" " * (1 << 16),
        b'{"format": "gmmtorch.journal_facts", "version": 1}',
    ],
)
def test_a_file_that_is_something_else_is_named_and_left(tmp_path, data):
    path = tmp_path / "facts.json"
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"facts.json is damaged.*Remove it"):
        check_facts(path, FACTS)
    keep_facts(path, FACTS)
    assert path.read_bytes() == data


def test_what_a_file_says_is_shown_in_one_short_line(tmp_path):
    path = tmp_path / "facts.json"
    path.write_bytes(about(facts={"a": "\x1b[2J\n" + "long" * 1000, "b\n": [1] * 1000}))
    with pytest.raises(InvalidArgumentError) as caught:
        check_facts(path, {"a": 1})
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 500


def test_where_it_cannot_be_written_that_is_said(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OutputError, match=r"facts.json cannot be written"):
        keep_facts(tmp_path / "file" / "facts.json", FACTS)
