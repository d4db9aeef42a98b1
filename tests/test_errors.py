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


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("noise=-1 must be above 0.", ("noise", "-1", "must be above 0.", None)),
        ("weights[1]=-1.0 must be at least 0.", ("weights", "-1.0", "must be at least 0.", None)),
        ("‹start›[1]=[nan, 0] is bad; move it.", ("start", "[nan, 0]", "is bad", "move it.")),
        ("motion=imu cannot be used: it has none.", ("motion", "imu", "cannot be used: it has none.", None)),
        (
            "tol=-1: The 'tol' parameter of X must be a float.",
            ("tol", "-1", "The 'tol' parameter of X must be a float.", None),
        ),
        ("a.ply has no header.", (None, None, None, None)),
    ],
)
def test_the_text_of_an_error_has_parts(text, parts):
    error = errors.InvalidArgumentError(text)
    assert (error.argument, error.value, error.fault, error.remedy) == parts


def test_an_error_has_the_parts_of_its_text_and_can_name_options():
    error = errors.InvalidArgumentError.of("poses", "x", "is neither tf nor a file", "choose ‹poses›=tf")
    assert str(error) == "poses=x is neither tf nor a file; choose poses=tf."
    assert (error.argument, error.value) == ("poses", "x")
    assert (error.fault, error.remedy) == ("is neither tf nor a file", "choose poses=tf.")
    told = error.told({"poses": "dataset.poses"})
    assert str(told) == "dataset.poses=x is neither tf nor a file; choose dataset.poses=tf."
    plain = errors.InvalidArgumentError("noise=-1 must be above 0, or ‹window›=3.")
    assert str(plain.told({"noise": "map.noise"})) == "map.noise=-1 must be above 0, or window=3."
    assert str(plain.told({"noise": "a.noise"}).told({"window": "a.window"})).endswith("or a.window=3.")
    outer = errors.DataError(f"file: {plain}")
    assert outer.argument is None
    assert str(outer.told({"window": "map.window"})) == "file: noise=-1 must be above 0, or map.window=3."


def test_the_middle_of_a_very_long_text_is_left_out():
    error = errors.DataError(f"a.csv: {'9' * 10**6} is no number; correct it.")
    assert len(str(error)) < 10_000
    assert str(error).startswith("a.csv: 999")
    assert str(error).endswith("is no number; correct it.")
    assert len(str(errors.DataError(f"b.csv: {error}"))) < 10_000
