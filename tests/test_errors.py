"""The texts of errors."""

from __future__ import annotations

import pytest

from gmmtorch import errors
from gmmtorch.datasets.point_files.point_chunks import open_points

KINDS = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, Exception)]


@pytest.mark.parametrize("kind", KINDS)
def test_control_characters_are_escaped(kind):
    text = "\x1b]0;title\x07 \r\n \x9b31m \u202eabc \udcff Σ ← 3 m²"
    shown = r"\x1b]0;title\x07 \r\n \x9b31m \u202eabc \udcff Σ ← 3 m²"
    assert str(kind(text)) == shown
    assert kind(text).args == (text,)
    assert str(kind()) == ""


def test_a_hostile_file_name_does_not_reach_the_terminal(tmp_path):
    path = tmp_path / "a\x1b[2J\n.ply"
    path.write_bytes(b"ply\n")
    with pytest.raises(errors.DataError) as error:
        open_points(path)
    assert r"a\x1b[2J\n.ply has no header" in str(error.value)
