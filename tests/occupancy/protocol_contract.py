"""The contract of occupancy maps: tests that every map and baseline inherits."""

from __future__ import annotations

import contextlib
import math
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, MissingDataError
from gmmtorch.files import pack_tensors
from gmmtorch.occupancy.protocol import OccupancyMap
from gmmtorch.scan import Scan

RESOLUTION = 0.125  # a binary fraction, so that moving a scan by whole cells rounds nothing
SENSOR = (0.3125 + 2**-9, 0.1875 + 2**-9, 0.4375 + 2**-9)
WALL = 3.0625  # the wall's x: the middle of a cell

dims = pytest.mark.parametrize("dim", [2, 3])


def off_plane(points: Tensor) -> Tensor:
    """Points moved to odd multiples of 2⁻¹³ m: on no plane of the lattice, and exact far from the origin."""
    return (2 * torch.round(points.double() * 4096) + 1) / 8192


def wall_scan(dim: int, seed: int = 0, sensor: tuple[float, ...] = SENSOR) -> Scan:
    """A wall across x, 3 m wide (and 1.5 m high), seen from 2.7 m away with a noise of 4 mm."""
    y = torch.linspace(-1.5, 1.5, 241 if dim == 2 else 61, dtype=torch.float64)
    other = [y] if dim == 2 else [y, torch.linspace(-0.75, 0.75, 31, dtype=torch.float64)]
    rows = torch.cartesian_prod(*other).reshape(-1, dim - 1)
    noise = 0.004 * torch.randn(
        len(rows), 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    return Scan(
        off_plane(torch.cat([WALL + noise, rows], 1)), torch.tensor(sensor[:dim], dtype=torch.float64)
    )


def empty_scan(dim: int) -> Scan:
    return Scan(torch.empty(0, dim, dtype=torch.float64), torch.tensor(SENSOR[:dim], dtype=torch.float64))


def open_scan(dim: int, length: float = 4.0) -> Scan:
    """A fan of no-return beams."""
    angle = torch.linspace(-0.5, 0.5, 400, dtype=torch.float64)
    direction = torch.stack([angle.cos(), angle.sin(), 0 * angle][:dim], 1)
    origin = torch.tensor(SENSOR[:dim], dtype=torch.float64)
    return Scan(torch.empty(0, dim, dtype=torch.float64), origin, off_plane(origin + length * direction))


def points(x: list[float], dim: int, y: float = 0.1875) -> Tensor:
    """Query points at these x, in the middle of the wall's width and height."""
    rest = [y, 0.0625][: dim - 1]
    return torch.tensor([[value, *rest] for value in x], dtype=torch.float64)


def lattice(dim: int) -> Tensor:
    """Cell centres all around the scene."""
    x = torch.arange(-0.9375, 4.5, 0.25, dtype=torch.float64)
    y = torch.arange(-1.9375, 2, 0.375, dtype=torch.float64)
    z = torch.arange(-0.9375, 1.2, 0.5, dtype=torch.float64)
    return torch.cartesian_prod(*[x, y, z][:dim])


def quarter_turn(dim: int, shift: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Tensor:
    """A turn by 90° about the vertical, then a shift."""
    matrix = torch.eye(dim + 1, dtype=torch.float64)
    matrix[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    matrix[:dim, dim] = torch.tensor(shift[:dim])
    return matrix


def shifted(dim: int, shift: tuple[float, ...]) -> Tensor:
    matrix = torch.eye(dim + 1, dtype=torch.float64)
    matrix[:dim, dim] = torch.tensor(shift[:dim], dtype=torch.float64)
    return matrix


def move(matrix: Tensor, x: Tensor) -> Tensor:
    return x @ matrix[:-1, :-1].T + matrix[:-1, -1]


class OccupancyMapContract(ABC):
    """Inherit, implement `make`, and name the class `Test…`."""

    shift_tolerance = 0.0
    """Largest change of the occupancy when the scene is shifted by whole cells."""
    turn_tolerance = 0.0
    """Largest root mean square change of the occupancy when the scene is rotated by 90°."""
    thins_scans = False
    """Whether equal points of one scan count once; points of several scans always count."""

    extrapolates = False
    """Whether it is a regressor with global features, whose occupancy in unobserved space is arbitrary."""
    overshoot = 0.0
    """How far above ½ the occupancy of a regressor may be beside free space."""

    @abstractmethod
    def make(self) -> Any:
        """A new, empty map whose cells are RESOLUTION wide."""

    def built(self, *scans: Scan) -> Any:
        made = self.make()
        for scan in scans:
            made.insert(scan)
        return made

    def ask(self, made: OccupancyMap, query: Tensor) -> Tensor:
        return made.occupancy(query, resolution=RESOLUTION)

    # -- occupancy ------------------------------------------------------------------------------

    def test_it_is_an_occupancy_map(self):
        assert isinstance(self.make(), OccupancyMap)

    @dims
    def test_a_wall_is_occupied_before_it_is_free_and_behind_it_unknown(self, dim):
        made = self.built(wall_scan(dim))
        along = torch.arange(-1.0625, 1.1, 0.25, dtype=torch.float64)
        on_wall = points([WALL], dim).repeat(len(along), 1)
        on_wall[:, 1] = along
        assert float(self.ask(made, on_wall).min()) > 0.5
        sensor = torch.tensor(SENSOR[:dim], dtype=torch.float64)
        way = torch.linspace(0.1, 0.9, 9, dtype=torch.float64)[:, None]
        assert float(self.ask(made, sensor + way * (points([WALL], dim) - sensor)).max()) < 0.5
        if self.extrapolates:
            return
        assert self.ask(made, points([3.5625, 3.8125, 5.0, 50.0], dim)).tolist() == [0.5] * 4
        assert self.ask(made, points([-0.5, -3.0], dim)).tolist() == [0.5] * 2  # behind the sensor

    @settings(max_examples=8)
    @given(seed=st.integers(0, 10**6), dim=st.integers(2, 3), n=st.integers(1, 30), m=st.integers(0, 10))
    def test_any_scan_gives_probabilities_and_one_half_in_unreached_space(self, seed, dim, n, m):
        generator = torch.Generator().manual_seed(seed)
        ends = 2 * torch.rand(n + m, dim, generator=generator, dtype=torch.float64)
        scan = Scan(ends[:n], torch.rand(dim, generator=generator, dtype=torch.float64), ends[n:])
        made = self.built(scan)
        inside = 2 * torch.rand(50, dim, generator=generator, dtype=torch.float64)
        theta = self.ask(made, inside)
        assert 0 <= float(theta.min()) <= float(theta.max()) <= 1
        seen = torch.cat([ends, (ends + scan.origin) / 2])
        assert (self.ask(made, seen) != 0.5).any()
        assert self.extrapolates or (self.ask(made, inside + 1000) == 0.5).all()

    @dims
    def test_everything_is_unknown_before_and_after_an_empty_scan(self, dim):
        made = self.built(empty_scan(dim))
        for unknown in (self.make(), made):
            assert self.ask(unknown, lattice(dim)).unique().tolist() == [0.5]
        made.insert(wall_scan(dim))
        assert float(self.ask(made, points([WALL], dim))) > 0.5

    @dims
    def test_no_return_beams_give_only_free_space(self, dim):
        made = self.built(open_scan(dim))
        seen = open_scan(dim).no_return
        theta = self.ask(made, seen if self.extrapolates else torch.cat([lattice(dim), seen]))
        assert float(theta.max()) <= 0.5 + self.overshoot
        level = torch.tensor(
            [[x, *SENSOR[1:dim]] for x in (0.8125, 1.8125, 2.8125, 3.8125)], dtype=torch.float64
        )
        assert float(self.ask(made, level).max()) < 0.5
        beyond = torch.tensor([[x, *SENSOR[1:dim]] for x in (5.5, 7.0)], dtype=torch.float64)
        assert self.extrapolates or self.ask(made, beyond).tolist() == [0.5] * 2

    @dims
    def test_a_single_point_is_occupied_and_repeated_points_raise_the_occupancy(self, dim):
        end, origin = points([1.0625], dim), torch.tensor(SENSOR[:dim], dtype=torch.float64)
        scans = [Scan(end, origin)] * 50 if self.thins_scans else [Scan(end.repeat(50, 1), origin)]
        once = self.built(Scan(end, origin))
        assert float(self.ask(once, (origin + end) / 2)) < 0.5
        assert 0.5 < float(self.ask(once, end)) < float(self.ask(self.built(*scans), end)) <= 1

    # -- queries --------------------------------------------------------------------------------

    @dims
    def test_arrays_give_arrays_and_tensors_give_tensors_of_any_precision(self, dim):
        made_of, query = wall_scan(dim), lattice(dim)
        made = self.built(made_of)
        theta = made.occupancy(query.numpy(), RESOLUTION)
        assert isinstance(theta, np.ndarray)
        assert isinstance(self.ask(made, query), Tensor)
        assert (theta == self.ask(made, query).numpy()).all()
        assert (made.occupancy(query[:5].tolist(), RESOLUTION) == theta[:5]).all()
        assert isinstance(self.make().occupancy(query.numpy(), RESOLUTION), np.ndarray)
        assert self.ask(made, query[:0]).shape == (0,)
        single = self.built(Scan(made_of.points.float(), made_of.origin.float()))
        assert float(self.ask(single, points([WALL], dim).float())) > 0.5

    @dims
    def test_infinite_and_distant_queries_are_unknown(self, dim):
        made = self.built(wall_scan(dim))
        for value in (math.inf, -math.inf, 1e30, -1e9):
            theta = self.ask(made, torch.zeros(dim, dim, dtype=torch.float64).fill_diagonal_(value))
            if self.extrapolates and math.isfinite(value):
                assert 0 <= float(theta.min()) <= float(theta.max()) <= 1
            else:
                assert theta.tolist() == [0.5] * dim

    @dims
    def test_a_query_with_nan_or_of_another_dimension_is_refused(self, dim):
        made, query = self.built(wall_scan(dim)), lattice(dim)
        query[3, 1] = math.nan
        for asked in (self.make(), made):
            with pytest.raises(InvalidArgumentError, match=r"points.*NaN"):
                asked.occupancy(query, RESOLUTION)
        for query in (torch.zeros(4, 5 - dim), torch.zeros(4, 1), torch.zeros(dim), torch.zeros(2, 2, dim)):
            with pytest.raises(InvalidArgumentError, match=r"points has shape"):
                made.occupancy(query, RESOLUTION)

    @dims
    def test_a_scan_of_another_dimension_is_refused_and_changes_nothing(self, dim):
        made = self.built(wall_scan(dim))
        before = self.ask(made, lattice(dim))
        with pytest.raises(InvalidArgumentError, match="dimensional"):
            made.insert(wall_scan(5 - dim))
        assert torch.equal(self.ask(made, lattice(dim)), before)

    # -- independence ---------------------------------------------------------------------------

    @dims
    def test_queries_and_finish_do_not_change_the_map(self, dim):
        scans = [wall_scan(dim), open_scan(dim), wall_scan(dim, 1)]
        asked, left = self.make(), self.built(*scans)
        left.finish()
        self.make().finish()
        for scan in scans:
            asked.insert(scan)
            first = self.ask(asked, lattice(dim))
            assert torch.equal(self.ask(asked, lattice(dim)), first)
            assert asked.nbytes > 0
        assert torch.equal(self.ask(asked, lattice(dim)), self.ask(left, lattice(dim)))

    @dims
    def test_scans_inserted_after_a_query_change_the_occupancy(self, dim):
        made = self.built(open_scan(dim))
        assert float(self.ask(made, points([WALL], dim))) <= 0.5
        for seed in range(4):
            made.insert(wall_scan(dim, seed))
        assert float(self.ask(made, points([WALL], dim))) > 0.5

    @dims
    def test_occupancy_moves_with_a_scene_shifted_by_whole_blocks(self, dim):
        scans = wall_scan(dim), open_scan(dim)
        expected = self.ask(self.built(*scans), lattice(dim))
        for shift in ((2.0, -3.0, 1.0), (500_000.0, 4_000_000.0, 250.0)):
            matrix = shifted(dim, shift)
            moved = self.built(*(scan.transformed(matrix) for scan in scans))
            theta = self.ask(moved, move(matrix, lattice(dim)))
            assert float((theta - expected).abs().max()) <= self.shift_tolerance

    @dims
    def test_occupancy_moves_with_a_scene_shifted_by_whole_cells(self, dim):
        matrix = shifted(dim, (0.125, -0.375, 0.25))
        expected = self.ask(self.built(wall_scan(dim)), lattice(dim))
        theta = self.ask(self.built(wall_scan(dim).transformed(matrix)), move(matrix, lattice(dim)))
        assert float((theta - expected).abs().max()) <= max(self.shift_tolerance, self.turn_tolerance)

    @dims
    def test_occupancy_turns_with_a_scene_rotated_by_90_degrees(self, dim):
        matrix = quarter_turn(dim, (1.0, 2.0, 0.0))
        expected = self.ask(self.built(wall_scan(dim)), lattice(dim))
        turned = self.built(wall_scan(dim).transformed(matrix))
        theta = self.ask(turned, move(matrix, lattice(dim)))
        assert float((theta - expected).square().mean().sqrt()) <= self.turn_tolerance
        assert float(self.ask(turned, move(matrix, points([WALL], dim)))) > 0.5

    # -- files ----------------------------------------------------------------------------------

    @dims
    def test_a_loaded_map_gives_the_same_occupancy_bit_by_bit(self, dim, tmp_path):
        scans = wall_scan(dim), open_scan(dim), wall_scan(dim, 1, (1.3, -0.7, 0.3))
        path = tmp_path / "map.safetensors"
        for matrix in (shifted(dim, (0.0,) * 3), shifted(dim, (500_000.0, 4_000_000.0, 250.0))):
            made, query = (
                self.built(*(scan.transformed(matrix) for scan in scans)),
                move(matrix, lattice(dim)),
            )
            made.save(path)
            loaded = type(made).load(path)
            assert torch.equal(self.ask(loaded, query), self.ask(made, query))
            assert len({float(x) for x in self.ask(made, query)}) > 3
            loaded.save(tmp_path / "again.safetensors")
            assert (tmp_path / "again.safetensors").stat().st_size == path.stat().st_size

    @dims
    def test_nbytes_is_the_size_of_the_file(self, dim, tmp_path):
        path = tmp_path / "map.safetensors"
        for scans in ([wall_scan(dim)], [wall_scan(dim), open_scan(dim)], [empty_scan(dim)]):
            made = self.built(*scans)
            made.save(path)
            assert made.nbytes == path.stat().st_size
        assert self.ask(type(made).load(path), lattice(dim)).unique().tolist() == [0.5]
        assert self.make().nbytes == 0

    @dims
    def test_a_loaded_map_learns_further_scans(self, dim, tmp_path):
        made = self.built(open_scan(dim))
        made.save(tmp_path / "map.safetensors")
        loaded = type(made).load(tmp_path / "map.safetensors")
        for seed in range(4):
            loaded.insert(wall_scan(dim, seed))
        assert float(self.ask(loaded, points([WALL], dim))) > 0.5
        with pytest.raises(InvalidArgumentError, match="dimensional"):
            loaded.insert(wall_scan(5 - dim))

    def test_an_empty_map_and_a_missing_or_foreign_file_are_refused(self, tmp_path):
        with pytest.raises(GmmTorchError, match="empty"):
            self.make().save(tmp_path / "map.safetensors")
        assert list(tmp_path.iterdir()) == []
        with pytest.raises(MissingDataError, match="nowhere"):
            type(self.make()).load(tmp_path / "nowhere.safetensors")
        path = tmp_path / "foreign.safetensors"
        for data in (b"", b"not a map", pack_tensors({"means": torch.zeros(1)}, "gmmtorch.other", 1)):
            path.write_bytes(data)
            with pytest.raises(DataError, match=r"foreign\.safetensors"):
                type(self.make()).load(path)

    def test_a_file_cut_anywhere_is_refused(self, tmp_path):
        path = self.saved(tmp_path)
        data = path.read_bytes()
        for length in range(0, len(data), max(1, len(data) // 50)):
            path.write_bytes(data[:length])
            with pytest.raises(DataError, match=r"map\.safetensors"):
                type(self.make()).load(path)

    def saved(self, folder: Path) -> Path:
        path = folder / "map.safetensors"
        if not path.exists():
            self.built(wall_scan(2), open_scan(2)).save(path)
        return path

    @settings(max_examples=40)
    @given(place=st.floats(0, 1, exclude_max=True), value=st.integers(0, 255), in_header=st.booleans())
    def test_a_damaged_file_is_refused_or_gives_probabilities(self, tmp_path, place, value, in_header):
        data = bytearray(self.saved(tmp_path).read_bytes())
        header = 8 + int.from_bytes(data[:8], "little")  # of the safetensors format
        end = min(header, len(data)) if in_header else len(data)
        data[int(place * end)] = value
        path = tmp_path / "damaged.safetensors"
        path.write_bytes(data)
        try:
            loaded = type(self.make()).load(path)
        except GmmTorchError:
            return
        if hasattr(loaded, "memory_limit"):
            loaded.memory_limit = 1 << 24  # a damaged number may need a lot of memory
        with contextlib.suppress(GmmTorchError):
            theta = self.ask(loaded, lattice(2))
            assert 0 <= float(theta.min()) <= float(theta.max()) <= 1
