"""GIRA's CSV files and NPZ archives of mixtures: round trips and damaged files."""

from __future__ import annotations

import contextlib
import io
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError, NumericalError
from gmmtorch.export import PlainMixture, mixture_formats, read_gira_csv, read_npz, write_gira_csv, write_npz


def random_mixture(
    k: int = 4, dim: int = 3, seed: int = 0, thin: float = 1e-3, offset: float = 0.0
) -> PlainMixture:
    """Components with a thickness of `thin` metres in a random direction."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    axes = torch.linalg.qr(normal(k, dim, dim)).Q
    deviations = torch.rand(k, dim, dtype=torch.float64, generator=generator) + 0.1
    deviations[:, 0] = thin
    covariances = axes @ torch.diag_embed(deviations**2) @ axes.mT
    support = torch.rand(k, dtype=torch.float64, generator=generator) * 100 + 1
    return PlainMixture.of_support(normal(k, dim) + offset, (covariances + covariances.mT) / 2, support)


def assert_same(found: PlainMixture, expected: PlainMixture) -> None:
    for name in ("weights", "means", "covariances"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-15, atol=0)


@given(st.integers(1, 6), st.integers(1, 4), st.integers(0, 99), st.sampled_from([1e-6, 1e-3, 10.0]))
def test_gira_csv_round_trip_is_exact(tmp_path, k, dim, seed, thin):
    given_mixture = random_mixture(k, dim, seed, thin, offset=5e5)
    path = write_gira_csv(tmp_path / "gira.csv", given_mixture)
    found = read_gira_csv(path)
    assert_same(found, given_mixture)
    assert found.support is None
    counted = read_gira_csv(path, n_points=float(given_mixture.support.sum()))
    torch.testing.assert_close(counted.support, given_mixture.support)


@given(st.integers(1, 6), st.integers(1, 4), st.integers(0, 99))
def test_npz_round_trip_is_exact(tmp_path, k, dim, seed):
    given_mixture = random_mixture(k, dim, seed)
    found = read_npz(write_npz(tmp_path / "m.npz", given_mixture))
    assert_same(found, given_mixture)
    assert torch.equal(found.support, given_mixture.support)


def test_gira_csv_rows_are_mean_covariance_weight(tmp_path):
    """GIRA's loader splits lines at commas and takes 3, 9 and 1 columns."""
    given_mixture = random_mixture()
    lines = write_gira_csv(tmp_path / "gira.csv", given_mixture).read_text().splitlines()
    values = np.array([[float(cell) for cell in line.split(",")] for line in lines])
    assert values.shape == (4, 13)
    np.testing.assert_array_equal(values[:, :3], given_mixture.means)
    np.testing.assert_array_equal(values[:, 3:12], given_mixture.covariances.mT.reshape(4, 9))
    np.testing.assert_array_equal(values[:, 12], given_mixture.weights)


def test_gira_csv_reader_accepts_files_of_gira(tmp_path):
    """Eigen writes six digits, a comma and a space, and no line end after the last row."""
    path = tmp_path / "gira.csv"
    path.write_text(
        "1, 2, 3, 0.04, 0, 0, 0, 0.09, 0, 0, 0, 0.01, 0.25\n-1, 0, 1e1, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0.75"
    )
    found = read_gira_csv(path)
    assert found.means.tolist() == [[1, 2, 3], [-1, 0, 10]]
    assert found.covariances[0].tolist() == [[0.04, 0, 0], [0, 0.09, 0], [0, 0, 0.01]]
    assert found.weights.tolist() == [0.25, 0.75]


def test_npz_opens_with_numpy_without_pickle(tmp_path):
    given_mixture = random_mixture()
    with np.load(write_npz(tmp_path / "m.npz", given_mixture), allow_pickle=False) as stored:
        assert sorted(stored) == ["covariances", "means", "support", "weights"]
        assert {stored[name].dtype for name in stored} == {np.dtype("float64")}
    with np.load(write_npz(tmp_path / "m.npz", given_mixture._replace(support=None))) as stored:
        assert "support" not in stored


def test_npz_weights_are_normalized(tmp_path):
    given_mixture = random_mixture()
    path = write_npz(tmp_path / "m.npz", given_mixture._replace(weights=given_mixture.weights * 1000))
    torch.testing.assert_close(read_npz(path).weights, given_mixture.weights)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "has 0 rows"),
        ("\n\n", "has 0 rows"),
        ("1,2,3,4\n", "1 rows of 4 numbers"),
        ("mean,cov,weight\n1,1,1\n", "comma-separated numbers"),
        ("1,1,1\n1,1\n", "comma-separated numbers"),
        ("1,nan,1\n", "not contain a valid mixture"),
        ("inf,1,1\n", "means holds NaN or infinite"),
        ("1,1,-1\n", "weights must be finite and at least zero"),
        ("1,1,0\n", "weights must be finite and at least zero"),
        ("1,-1,1\n", "not positive definite"),
        ("0,0,1,0.5,0.4,1,1\n", "not symmetric"),
        ("é,1,1\n", "comma-separated numbers"),
    ],
)
def test_gira_csv_reader_rejects_damaged_files(content, message, tmp_path):
    path = tmp_path / "broken.csv"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(DataError, match=message) as caught:
        read_gira_csv(path)
    assert "broken.csv" in str(caught.value)


def npz_of(path: Path, **arrays: np.ndarray) -> Path:
    np.savez(path, **arrays)
    return path


