"""Atomic writing, and checks of tensor files that are damaged, foreign or hostile."""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import save as save_tensors

from gmmtorch.errors import DataError, GmmTorchError, MissingDataError, OutputError
from gmmtorch.files import (
    joined_tensors,
    narrowest,
    pack_tensors,
    read_tensors,
    require,
    require_counts,
    split_tensors,
    unpack_tensors,
    with_checksum,
    write_atomically,
    write_bytes,
    write_json,
)

KIND, VERSION = "gmmtorch.test", 3


def valid_file() -> bytes:
    return pack_tensors({"x": torch.arange(4.0), "n": torch.tensor([1, 2])}, KIND, VERSION, note="ä", n=7)


def raw_file(header: object, body: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header, separators=(",", ":")).encode()
    data = len(text).to_bytes(8, "little") + text + body
    return with_checksum(data) if b"crc32" in data else data


def with_entry(value: str) -> dict[str, Any]:
    """A safetensors header whose gmmtorch entry is `value`."""
    return {"__metadata__": {"gmmtorch": value}}


def with_facts(facts: object) -> dict[str, Any]:
    entry = {"crc32": "00000000", "format": KIND, "version": VERSION, "facts": facts}
    return with_entry(json.dumps(entry, separators=(",", ":")))


def with_tensor(dtype: str, shape: list[int], offsets: list[int]) -> dict[str, Any]:
    return {**with_facts({}), "x": {"dtype": dtype, "shape": shape, "data_offsets": offsets}}


def write(folder: Path, data: bytes) -> Path:
    path = folder / "file.safetensors"
    path.write_bytes(data)
    return path


# -- writing --------------------------------------------------------------------------------------


def test_write_bytes_creates_folders_and_replaces_files(tmp_path):
    path = write_bytes(tmp_path / "new" / "deeper" / "a.bin", b"a longer first content")
    write_bytes(path, b"second")
    assert path.read_bytes() == b"second"
    assert [p.name for p in path.parent.iterdir()] == ["a.bin"]


@pytest.mark.parametrize("error", [OSError("disk full"), ValueError("bad"), KeyboardInterrupt()])
@pytest.mark.parametrize("exists", [True, False])
def test_failed_write_keeps_the_old_file_and_leaves_no_other(tmp_path, error, exists):
    path = tmp_path / "a.bin"
    if exists:
        write_bytes(path, b"old")

    def fail(temporary: Path) -> None:
        temporary.write_bytes(b"half")
        raise error

    with pytest.raises(type(error)):
        write_atomically(path, fail)
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == ([("a.bin", b"old")] if exists else [])


