"""Calibration: the probability that follows from evidence, and how a map learns it while it grows.

A cube of side h (m) in D dimensions with H hits and M misses is occupied with the log-odds

    t(z) = b₋ z + (b₊ − b₋)(log(1 + e^z) − log 2),   z = log((w H + n) / (M + n)),

with w = a ℓ/h and n = ν h^(D−1).

ℓ is half the mean range of the beams (m), so that a hit counts about as much as the misses of a beam; ν is
the number of rays per area (per length in 2D) below which evidence says little; the slope of t goes from b₋,
where evidence is for free space, to b₊, where it is for a surface. The logarithms of a, ν, b₊ and b₋ are
quadratic functions of a smooth scale of h/ℓ, so that 12 coefficients serve all sides. With w = 1, n = N_p
and b₊ = b₋ = 1 it is the thesis's (3.9).

The log-odds rise with H, fall with M, are zero without evidence, and are smooth in all of these and in h.

A map predicts the beams of each window before it learns from them: the end of a beam is occupied, and a
point drawn uniformly from the rest is free. The coefficients follow from these predictions by logistic
regression, updated window by window with a Gaussian posterior (an extended Kalman filter). Its prior comes
from the sensor model, so a map that has predicted little leans on it.

Reliability compares the predictions with what was seen: of the cells with θ = 0.7, are 70 % occupied?
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, check_number
from gmmtorch.linalg import on_cpu

_CENTER, _WIDTH = 0.05, math.log(10.0)  # of h/ℓ; the scale is nearly log(h/ℓ / 0.05) from 0.01 to 0.25
# Of the prior: constant, linear and quadratic part of the logarithm of a, ν, b and b.
_MEAN = np.array([[-0.3, -0.38, 0.14], [1.5, -0.3, 0.0], [0.35, 0.17, 0.0], [0.1, 0.12, 0.06]])
_DEVIATION = np.array([[0.4, 0.15, 0.05], [1.0, 0.3, 0.05], [0.25, 0.1, 0.05], [0.25, 0.1, 0.05]])
_FARTHEST = 3.0  # deviations of the prior that a coefficient of a map moves at most
_INFORMATION = np.repeat([0.1, 0.02, 0.2, 0.2], 3)  # of a predicted point about each coefficient, about
_STEPS = 2  # of Gauss and Newton, of an update
_INDEPENDENT = 0.08  # what a prediction counts: those of one beam for several sides share their errors
_MEMORY = 0.98  # share of what was learned that remains after another window
_HALF = math.log(2.0)  # log(1 + e⁰)
_LARGEST = 30.0  # of a coefficient in a file
N_BINS = 15
"""Number of equal-width bins of probabilities, as in Guo et al. 2017."""
N_BYTES = 28
"""Size of a calibration in files and messages."""
_LEAST = 2.0**-52  # probability by which a certain mistake is scored


class Calibration(NamedTuple):
    """The mapping from evidence to probability.

    length: ℓ (m). coefficients: 12 numbers: of log a, log ν, log b where evidence is for a surface, and log b
    where it is for free space, each a constant, linear and quadratic part. n_predicted: number of points that
    the map has predicted; 0 if the coefficients are those of the sensor model. All are rounded to float16.
    """

    length: float
    coefficients: tuple[float, ...]
    n_predicted: int = 0

    @classmethod
    def prior(cls, mean_range: float) -> Calibration:
        """What the sensor model says, for beams of a mean range (m).

        Of the points of a beam of length L its end is occupied, and a point drawn from the rest lies in a
        given cell on its way with the probability h/L. So w = L/h in a map without errors, that is a = 2,
        which holds for small cells. The other constants are those of simulated and real rooms, see
        benchmarks/calibration.py.
        """
        return cls(*_rounded(_length_of(mean_range), _MEAN))

    def log_odds(self, hits: Tensor, misses: Tensor, side: float, dim: int) -> Tensor:
        """Log-odds of cubes of `side` (m) with hits and misses of any shape."""
        found = _quantities(np.array(self.coefficients), np.array(side), self.length, dim)
        weight, least, up, down = map(float, found)
        z = ((hits * weight + least) / (misses + least)).log()
        return down * z + (up - down) * (torch.nn.functional.softplus(z) - _HALF)

    def probability(self, hits: Tensor, misses: Tensor, side: float, dim: int) -> Tensor:
        """Probabilities of cubes of `side` (m) with hits and misses of any shape; ½ without evidence."""
        return torch.sigmoid(self.log_odds(hits, misses, side, dim))

    @classmethod
    def merged(cls, parts: Sequence[Calibration]) -> Calibration:
        """The calibration of several maps together: the mean, weighted by what they have predicted.

        It does not depend on the order of the parts.
        """
        parts = sorted(parts)
        weight = np.array([max(1, part.n_predicted) for part in parts], dtype=np.float64)
        values = np.array([[math.log(part.length), *part.coefficients] for part in parts])
        length, *mean = (weight @ values / weight.sum()).tolist()
        n_predicted = _short_count(sum(part.n_predicted for part in parts))
        return cls(*_rounded(math.exp(length), np.array(mean)), n_predicted)

    def to_bytes(self) -> bytes:
        """`N_BYTES`, from which `of_bytes` makes the calibration again."""
        values = [math.log(self.length), math.log1p(self.n_predicted), *self.coefficients]
        return np.array(values, dtype="<f2").tobytes()

    @classmethod
    def of_bytes(cls, data: bytes) -> Calibration:
        """The calibration of `to_bytes`. Raises `DataError` for any other bytes."""
        values = np.frombuffer(data[: len(data) // 2 * 2], dtype="<f2").astype(np.float64)
        # NaN compares false.
        if len(data) == N_BYTES and (np.abs(values) <= _LARGEST).all() and values[1] >= 0:
            length, n_predicted, *mean = values.tolist()
            made = cls(_short(math.exp(length)), tuple(mean), round(math.expm1(n_predicted)))
            if made.to_bytes() == data:
                return made
        raise DataError("The calibration is damaged.")

    def text(self) -> str:
        """`to_bytes` as 35 characters, from which `read` makes the calibration again."""
        return base64.b85encode(self.to_bytes()).decode()

    @classmethod
    def read(cls, text: object) -> Calibration:
        """The calibration of a `text`. Raises `DataError` for any other object."""
        try:
            return cls.of_bytes(base64.b85decode(text) if isinstance(text, str) else b"")
        except (ValueError, DataError):
            raise DataError(
                f"calibration={text!r} is damaged; remove it to use that of the sensor model."
            ) from None


def _length_of(mean_range: float) -> float:
    """ℓ (m) of beams with a mean range (m)."""
    return 0.5 * check_number("mean_range", mean_range, above=True)


def _rounded(length: float, mean: np.ndarray) -> tuple[float, tuple[float, ...]]:
    return _short(length), tuple(mean.astype(np.float16).flatten().tolist())


def _short(length: float) -> float:
    """The length (m) with a logarithm of float16."""
    return math.exp(float(np.float16(math.log(length))))


def _powers(ratio: np.ndarray) -> np.ndarray:
    """(3, ...) powers 0, 1, 2 of the scale of h/ℓ, which has bounds: far sides lean on near ones."""
    s = _WIDTH * np.tanh(np.log(ratio / _CENTER) / _WIDTH)
    return np.stack([np.ones_like(s), s, s * s])


def _quantities(
    mean: np.ndarray, side: np.ndarray, length: float, dim: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """w, n, and the slopes b above and below zero, for cubes of sides (m) of any shape."""
    a, density, up, down = np.exp(mean.reshape(4, 3) @ _powers(side / length))
    return a * length / side, density * side ** (dim - 1), up, down


def _derivatives(
    hits: np.ndarray, misses: np.ndarray, side: np.ndarray, length: float, dim: int, mean: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Log-odds (M,) of cubes of sides (M,), and their derivatives (12, M) by the coefficients."""
    weight, least, up, down = _quantities(mean, side, length, dim)
    strong = hits * weight
    z = np.log((strong + least) / (misses + least))
    above = np.logaddexp(0.0, z) - _HALF
    slope = down + (up - down) * _sigmoid(z)
    t = down * z + (up - down) * above
    each = [
        slope * strong / (strong + least),
        slope * (least / (strong + least) - least / (misses + least)),
        up * above,
        down * (z - above),
    ]
    return t, (np.stack(each)[:, None] * _powers(side / length)).reshape(12, -1)


