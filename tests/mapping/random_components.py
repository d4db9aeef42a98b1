"""Random components: of any shape, size and position; or normal in all. Plain loops as references."""

from __future__ import annotations

from dataclasses import replace

import torch
from hypothesis import strategies as st
from torch import Tensor

from gmmtorch.mapping import Attributes, Components, Labels, Numbers
from gmmtorch.mapping.codec.quantization import quantized, spatial_order


def rotations(k: int, dim: int, generator: torch.Generator) -> Tensor:
    """Uniform rotations (K, D, D)."""
    q, r = torch.linalg.qr(torch.randn(k, dim, dim, generator=generator, dtype=torch.float64))
    return q * r.diagonal(dim1=1, dim2=2).sign()[:, None, :]


def random_components(
    dim: int,
    k: int = 40,
    seed: int = 0,
    center: float = 0.0,
    extent: float = 20.0,
    deviations: tuple[float, float] = (5e-3, 1.0),
    counts: tuple[float, float] = (1.0, 1e4),
    n_origins: int = 7,
    max_sightings: int = 3,
    robot: int = 0,
) -> Components:
    """K randomly rotated components with log-uniform deviations and counts; some are flagged max_range."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    def log_uniform(limits: tuple[float, float], *shape: int) -> Tensor:
        low, high = torch.tensor(limits, dtype=torch.float64).log()
        return torch.exp(low + (high - low) * uniform(*shape))

    turn = rotations(k, dim, generator)
    variances = log_uniform(deviations, k, dim) ** 2
    covariances = turn @ torch.diag_embed(variances) @ turn.transpose(1, 2)
    support = log_uniform(counts, k)
    n_each = torch.randint(1, max_sightings + 1, (k,), generator=generator)
    seen_by = torch.repeat_interleave(n_each)
    shuffled = torch.rand(k, n_origins, generator=generator).argsort(1)
    seen_from = shuffled[torch.arange(n_origins) < n_each[:, None]]
    weight = 0.05 + uniform(len(seen_by))
    total = torch.zeros(k, dtype=torch.float64).index_add_(0, seen_by, weight)
    return Components(
        means=center + extent * (uniform(k, dim) - 0.5),
        covariances=(covariances + covariances.transpose(1, 2)) / 2,
        support=support,
        max_range=uniform(k) < 0.2,
        ids=torch.stack([torch.full((k,), robot), torch.arange(k)], 1),
        origins=center + extent * (uniform(n_origins, dim) - 0.5),
        seen_by=seen_by,
        seen_from=seen_from,
        seen_count=weight * (support / total)[seen_by],
    )


def painted(components: Components, seed: int = 0, n_labels: int = 3) -> Components:
    """The components with a colour, an intensity of some of them, and a class."""
    generator = torch.Generator().manual_seed(seed)
    k, dim = components.means.shape

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    def numbers(share: Tensor, width: int, scale: float) -> Numbers:
        noise = scale * (uniform(k, width, width) - 0.5)
        covariance = noise @ noise.mT + 1e-4 * scale**2 * torch.eye(width, dtype=torch.float64)
        mean, slope = uniform(k, width), uniform(k, width, dim) - 0.5
        has = (share > 0).double()[:, None]
        return Numbers(share, scale * mean * has, scale * slope * has[..., None], covariance * has[..., None])

    classes = torch.softmax(8 * uniform(k, n_labels), 1)
    channels = {
        "colour": numbers(0.1 + 0.9 * uniform(k), 3, 1.0),
        "intensity": numbers(uniform(k) * (uniform(k) < 0.6), 1, 200.0),
        "class": Labels(classes * uniform(k)[:, None], 5 * torch.arange(n_labels)),
    }
    return replace(components, attributes=Attributes(channels)).checked()


def normal_components(
    k: int, dim: int, seed: int, n_origins: int = 5, spread: float = 3.0, empty: float = 0.0
) -> Components:
    """k components, some with several of `n_origins` origins; a share `empty` is flagged max_range."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    factors = 0.3 * normal(k, dim, dim)
    seen = torch.rand(k, n_origins, generator=generator) < 0.5
    seen[torch.arange(k), torch.randint(n_origins, (k,), generator=generator)] = True
    by, viewpoint = seen.nonzero(as_tuple=True)
    count = 1 + 50 * torch.rand(len(by), generator=generator, dtype=torch.float64)
    return Components(
        means=spread * normal(k, dim),
        covariances=factors @ factors.transpose(1, 2) + 1e-4 * torch.eye(dim, dtype=torch.float64),
        support=torch.zeros(k, dtype=torch.float64).index_add_(0, by, count),
        max_range=torch.rand(k, generator=generator) < empty,
        ids=torch.stack([torch.full((k,), 3), torch.arange(k)], 1),
        origins=2 * normal(n_origins, dim),
        seen_by=by,
        seen_from=viewpoint,
        seen_count=count,
    ).checked()