def test_npz_reader_rejects_damaged_files(tmp_path):
    sound = {k: v.numpy() for k, v in random_mixture()._asdict().items()}
    path = tmp_path / "broken.npz"
    with pytest.raises(DataError, match="lacks covariances"):
        read_npz(npz_of(path, weights=sound["weights"], means=sound["means"]))
    with pytest.raises(DataError, match=r"covariances has shape \(4, 2, 2\); expected \(4, 3, 3\)"):
        read_npz(npz_of(path, **{**sound, "covariances": sound["covariances"][:, :2, :2]}))
    with pytest.raises(DataError, match="support must not be negative"):
        read_npz(npz_of(path, **{**sound, "support": -sound["support"]}))
    with pytest.raises(DataError, match="damaged, or not an NPZ"):
        read_npz(npz_of(path, **{**sound, "weights": np.array(list("abcd"))}))
    whole = npz_of(path, **sound).read_bytes()
    for cut in (0, 10, len(whole) // 2, len(whole) - 5):
        path.write_bytes(whole[:cut])
        with pytest.raises(DataError, match=r"broken\.npz"):
            read_npz(path)


def test_npz_reader_rejects_headers_and_streams_that_numpy_and_zlib_do_not_expect(tmp_path):
    path = tmp_path / "broken.npz"
    sound = read_members(npz_of(path, **arrays_of(random_mixture())))
    for header in (b"{'descr': ('<f8',", b'"' * 3, b"(" * 90, b"{'shape': (9L,)"):
        member = sound["means.npy"][:10] + header.ljust(118) + sound["means.npy"][128:]
        write_members(path, {**sound, "means.npy": member})
        with pytest.raises(DataError, match=r"broken\.npz"):
            read_npz(path)
    write_members(path, {**sound, "means.npy": b"no numbers" * 100_000})
    with pytest.raises(DataError, match="means has none") as caught:
        read_npz(path)
    assert len(str(caught.value)) < 500
    np.savez_compressed(path, **arrays_of(random_mixture(40)))
    whole = bytearray(path.read_bytes())
    for place in range(60, 400, 3):
        damaged = whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :]
        path.write_bytes(damaged)
        with contextlib.suppress(DataError):
            read_npz(path)


def arrays_of(mixture: PlainMixture) -> dict[str, np.ndarray]:
    return {k: v.numpy() for k, v in mixture._asdict().items() if v is not None}


def read_members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write_members(path: Path, members: dict[str, bytes]) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def test_npz_reader_rejects_pickled_objects(tmp_path):
    class Bomb:
        def __reduce__(self) -> tuple:
            return (Path(tmp_path / "boom").touch, ())

    path = tmp_path / "evil.npz"
    np.savez(
        path, weights=np.array([Bomb()], dtype=object), means=np.ones((1, 2)), covariances=np.eye(2)[None]
    )
    pickle.dumps(Bomb())  # the object can be pickled, so the file contains it
    with pytest.raises(DataError, match="damaged, or not an NPZ"):
        read_npz(path)
    assert not (tmp_path / "boom").exists()


def test_readers_limit_the_compressed_and_decompressed_size(tmp_path, monkeypatch):
    monkeypatch.setattr(mixture_formats, "MAX_BYTES", 10_000)
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, weights=np.zeros(100_000))
    assert path.stat().st_size < 10_000
    with pytest.raises(DataError, match="decompresses to 800,"):
        read_npz(path)
    large = tmp_path / "large.csv"
    large.write_text("1,1,1\n" * 2000)
    with pytest.raises(DataError, match="above the limit of 10,000"):
        read_gira_csv(large)


def test_npz_reader_rejects_an_array_header_with_a_wrong_size(tmp_path):
    header = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }".ljust(117) + "\n"
    lying = io.BytesIO()
    with zipfile.ZipFile(lying, "w") as archive:
        for name in ("weights", "means", "covariances"):
            body = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + b"\0" * 64
            archive.writestr(f"{name}.npy", body)
    path = tmp_path / "lying.npz"
    path.write_bytes(lying.getvalue())
    with pytest.raises(DataError, match=r"lying\.npz is damaged"):
        read_npz(path)


@pytest.mark.parametrize("read", [read_gira_csv, read_npz])
def test_readers_report_a_missing_file(read, tmp_path):
    with pytest.raises(MissingDataError, match="nowhere does not exist; expected"):
        read(tmp_path / "nowhere")


@pytest.mark.parametrize("write", [write_gira_csv, write_npz])
def test_writers_reject_invalid_mixtures(write, tmp_path):
    sound = random_mixture()
    path = tmp_path / "out"
    with pytest.raises(InvalidArgumentError, match="weights has shape"):
        write(path, sound._replace(weights=sound.weights[:2]))
    with pytest.raises(InvalidArgumentError, match="expected \\(K, D\\)"):
        write(path, PlainMixture(*(t[:0] for t in sound)))
    with pytest.raises(NumericalError, match="not positive definite"):
        write(path, sound._replace(covariances=-sound.covariances))
    assert not list(tmp_path.iterdir())


def test_of_support_rejects_a_total_of_zero():
    sound = random_mixture()
    with pytest.raises(InvalidArgumentError, match="adds up to zero"):
        PlainMixture.of_support(sound.means, sound.covariances, torch.zeros(4))


@pytest.mark.parametrize("n_points", [0, -1, float("inf"), float("nan")])
def test_gira_csv_reader_rejects_an_invalid_number_of_points(n_points, tmp_path):
    path = write_gira_csv(tmp_path / "gira.csv", random_mixture())
    with pytest.raises(InvalidArgumentError, match="n_points="):
        read_gira_csv(path, n_points)