def _sigmoid(t: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):  # it is then 0
        return 1 / (1 + np.exp(-t))


class Prediction(NamedTuple):
    """What a map knew about M places and what was then seen: hits, misses, occupied (M,), for a side (m)."""

    hits: Tensor | np.ndarray
    misses: Tensor | np.ndarray
    occupied: Tensor | np.ndarray
    side: float

    def on_cpu(self) -> list[np.ndarray]:
        """Hits, misses and occupied, float64."""
        given = self.hits, self.misses, self.occupied
        tensors = on_cpu(*(value for value in given if isinstance(value, Tensor)))
        return [np.asarray(value, np.float64) for value in tensors or given]


def _short_count(n: int) -> int:
    """The number with a logarithm of float16."""
    return round(math.expm1(float(np.float16(math.log1p(n)))))


@dataclass(frozen=True)
class Calibrator:
    """What a map has learned about its calibration: a Gaussian of the coefficients.

    length: ℓ (m), that of the first window. mean (12,), precision (12, 12). n_predicted: number of points.
    next_window: number of the window that is predicted next.
    tally: (S, 15, 6), for each of the sides that are predicted and each bin of probability: the number of
    points; the sum of their probabilities; the number of those that were occupied; and the sums of their
    squared errors, of their log-losses (bits), and of those that ½ separates right. All on the CPU.
    """

    length: float
    mean: Tensor
    precision: Tensor
    tally: Tensor
    n_predicted: int = 0
    next_window: int = 0

    @classmethod
    def of(cls, mean_range: float, n_sides: int) -> Calibrator:
        """Nothing is learned yet; the beams have a mean range (m)."""
        length = _length_of(mean_range)
        mean, precision = map(torch.from_numpy, (_MEAN.flatten(), _prior_precision()))
        return cls(length, mean, precision, _empty_tally(n_sides))

    @classmethod
    def continued(cls, known: Calibration, n_sides: int) -> Calibrator:
        """Goes on from a calibration, which states how much was learned, but not about which coefficient."""
        mean = torch.tensor(known.coefficients, dtype=torch.float64)
        seen = min(known.n_predicted, 1 / (1 - _MEMORY) * 50)
        precision = torch.from_numpy(_prior_precision() + np.diag(_INDEPENDENT * seen * _INFORMATION))
        return cls(known.length, mean, precision, _empty_tally(n_sides), known.n_predicted)

    @classmethod
    def restored(cls, state: dict[str, Any]) -> Calibrator:
        """The calibrator of a state, `vars` of another. Raises `ValueError` if it is damaged."""
        made = cls(**state)
        check_number("length", made.length, above=True)
        shapes = tuple(made.mean.shape), tuple(made.precision.shape), tuple(made.tally.shape[1:])
        is_finite = bool(torch.isfinite(made.mean).all()) and bool(torch.isfinite(made.precision).all())
        if shapes != ((12,), (12, 12), _empty_tally(1).shape[1:]) or not is_finite:
            raise ValueError("the calibration is damaged")
        return made

    @property
    def calibration(self) -> Calibration:
        """The calibration so far."""
        n_predicted = _short_count(self.n_predicted)
        return Calibration(*_rounded(self.length, self.mean.numpy()), n_predicted)

    def updated(self, predictions: Sequence[Prediction], dim: int, farthest: float = _FARTHEST) -> Calibrator:
        """After the predictions of a window, one for each of the sides of the tally.

        farthest: deviations that a coefficient may be from that of the sensor model.
        """
        each = [p.on_cpu() for p in predictions]
        hits, misses, occupied = map(np.concatenate, zip(*each, strict=True))
        sizes = [len(p.hits) for p in predictions]
        side = np.repeat([p.side for p in predictions], sizes)
        prior, mean = _prior_precision(), self.mean.numpy()
        before = prior + _MEMORY * (self.precision.numpy() - prior)
        now, center, room = mean, _MEAN.flatten(), farthest * _DEVIATION.flatten()
        for step in range(_STEPS):
            t, jacobian = _derivatives(hits, misses, side, self.length, dim, now)
            theta = _sigmoid(t)
            precision = before + _INDEPENDENT * (jacobian * (theta * (1 - theta))) @ jacobian.T
            gradient = _INDEPENDENT * jacobian @ (occupied - theta) - before @ (now - mean)
            if step == 0:
                tally = self._tallied(theta, occupied, sizes)
            now = np.clip(now + np.linalg.solve(precision, gradient), center - room, center + room)
        return replace(
            self,
            mean=torch.from_numpy(now),
            precision=torch.from_numpy(precision),
            tally=torch.from_numpy(tally),
            n_predicted=self.n_predicted + len(occupied),
        )

    def _tallied(self, theta: np.ndarray, occupied: np.ndarray, sizes: Sequence[int]) -> np.ndarray:
        """The tally with the probabilities (M,) of points, `sizes` (S,) of them for each side in turn."""
        number = np.repeat(np.arange(len(sizes)), sizes)
        place = np.clip((theta * N_BINS).astype(np.int64), 0, N_BINS - 1)
        given = np.where(occupied == 1, theta, 1 - theta)
        loss = -np.log2(np.maximum(given, _LEAST))
        right = (given > 0.5) + 0.5 * (given == 0.5)
        tally = self.tally.numpy().copy()
        values = [np.ones_like(theta), theta, occupied, (1 - given) ** 2, loss, right]
        np.add.at(tally, (number, place), np.stack(values, 1))
        return tally