@pytest.mark.parametrize("call", ["open", "close"])
def test_an_interrupt_while_the_file_is_created_leaves_no_file(call, tmp_path, monkeypatch):
    """The interrupt arrives after the system has created the file, before Python knows that it exists."""
    real = getattr(os, call)

    def interrupted(*arguments: Any, **options: Any) -> int:
        real(*arguments, **options)
        raise KeyboardInterrupt

    monkeypatch.setattr(os, call, interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_bytes(tmp_path / "map.bin", b"new")
    assert not list(tmp_path.iterdir())


def test_old_file_is_complete_until_the_new_one_is(tmp_path):
    path = write_bytes(tmp_path / "a.txt", b"old")
    seen = []

    def observe(temporary: Path) -> None:
        temporary.write_bytes(b"new")
        seen.append((path.read_bytes(), temporary.suffix, temporary.parent))

    write_atomically(path, observe)
    assert seen == [(b"old", ".txt", tmp_path)]
    assert path.read_bytes() == b"new"


@pytest.fixture
def umask():
    """Sets the umask, and restores it after the test."""
    before = os.umask(0o022)
    yield os.umask
    os.umask(before)


@pytest.mark.skipif(os.name != "posix", reason="file modes")
@pytest.mark.parametrize(("mask", "expected"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_a_new_file_has_the_mode_of_the_umask_and_a_replaced_one_keeps_its_own(
    tmp_path, umask, mask, expected
):
    umask(mask)
    path = write_bytes(tmp_path / "a.bin", b"old")
    assert stat.S_IMODE(path.stat().st_mode) == expected
    for mode in (0o600, 0o640, 0o666):
        path.chmod(mode)
        write_bytes(path, b"new")
        assert (path.read_bytes(), stat.S_IMODE(path.stat().st_mode)) == (b"new", mode)


@pytest.mark.skipif(os.name != "posix", reason="symbolic links")
@pytest.mark.parametrize("exists", [True, False])
def test_write_through_a_link_replaces_its_target(tmp_path, exists):
    target, link = tmp_path / "maps" / "target.bin", tmp_path / "link.bin"
    target.parent.mkdir()
    if exists:
        target.write_bytes(b"old")
        target.chmod(0o600)
    (tmp_path / "second.bin").symlink_to("maps/target.bin")
    link.symlink_to("second.bin")
    assert write_bytes(link, b"new") == link
    assert link.is_symlink()
    assert os.readlink(link) == "second.bin"
    assert target.read_bytes() == b"new"
    assert not exists or stat.S_IMODE(target.stat().st_mode) == 0o600
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["link.bin", "maps", "second.bin", "target.bin"]


@pytest.mark.skipif(os.name != "posix", reason="special files")
@pytest.mark.parametrize(
    ("kind", "name"), [("folder", "folder"), ("fifo", "FIFO"), ("device", "device"), ("loop", "links")]
)
def test_what_is_not_a_regular_file_is_refused_and_stays(tmp_path, kind, name):
    path = tmp_path / "a.bin"
    if kind in ("fifo", "folder"):
        (os.mkfifo if kind == "fifo" else os.mkdir)(path)
    else:
        path.symlink_to("/dev/null" if kind == "device" else "a.bin")
    before = path.lstat()
    with pytest.raises(OutputError, match=rf"a\.bin cannot be written.*{name}.*another path"):
        write_bytes(path, b"x")
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]
    assert (path.lstat().st_ino, path.lstat().st_mode) == (before.st_ino, before.st_mode)


def test_write_json_round_trips_and_rejects_nan(tmp_path):
    value = {"auc": 0.5, "rows": [1, None, "ä"]}
    assert json.loads(write_json(tmp_path / "r.json", value).read_text()) == value
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(tmp_path / "r.json", {"auc": float("nan")})
    assert json.loads((tmp_path / "r.json").read_text()) == value


def test_equal_content_gives_equal_bytes():
    assert len({valid_file() for _ in range(10)}) == 1


# -- reading --------------------------------------------------------------------------------------


def test_tensors_and_facts_round_trip(tmp_path):
    tensors, facts = read_tensors(write(tmp_path, valid_file()), KIND, VERSION)
    assert torch.equal(tensors["x"], torch.arange(4.0))
    assert tensors["n"].tolist() == [1, 2]
    assert facts == {"note": "ä", "n": 7}
    view = torch.arange(12.0).reshape(3, 4).T[1:]
    bounds = [-1.2345678901234567 + i for i in range(100_000)]  # a fit of many iterations with tol=0
    data = pack_tensors({"x": view}, KIND, VERSION, bounds=bounds)
    tensors, facts = unpack_tensors(data, "a.safetensors", KIND, VERSION)
    assert torch.equal(tensors["x"], view)
    assert facts == {"bounds": bounds}


def test_missing_file_and_folder_are_named(tmp_path):
    with pytest.raises(MissingDataError, match=r"nowhere\.safetensors does not exist.*gmmtorch\.test") as e:
        read_tensors(tmp_path / "nowhere.safetensors", KIND, VERSION)
    assert isinstance(e.value, FileNotFoundError)
    with pytest.raises(MissingDataError, match="does not exist"):
        read_tensors(tmp_path, KIND, VERSION)


def test_every_damage_is_refused():
    """A truncated or extended file, and one with a flipped bit."""
    data = valid_file()
    damaged = [*(data[:length] for length in range(len(data))), data + b"\0"]
    for place in range(8 * len(data)):
        damaged.append(
            data[: place // 8] + bytes([data[place // 8] ^ 1 << place % 8]) + data[place // 8 + 1 :]
        )
    for one in damaged:
        with pytest.raises(DataError, match=r"file\.safetensors"):
            unpack_tensors(one, "file.safetensors", KIND, VERSION)


UNCHECKED = json.dumps({"format": KIND, "version": VERSION, "facts": {}})


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (pack_tensors({}, "gmmtorch.other", VERSION), r"gmmtorch\.other.*gmmtorch\.test"),
        (pack_tensors({}, KIND, 2), "version 2 .*version 3"),
        (pack_tensors({}, KIND, 4), "version 4 .*version 3"),
        (save_tensors({"x": torch.ones(2)}), r"expected 'gmmtorch\.test'"),
        (
            save_tensors({"x": torch.ones(2)}, {"gmmtorch": UNCHECKED}),
            r"file\.safetensors has no checksum.*write the file again",
        ),
        (pack_tensors({"x": torch.ones([1] * 70)}, KIND, VERSION), "more than 8 dimensions"),
    ],
)
def test_what_is_wrong_with_a_file_is_named(tmp_path, data, message):
    with pytest.raises(DataError, match=message):
        read_tensors(write(tmp_path, data), KIND, VERSION)


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
        raw_file(with_entry("{")),
        raw_file(with_entry("[]")),
        raw_file(with_entry("[" * 100_000)),
        *(raw_file(with_facts(facts)) for facts in ([], 7, None, "text", True)),
        raw_file(with_tensor("F32", [1 << 62, 4], [0, 0])),
        raw_file(with_tensor("F32", [2], [0, 8]), b"\0" * 4),
        raw_file(with_tensor("F32", [-1], [0, 4]), b"\0" * 4),
        raw_file(with_tensor("F99", [1], [0, 4]), b"\0" * 4),
        raw_file(with_tensor("F32", [1], [4, 8]), b"\0" * 8),
    ],
)
def test_foreign_and_hostile_files_are_rejected(tmp_path, data):
    with pytest.raises(DataError, match=r"file\.safetensors"):
        read_tensors(write(tmp_path, data), KIND, VERSION)


