"""Variants of missions, by names made of the options in which they differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gmmtorch.exploration.mission.variants import NETWORK, differing
from gmmtorch.report.exploration.mission_style import framework_name
from gmmtorch.report.quantities import byte_text
from gmmtorch.report.style import Rows

_SHOWN = {"mcts": "MCTS", "csqmi": "CSQMI", "fsmi": "FSMI"}
_UNLIMITED = {"bandwidth": "no limit", "reach": "any reach", "budget": "no budget"}


def by_variant(rows: Rows, otherwise: str = "planner") -> dict[str, list[Mapping[str, Any]]]:
    """Rows of each variant, in the order they come, by name.

    A name has every option in which the rows differ; or, where they are all alike, the field `otherwise`.
    A network that loses nothing is called so where nothing else is to be said of it.
    """
    fields = differing(rows) or [otherwise]
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(_name(row, fields), []).append(row)
    return groups


def _name(row: Mapping[str, Any], fields: Sequence[str]) -> str:
    texts = {field: _text(field, row.get(field)) for field in fields}
    of_network = [texts[field] for field in fields if field in NETWORK]
    if of_network and not any(of_network):
        texts["loss"] = "lossless"
    return ", ".join(text for text in texts.values() if text)


def _text(field: str, value: Any) -> str:
    """What a name has of one option; nothing of trouble that there is not."""
    match field, value:
        case "planning_prior", _:
            return "no prior" if value is None else f"prior {value:g}"
        case "framework", _:
            return framework_name(str(value)).split()[0]
        case (("loss" | "duplication" | "partitions"), (None | 0 | [])):
            return ""
        case "loss", _:
            return f"{100 * value:g} % lost"
        case "duplication", _:
            return f"{100 * value:g} % twice"
        case "partitions", _:
            return ", ".join(map(_cut_text, value))
        case (("bandwidth" | "reach" | "budget"), None):
            return _UNLIMITED[field]
        case (("bandwidth" | "budget"), _):
            return f"{'budget ' if field == 'budget' else ''}{byte_text(value)}/s"
        case "reach", _:
            return f"reach {value:g} m"
        case (("delay" | "jitter" | "announce"), (int() | float())):
            return f"{field} {value:g} s"
        case _:
            return _SHOWN.get(str(value), str(value).replace("_", " "))


def _cut_text(cut: Mapping[str, Any]) -> str:
    """partition 0 | 1 2, 60–120 s."""
    groups = " | ".join(" ".join(map(str, group)) for group in cut["groups"])
    return f"partition {groups}, {cut['begin']:g}\N{EN DASH}{cut['end']:g} s"