def total_moments(components: Components, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Support, mean and covariance of all components of some rows together, by a loop."""
    dim = components.dim
    weight = torch.zeros((), dtype=torch.float64)
    first, second = torch.zeros(dim, dtype=torch.float64), torch.zeros(dim, dim, dtype=torch.float64)
    for k in rows.nonzero().squeeze(1).tolist():
        w, m, c = components.support[k], components.means[k], components.covariances[k]
        weight, first, second = weight + w, first + w * m, second + w * (c + torch.outer(m, m))
    mean = first / weight.clamp_min(1e-300)
    return weight, mean, second / weight.clamp_min(1e-300) - torch.outer(mean, mean)


def counts_add_up(components: Components) -> bool:
    total = torch.zeros(len(components), dtype=torch.float64)
    total.index_add_(0, components.seen_by, components.seen_count)
    return torch.allclose(total, components.support, rtol=1e-9)


drawn = st.builds(
    random_components,
    dim=st.sampled_from([2, 3]),
    k=st.integers(0, 30),
    seed=st.integers(0, 10**6),
    center=st.sampled_from([0.0, -3.7, 5e5, 4.2e6]),
    extent=st.sampled_from([0.0, 1.0, 300.0, 2e4]),
    deviations=st.sampled_from([(1e-4, 100.0), (5e-3, 1.0), (0.1, 0.1), (1e-4, 1e-3), (20.0, 5e3)]),
    counts=st.sampled_from([(0.01, 1e9), (1.0, 100.0)]),
    n_origins=st.integers(3, 40),
    max_sightings=st.integers(1, 3),
)


def estimated_bytes(components: Components) -> int:
    """About the size of the file: 16 bytes a component, 2 a viewpoint beyond the first, 7 an origin."""
    further = len(components.seen_by) - len(components)
    return 300 + 16 * len(components) + 2 * max(0, further) + 7 * len(components.origins)


def around_a_sensor(k: int) -> Components:
    """Coarse components of a frame: half are surfaces, half the ends of no-return beams of 6 m."""
    generator = torch.Generator().manual_seed(k)
    drawn = random_components(3, k=k, n_origins=1, max_sightings=1, seed=k)
    rays = torch.nn.functional.normalize(torch.randn(k, 3, generator=generator).double(), dim=1)
    rays = torch.nn.functional.normalize(rays + torch.tensor([2.0, 1.0, 0.3]), dim=1)
    flat = 0.15 * torch.eye(3, dtype=torch.float64) - 0.149 * rays[:, :, None] * rays[:, None, :]
    made = replace(
        drawn,
        means=drawn.origins[:1] + 5.98 * rays,
        covariances=torch.where((torch.arange(k) % 2 == 0)[:, None, None], flat, 0.1 * drawn.covariances),
        max_range=torch.arange(k) % 2 == 0,
    )
    return quantized(replace(made.rearranged(spatial_order(made)), ids=drawn.ids), coarse=True)
