"""Hits and misses of a box by brute force: the angular form of the thesis's appendix (5.1-5.3).

Each direction meets a convex box between two distances. What a component has along it up to a distance
is elementary; over the directions it is integrated by many Gauss-Legendre panels whose ends lie on every
kink: where the box's corners and edges are, and where another face becomes the one that rays leave by.
"""

from __future__ import annotations

import numpy as np
from scipy.special import erf

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)


def _panels(breaks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights between sorted break points along the last axis."""
    half = np.diff(breaks)[..., None] / 2
    middle = (breaks[..., 1:] + breaks[..., :-1])[..., None] / 2
    nodes, weights = middle + half * _NODES, half * _WEIGHTS
    return nodes.reshape(*nodes.shape[:-2], -1), weights.reshape(*weights.shape[:-2], -1)


def _radial(u, m, precision, near, far):
    """∫_near^far r^{D−1} N(s + r u | s + m, Σ) dr of directions u (…, D), not normalised."""
    dim = len(m)
    a = np.einsum("...i,ij,...j", u, precision, u)
    b = u @ precision @ m
    peak, scale = b / a, np.sqrt(a)
    lost = m @ precision @ m - b * b / a
    density = np.exp(-0.5 * lost) * np.sqrt(np.linalg.det(precision)) / (2 * np.pi) ** (dim / 2)

    def primitive(r):
        x = scale * (r - peak)
        bell, area = np.exp(-0.5 * x * x), np.sqrt(np.pi / 2) * erf(x / np.sqrt(2))
        if dim == 2:
            return (-bell / scale + peak * area) / scale
        with np.errstate(invalid="ignore"):
            edge = np.where(np.isinf(x), 0.0, x * bell)
        return ((area - edge) / scale**2 - 2 * peak * bell / scale + peak**2 * area) / scale

    return density * (primitive(far) - primitive(near))


def _distances(u, low, high):
    """Where directions u (…, D) enter and leave the box [low, high] around the origin's frame."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = low / u, high / u
    near = np.maximum(np.minimum(a, b).max(-1), 0)
    far = np.maximum(a, b).min(-1)
    return near, np.maximum(near, far), near < far


def _both(u, m, precision, low, high):
    near, far, met = _distances(u, low, high)
    hits = np.where(met, _radial(u, m, precision, near, far), 0.0)
    misses = np.where(met, _radial(u, m, precision, far, np.inf), 0.0)
    return hits, misses


def exact_evidence(mean, covariance, origin, low, high, panels: int = 150) -> tuple[float, float]:
    """hits, misses per ray of one component, for a sensor outside of it (in 3D at least 9 deviations)."""
    mean, origin, low, high = (np.asarray(x, float) for x in (mean, origin, low, high))
    precision = np.linalg.inv(np.asarray(covariance, float))
    m, low, high = mean - origin, low - origin, high - origin
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(-1, len(m))
    plane = _in_the_plane if len(m) == 2 else _in_space
    return plane(m, precision, np.linalg.cholesky(np.asarray(covariance, float)), low, high, corners, panels)


def _in_the_plane(m, precision, factor, low, high, corners, panels):
    ahead = np.arctan2(m[1], m[0])
    normals = np.random.default_rng(0).standard_normal((20 * panels, 2))
    ends = m + normals @ factor.T
    angles = np.concatenate([np.arctan2(x[:, 1], x[:, 0]) for x in (ends, corners, ends * [1, 1])])
    turned = (angles - ahead + np.pi) % (2 * np.pi) - np.pi
    drawn = turned[: len(ends)]
    seen = np.quantile(drawn, np.linspace(0, 1, panels))
    width = np.ptp(drawn)
    tails = [
        np.linspace(drawn.min() - width, drawn.min(), panels),
        np.linspace(drawn.max(), drawn.max() + width, panels),
    ]
    breaks = np.concatenate([seen, *tails, turned[len(ends) :][: len(corners)], [-np.pi, np.pi]])
    theta, weights = _panels(np.unique(np.clip(breaks, -np.pi, np.pi)))
    u = np.stack([np.cos(theta + ahead), np.sin(theta + ahead)], -1)
    hits, misses = _both(u, m, precision, low, high)
    return float(hits @ weights), float(misses @ weights)


def _in_space(m, precision, factor, low, high, corners, panels):
    # Gnomonic coordinates about the mean: u = forward + a right + b up, dΩ |u|^{-3} and r = t|u|
    # cancel, so that ∫ t² p(s + t u) dt da db is what is sought.
    forward = m / np.linalg.norm(m)
    right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    up = np.cross(forward, right)
    frame = np.stack([forward, right, up])
    k = 7.5
    covariance = factor @ factor.T
    a_low, a_high = _tangents(m, covariance, forward, right, k)
    depth = corners @ forward
    shown = (corners @ right / depth)[depth > 1e-9]
    breaks = np.clip(np.concatenate([np.linspace(a_low, a_high, panels), shown]), a_low, a_high)
    a, a_weights = _panels(np.unique(breaks))

    inverse = frame @ precision @ frame.T
    p = inverse @ (frame @ m)  # precision times the mean, in the frame
    c = m @ precision @ m
    # Directions within k of the mean: C − B²/A < k², a quadratic in b for each a.
    a2, a1, a0 = (
        inverse[2, 2],
        2 * (inverse[0, 2] + a * inverse[1, 2]),
        (inverse[0, 0] + 2 * a * inverse[0, 1] + a * a * inverse[1, 1]),
    )
    b0, b1 = p[0] + a * p[1], p[2]
    q2, q1, q0 = (c - k * k) * a2 - b1 * b1, (c - k * k) * a1 - 2 * b0 * b1, (c - k * k) * a0 - b0 * b0
    root = np.sqrt(np.maximum(q1 * q1 - 4 * q2 * q0, 0))
    b_low, b_high = (-q1 - root) / (2 * q2), (-q1 + root) / (2 * q2)
    kinks = []
    for i, start in enumerate(corners):
        for stop in corners[i + 1 :]:
            if np.count_nonzero(start != stop) != 1:
                continue
            # The line on which this edge is seen, u · (start × stop) = 0.
            normal = frame @ np.cross(start, stop)
            with np.errstate(divide="ignore", invalid="ignore"):
                kinks.append(-(normal[0] + a * normal[1]) / normal[2])
    kinks = np.nan_to_num(np.stack(kinks, -1), nan=np.inf)
    uniform = b_low[:, None] + (b_high - b_low)[:, None] * np.linspace(0, 1, panels)
    breaks = np.sort(np.clip(np.concatenate([uniform, kinks], -1), b_low[:, None], b_high[:, None]), -1)
    b, b_weights = _panels(breaks)
    hits = misses = 0.0
    for part in np.array_split(np.arange(len(a)), max(1, len(a) // 50)):
        u = forward + a[part, None, None] * right + b[part, :, None] * up
        h, e = _both(u, m, precision, low, high)
        hits += a_weights[part] @ (h * b_weights[part]).sum(-1)
        misses += a_weights[part] @ (e * b_weights[part]).sum(-1)
    return float(hits), float(misses)


def _tangents(m, covariance, forward, right, k):
    """The range of a over all directions within k deviations."""
    pair = np.stack([forward, right])
    d, s = pair @ m, pair @ covariance @ pair.T * k * k
    square, middle, rest = d[0] ** 2 - s[0, 0], d[0] * d[1] - s[0, 1], d[1] ** 2 - s[1, 1]
    root = np.sqrt(middle**2 - square * rest)
    return (middle - root) / square, (middle + root) / square
