"""Learns the chances with which the codec's slots begin, and writes them into the package.

    python scripts/context_chances.py

They are learned from simulated worlds only: all datagrams of components of two missions, in tunnels and in a
warehouse other than those of the benchmarks, and the maps of the synthetic buildings. Takes about 5 minutes.
New chances need a new version of batches.
"""

from __future__ import annotations

import base64
import textwrap
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

import gmmtorch as gt
from gmmtorch.kernels import ChanceTables, context_coding
from gmmtorch.mapping.codec import context_model
from gmmtorch.mapping.codec.component_batch import coded
from gmmtorch.mapping.codec.quantization import Quantized, cell_exponent, quantize, spatial_order
from gmmtorch.team.exploration.mission.options import TeamOptions
from gmmtorch.team.exploration.mission.trials import assemble
from gmmtorch.team.exploration.world.world import open_world
from gmmtorch.team.sharing.messages.component_messages import ComponentsMessage
from gmmtorch.team.sharing.messages.message_registry import decode

FEWEST = 12  # bits of a slot from which its chance is learned
MEMORY = 1000  # bits of a slot that count while it learns
MISSIONS = (("tunnels", {}, 7, 200.0), ("warehouse", {"size": (30.0, 30.0, 8.0), "seed": 5}, 3, 250.0))
MAPS = (("synthetic_building", {}, 0.1), ("synthetic_building", {"sensor": "depth_camera"}, 0.05))
FLAT = ("synthetic_building_2d", {}, 0.1)
TARGET = Path(gt.__file__).parent / "mapping" / "codec" / "context_chances.py"


def mission_batches(world: str, options: dict, seed: int, duration: float) -> Iterator[Quantized]:
    """The components of every datagram of a mission."""
    mission = assemble(open_world(world, **options), TeamOptions(seed=seed, duration=duration))
    sent, send = [], mission.network.send

    def note(sender: int, datagrams: Sequence[bytes], now: float, kind: str) -> None:
        sent.extend(datagrams)
        send(sender, datagrams, now, kind)

    mission.network.send = note  # type: ignore[method-assign]
    while not mission.is_over:
        mission.tick(mission.elapsed)
    for datagram in sent:
        message = decode(datagram)
        if isinstance(message, ComponentsMessage):
            yield in_order(message.components)


def in_order(components: gt.Components) -> Quantized:
    """Quantised components in spatial order, numbered in a row."""
    values = quantize(components.rearranged(spatial_order(components)))
    values.ids[:, 1] = values.ids[:, 1].sort().values
    return values


def learned(batches: Iterable[Quantized]) -> Tensor:
    """The chance of each slot in 1/256; 0: unknown."""
    first = context_model.first_tables()
    tables = ChanceTables(
        chances=torch.full_like(first.chances, 1 << 15),
        n_coded=torch.zeros_like(first.n_coded),
        rates=torch.tensor([(10 << 16) // (10 * n + 16) for n in range(MEMORY + 1)]),
        first_slot=first.first_slot,
    )
    for values in batches:
        stream = torch.zeros(256 + 96 * len(values) + 24 * len(values.origins), dtype=torch.uint8)
        batch = coded(values, cell_exponent(values.places))
        assert context_coding(batch, tables, stream, writes=True) > 0
    return torch.where(tables.n_coded < FEWEST, 0, (tables.chances >> 8).clamp(1, 255))


def map_batch(name: str, options: dict, resolution: float) -> Quantized:
    found = gt.GaussianMap(resolution=resolution)
    for scan in gt.datasets.load(name, **options):
        found.insert(scan)
    return in_order(found.components())


def main() -> None:
    batches = [map_batch(*FLAT), *(map_batch(*one) for one in MAPS)]
    for one in MISSIONS:
        batches += mission_batches(*one)
    save(learned(batches))


def save(chances: Tensor) -> None:
    text = base64.b85encode(zlib.compress(bytes(chances.tolist()), 9)).decode()
    assert not set(text) & set('"\\')
    rows = "\n".join(textwrap.wrap(text, 100))
    TARGET.write_text(
        '"""The chances with which the slots of `context_model` begin, learned from simulated worlds;\n'
        "written by scripts/context_chances.py. A byte for each slot: the probability of a 0 in 1/256; 0:\n"
        'unknown."""\n\n'
        f'CHANCES = """\n{rows}\n"""\n',
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