def _empty_tally(n_sides: int) -> Tensor:
    return torch.zeros(n_sides, N_BINS, 6, dtype=torch.float64)


def _prior_precision() -> np.ndarray:
    return np.diag(_DEVIATION.flatten() ** -2)


_FEWEST = 20  # predictions of a bin; fewer show little but chance


class Reliability(NamedTuple):
    """A reliability curve: one entry for each non-empty bin (B,), in order of θ.

    predicted: mean θ of the bin's points; observed: share of them that is occupied; n_points: their number.
    """

    predicted: np.ndarray
    observed: np.ndarray
    n_points: np.ndarray

    @property
    def expected_error(self) -> float:
        """Expected calibration error: mean |observed − predicted| over the points."""
        gap = np.abs(self.observed - self.predicted)
        return float(gap @ self.n_points / self.n_points.sum())


def reliability_of(tally: Tensor) -> Reliability:
    """Reliability curve of a tally (15, 6) of predictions, see `occupancy.calibrator.Calibrator`.

    Neighbouring bins are pooled until they hold 20 predictions; the last one may have fewer.
    """
    before = tally[:, 0].cumsum(0) - tally[:, 0]
    pool = torch.unique((before / _FEWEST).floor(), return_inverse=True)[1]
    pooled = torch.zeros_like(tally).index_add(0, pool, tally)
    count, predicted, observed = pooled[pooled[:, 0] > 0, :3].T.numpy()
    return Reliability(predicted / count, observed / count, count)


def scores_of(tally: Tensor) -> dict[str, float]:
    """`scores` of a tally (15, 6) of at least one prediction."""
    brier, log_loss, right = (tally[:, 3:].sum(0) / tally[:, 0].sum()).tolist()
    ece = reliability_of(tally).expected_error
    return {"ece": ece, "brier": brier, "log_loss_bits": log_loss, "accuracy": right}
