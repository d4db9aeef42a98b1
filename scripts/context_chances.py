"""Learns the chances with which the codec's slots begin, and writes them into the package.

    python scripts/context_chances.py                # those of coarse batches
    python scripts/context_chances.py --attributes   # those of attributes

They are learned from simulated worlds only: all datagrams of components of two missions, in tunnels and in a
warehouse other than those of the benchmarks; those of attributes from the synthetic buildings with random
colours and reflectivities. Those of version 2, from an earlier form of these missions and the maps of the
buildings, stay as they are. Takes about 5 minutes. New chances need a new version of batches.
"""

from __future__ import annotations

import base64
import dataclasses
import itertools
import math
import sys
import textwrap
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import gmmtorch as gt
from gmmtorch.kernels import ChanceTables, context_coding, number_coding
from gmmtorch.mapping.codec import context_model, number_model
from gmmtorch.mapping.codec.attribute_block import rows_of
from gmmtorch.mapping.codec.component_batch import coded
from gmmtorch.mapping.codec.context_chances import CHANCES, OF_ATTRIBUTES, OF_COARSE
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
DATAGRAM = 90  # components
WIDTH = {"colour": 3, "intensity": 1}
LIGHTNESS = torch.tensor([[1.0, 1, 1], [1, 0, -1], [1, -2, 1]], dtype=torch.float64)
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
    """Coarse components in spatial order, numbered in a row."""
    values = quantize(components.rearranged(spatial_order(components)), coarse=True)
    values.ids[:, 1] = values.ids[:, 1].sort().values
    return values


def learned(batches: Iterable[Quantized]) -> Tensor:
    """The chance of each slot in 1/256; 0: unknown."""
    tables = blank(context_model.first_tables(coarse=True))
    for values in batches:
        stream = np.zeros(256 + 96 * len(values) + 24 * len(values.origins), np.uint8)
        batch = coded(values, cell_exponent(values.places) + 1, coarse=True)
        assert context_coding(batch, tables, stream, writes=True) > 0
    return found(tables)


def blank(first: ChanceTables) -> ChanceTables:
    return ChanceTables(
        chances=np.full_like(first.chances, 1 << 15),
        n_coded=np.zeros_like(first.n_coded),
        rates=np.array([(10 << 16) // (10 * n + 16) for n in range(MEMORY + 1)]),
        first_slot=first.first_slot,
    )


def found(tables: ChanceTables) -> Tensor:
    chances = np.where(tables.n_coded < FEWEST, 0, np.clip(tables.chances >> 8, 1, 255))
    return torch.from_numpy(chances)


def painted(scan: gt.Scan, generator: torch.Generator) -> gt.Scan:
    """The scan with colours whose waves have amplitudes in proportion to their lengths, from 16 m to 0.1 m,
    as in photographs (Field 1987), and a reflectivity of each surface. With noise."""
    fixed = torch.Generator().manual_seed(0)
    points = torch.nn.functional.pad(scan.points.double(), (0, 3 - scan.dim))
    tone = torch.zeros(len(points), 3, dtype=torch.float64)
    for octave in range(8):
        for _ in range(4):
            direction = torch.nn.functional.normalize(torch.randn(3, generator=fixed).double(), dim=0)
            phase = points @ direction * (2 * math.pi * 2**octave / 16) + 6.3 * torch.rand(1, generator=fixed)
            tint = torch.tensor([1.0, 0.3, 0.2]).double() * torch.randn(3, generator=fixed).double()
            tone += 0.3 * 0.6**octave * phase.sin()[:, None] * tint
    colour = 0.4 + tone @ LIGHTNESS / math.sqrt(3)
    noise = torch.randn(len(points), 4, generator=generator).double()
    cell = (points / 3).floor().long() @ torch.tensor([7, 13, 29])
    level = 20 + 60 * torch.rand(64, generator=fixed).double()[cell % 64] + 5 * noise[:, 3]
    channels = {"colour": (colour + 0.02 * noise[:, :3]).clamp(0, 1), "intensity": level}
    return dataclasses.replace(scan, attributes=channels)


def learned_attributes() -> Tensor:
    """The chances of `number_model`, from parts of maps as large as datagrams."""
    generator = torch.Generator().manual_seed(1)
    tables = blank(number_model.first_tables())
    for name, options, resolution in (FLAT, *MAPS):
        made = gt.GaussianMap(resolution=resolution)
        for scan in gt.datasets.load(name, **options):
            made.insert(painted(scan, generator))
        c = made.components()
        c = c.rearranged(spatial_order(c))
        for channel, rows in rows_of(c.attributes, c.covariances).items():
            for part in rows.split(DATAGRAM):
                stream = np.zeros(64 + 64 * part.numel(), np.uint8)
                width, power = WIDTH[channel], number_model.powers()
                assert number_coding(part.contiguous(), width, power, tables, stream, writes=True) > 0
    return found(tables)


def main() -> None:
    if "--attributes" in sys.argv:
        save(CHANCES, OF_COARSE, packed(learned_attributes()))
        return
    batches = itertools.chain.from_iterable(mission_batches(*one) for one in MISSIONS)
    save(CHANCES, packed(learned(batches)), OF_ATTRIBUTES)


def packed(chances: Tensor) -> str:
    text = base64.b85encode(zlib.compress(bytes(chances.tolist()), 9)).decode()
    assert not set(text) & set('"\\')
    return "\n" + "\n".join(textwrap.wrap(text, 109, break_on_hyphens=False)) + "\n"


def save(fine: str, coarse: str, attributes: str) -> None:
    TARGET.write_text(
        '"""The chances with which the slots of `context_model` and `number_model` begin, learned from\n'
        "simulated worlds; written by scripts/context_chances.py. A byte for each slot: the probability of\n"
        'a 0 in 1/256; 0: unknown."""\n\n'
        f'CHANCES = """{fine}"""\nOF_COARSE = """{coarse}"""\nOF_ATTRIBUTES = """{attributes}"""\n',
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