@pytest.mark.parametrize(("dtype", "bytes_of_eight"), [("F4", 4), ("F6_E2M3", 6), ("F8_E8M0", 8)])
def test_dtypes_that_the_package_never_writes_are_rejected(tmp_path, dtype, bytes_of_eight):
    data = raw_file(with_tensor(dtype, [8], [0, bytes_of_eight]), b"\0" * bytes_of_eight)
    try:
        tensors, _ = read_tensors(write(tmp_path, data), KIND, VERSION)
    except DataError:
        return
    with pytest.raises(DataError):
        require(tensors, "x", (8,), torch.float32, "file.safetensors")


def test_file_above_the_size_limit_is_rejected(tmp_path, monkeypatch):
    monkeypatch.setattr("gmmtorch.files.MAX_FILE_BYTES", 10)
    with pytest.raises(DataError, match="more than the limit of 10"):
        read_tensors(write(tmp_path, valid_file()), KIND, VERSION)


@given(data=st.binary(max_size=300))
def test_random_bytes_raise_only_package_errors(tmp_path, data):
    with pytest.raises(GmmTorchError):
        read_tensors(write(tmp_path, data), KIND, VERSION)


# -- checking -------------------------------------------------------------------------------------


def test_require_returns_a_matching_tensor():
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
def test_require_names_a_tensor_that_does_not_match(tensor, message):
    tensors = {} if tensor is None else {"x": tensor}
    with pytest.raises(DataError, match=f"map.bin.*{message}"):
        require(tensors, "x", (3, 2), torch.float32, "map.bin")


@pytest.mark.parametrize(
    ("largest", "dtype"),
    [
        (0, torch.uint8),
        (255, torch.uint8),
        (256, torch.int16),
        (1 << 15, torch.int32),
        (1 << 31, torch.int64),
    ],
)
def test_counts_round_trip_in_the_narrowest_dtype(largest, dtype):
    stored = narrowest(torch.tensor([0, largest]))
    assert stored.dtype == dtype
    assert require_counts({"n": stored}, "n", (2,), "f").tolist() == [0, largest]
    with pytest.raises(DataError, match="negative"):
        require_counts({"n": torch.tensor([-1, 2])}, "n", (2,), "f")


def test_joined_tensors_inverts_split_tensors():
    value = {"a": [torch.ones(2), 3], "b": {"c": torch.zeros(1), "d": None}}
    tree, tensors = split_tensors(value)
    json.dumps(tree)
    joined = joined_tensors(tree, tensors)
    assert joined["b"]["d"] is None
    assert joined["a"][1] == 3
    assert torch.equal(joined["a"][0], value["a"][0])
    assert torch.equal(joined["b"]["c"], value["b"]["c"])
    with pytest.raises(KeyError):
        joined_tensors(tree, {})
