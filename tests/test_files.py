"""Files are never half-written, and never believed before they are checked."""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save as save_tensors

from gmmtorch.errors import DataError, GmmTorchError, MissingDataError
from gmmtorch.files import pack_tensors, read_tensors, require, write_atomically, write_bytes, write_json

KIND, VERSION = "gmmtorch.test", 3


def sound_file() -> bytes:
    return pack_tensors({"x": torch.arange(4.0), "n": torch.tensor([1, 2])}, KIND, VERSION, note="ä", n=7)


def raw_file(header: object, body: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + body


def metadata(**changes: object) -> dict:
    return {"__metadata__": {"format": KIND, "version": str(VERSION), "facts": "{}", **changes}}


def write(folder: Path, data: bytes) -> Path:
    path = folder / "file.safetensors"
    path.write_bytes(data)
    return path


# -- writing --------------------------------------------------------------------------------------


def test_bytes_are_written_and_folders_made(tmp_path):
    path = write_bytes(tmp_path / "new" / "deeper" / "a.bin", b"content")
    assert path.read_bytes() == b"content"
    assert [p.name for p in path.parent.iterdir()] == ["a.bin"]


def test_writing_again_replaces(tmp_path):
    write_bytes(tmp_path / "a.bin", b"a longer first content")
    write_bytes(tmp_path / "a.bin", b"second")
    assert (tmp_path / "a.bin").read_bytes() == b"second"


@pytest.mark.parametrize("error", [OSError("disk full"), ValueError("bad"), KeyboardInterrupt()])
def test_failing_midway_leaves_the_old_file_and_no_other(tmp_path, error):
    path = write_bytes(tmp_path / "a.bin", b"old")

    def fail(temporary: Path) -> None:
        temporary.write_bytes(b"half")
        raise error

    with pytest.raises(type(error)):
        write_atomically(path, fail)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_failing_midway_leaves_no_new_file(tmp_path):
    def fail(temporary: Path) -> None:
        temporary.write_bytes(b"half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_atomically(tmp_path / "a.bin", fail)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_in_the_way_leaves_no_temporary(tmp_path):
    (tmp_path / "a.bin").mkdir()
    with pytest.raises(OSError):  # noqa: PT011 - which one depends on the system
        write_bytes(tmp_path / "a.bin", b"x")
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]


def test_the_old_file_is_whole_until_the_new_one_is(tmp_path):
    path = write_bytes(tmp_path / "a.txt", b"old")
    seen = []

    def slow(temporary: Path) -> None:
        temporary.write_bytes(b"new")
        seen.append((path.read_bytes(), temporary.suffix, temporary.parent))

    write_atomically(path, slow)
    assert seen == [(b"old", ".txt", tmp_path)]
    assert path.read_bytes() == b"new"


@pytest.mark.skipif(os.name != "posix", reason="file modes")
def test_others_can_read_what_was_written(tmp_path):
    path = write_bytes(tmp_path / "a.bin", b"x")
    assert stat.S_IMODE(path.stat().st_mode) == 0o644


def test_json_comes_back_and_nan_is_refused(tmp_path):
    value = {"auc": 0.5, "rows": [1, None, "ä"]}
    assert json.loads(write_json(tmp_path / "r.json", value).read_text()) == value
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(tmp_path / "r.json", {"auc": float("nan")})
    assert json.loads((tmp_path / "r.json").read_text()) == value


def test_the_same_content_is_the_same_bytes():
    assert len({sound_file() for _ in range(10)}) == 1


# -- reading --------------------------------------------------------------------------------------


def test_tensors_and_facts_come_back(tmp_path):
    tensors, facts = read_tensors(write(tmp_path, sound_file()), KIND, VERSION)
    assert torch.equal(tensors["x"], torch.arange(4.0))
    assert tensors["n"].tolist() == [1, 2]
    assert facts == {"note": "ä", "n": 7}


def test_tensors_that_are_views_come_back(tmp_path):
    value = torch.arange(12.0).reshape(3, 4).T[1:]
    tensors, _ = read_tensors(write(tmp_path, pack_tensors({"x": value}, KIND, VERSION)), KIND, VERSION)
    assert torch.equal(tensors["x"], value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(MissingDataError, match=r"nowhere\.safetensors does not exist.*gmmtorch\.test") as e:
        read_tensors(tmp_path / "nowhere.safetensors", KIND, VERSION)
    assert isinstance(e.value, FileNotFoundError)


def test_a_folder_is_not_a_file(tmp_path):
    with pytest.raises(MissingDataError, match="does not exist"):
        read_tensors(tmp_path, KIND, VERSION)


def test_a_file_cut_at_any_length_is_refused(tmp_path):
    data = sound_file()
    for length in range(len(data)):
        path = write(tmp_path, data[:length])
        with pytest.raises(DataError, match=r"file\.safetensors"):
            read_tensors(path, KIND, VERSION)


def test_trailing_bytes_are_refused(tmp_path):
    with pytest.raises(DataError):
        read_tensors(write(tmp_path, sound_file() + b"\0"), KIND, VERSION)


def test_another_kind_names_both(tmp_path):
    path = write(tmp_path, pack_tensors({}, "gmmtorch.other", VERSION))
    with pytest.raises(DataError, match=r"gmmtorch\.other.*gmmtorch\.test"):
        read_tensors(path, KIND, VERSION)


@pytest.mark.parametrize("version", [2, 4])
def test_another_version_names_both(tmp_path, version):
    path = write(tmp_path, pack_tensors({}, KIND, version))
    with pytest.raises(DataError, match=rf"version {version} .*version 3"):
        read_tensors(path, KIND, VERSION)


def test_someone_elses_safetensors_is_foreign(tmp_path):
    path = write(tmp_path, save_tensors({"x": torch.ones(2)}))
    with pytest.raises(DataError, match=r"expected 'gmmtorch\.test'"):
        read_tensors(path, KIND, VERSION)


@pytest.mark.parametrize(
    "data",
    [
        b"PK\x03\x04 a zip",
        b"VERSION .7\nFIELDS x y z\n" * 20,
        b"\xff" * 100,
        (1 << 63).to_bytes(8, "little") + b"{}",
        (1 << 40).to_bytes(8, "little") + b"{" * 50,
        raw_file([]),
        raw_file(7),
        raw_file({"__metadata__": []}),
        raw_file({"__metadata__": None}),
        raw_file(b"[" * 200_000),
        raw_file(b"\xff\xfe\xfa"),
        raw_file(metadata(facts=7)),
        raw_file(metadata(facts="{")),
        raw_file({**metadata(), "x": {"dtype": "F32", "shape": [1 << 62, 4], "data_offsets": [0, 0]}}),
        raw_file({**metadata(), "x": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}}, b"\0" * 4),
        raw_file({**metadata(), "x": {"dtype": "F32", "shape": [-1], "data_offsets": [0, 4]}}, b"\0" * 4),
        raw_file({**metadata(), "x": {"dtype": "F99", "shape": [1], "data_offsets": [0, 4]}}, b"\0" * 4),
        raw_file({**metadata(), "x": {"dtype": "F32", "shape": [1], "data_offsets": [4, 8]}}, b"\0" * 8),
    ],
)
def test_foreign_and_hostile_files_are_refused(tmp_path, data):
    with pytest.raises(DataError, match=r"file\.safetensors"):
        read_tensors(write(tmp_path, data), KIND, VERSION)


def test_facts_nested_too_deeply_are_refused(tmp_path):
    path = write(tmp_path, raw_file(metadata(facts="[" * 100_000)))
    with pytest.raises(DataError, match=r"file\.safetensors"):
        read_tensors(path, KIND, VERSION)


@pytest.mark.parametrize("dtype", ["F4", "F6_E2M3", "F6_E3M2", "F8_E8M0"])
def test_number_formats_that_torch_lacks_are_refused(tmp_path, dtype):
    # Formats that the safetensors specification has and this package never writes.
    header = {**metadata(), "x": {"dtype": dtype, "shape": [8], "data_offsets": [0, 8]}}
    bits = {"F4": 4, "F6_E2M3": 6, "F6_E3M2": 6, "F8_E8M0": 8}[dtype]
    header["x"]["data_offsets"] = [0, bits]
    try:
        tensors, _ = read_tensors(write(tmp_path, raw_file(header, b"\0" * bits)), KIND, VERSION)
    except DataError:
        return
    with pytest.raises(DataError):
        require(tensors, "x", (8,), torch.float32, "file.safetensors")


def test_a_file_larger_than_allowed_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr("gmmtorch.files.MAX_FILE_BYTES", 10)
    with pytest.raises(DataError, match="more than the 10"):
        read_tensors(write(tmp_path, sound_file()), KIND, VERSION)


def test_facts_of_any_size_come_back(tmp_path):
    bounds = [-1.2345678901234567 + i for i in range(100_000)]  # a fit of many iterations with tol=0
    path = write(tmp_path, pack_tensors({}, KIND, VERSION, bounds=bounds))
    assert read_tensors(path, KIND, VERSION)[1] == {"bounds": bounds}


@given(data=st.binary(max_size=300))
def test_random_bytes_raise_nothing_but_our_own_errors(tmp_path, data):
    with pytest.raises(GmmTorchError):
        read_tensors(write(tmp_path, data), KIND, VERSION)


@settings(max_examples=200)
@given(place=st.integers(0, 10**6), value=st.integers(0, 255), second=st.integers(0, 10**6))
def test_a_damaged_file_is_refused_or_read_never_worse(tmp_path, place, value, second):
    data = bytearray(sound_file())
    data[place % len(data)] = value
    data[second % len(data)] ^= 1 << (value % 8)
    try:
        tensors, facts = read_tensors(write(tmp_path, bytes(data)), KIND, VERSION)
    except GmmTorchError:
        return
    assert isinstance(facts, dict)
    assert all(isinstance(t, torch.Tensor) for t in tensors.values())


@given(facts=st.text(max_size=30))
def test_facts_are_a_table_or_refused(tmp_path, facts):
    path = write(tmp_path, raw_file(metadata(facts=facts)))
    try:
        found = read_tensors(path, KIND, VERSION)[1]
    except GmmTorchError:
        return
    assert isinstance(found, dict)


@pytest.mark.parametrize("facts", ["[]", "7", "null", '"text"', "true"])
def test_facts_that_are_no_table_are_refused(tmp_path, facts):
    with pytest.raises(DataError):
        read_tensors(write(tmp_path, raw_file(metadata(facts=facts))), KIND, VERSION)


# -- checking -------------------------------------------------------------------------------------


def test_a_tensor_that_fits_is_returned():
    x = torch.zeros(3, 2)
    assert require({"x": x}, "x", (None, 2), torch.float32, "f") is x


@pytest.mark.parametrize(
    ("tensor", "message"),
    [
        (None, "lacks the tensor 'x'"),
        (torch.zeros(3), "expected"),
        (torch.zeros(3, 3), "expected"),
        (torch.zeros(3, 2, 1), "expected"),
        (torch.zeros(3, 2, dtype=torch.float64), "float64"),
        (torch.zeros(3, 2, dtype=torch.int64), "int64"),
        (torch.full((3, 2), float("nan")), "NaN or infinite"),
        (torch.full((3, 2), float("inf")), "NaN or infinite"),
    ],
)
def test_a_tensor_that_does_not_fit_is_named(tensor, message):
    tensors = {} if tensor is None else {"x": tensor}
    with pytest.raises(DataError, match=f"map.bin.*{message}"):
        require(tensors, "x", (3, 2), torch.float32, "map.bin")
