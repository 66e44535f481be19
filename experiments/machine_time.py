"""What the runs of a study took, from their facts: for each machine env steps, hours and rates."""

import json
from collections.abc import Iterable, Mapping
from typing import Any

from experiments import collecting, markdown
from experiments.collecting import UNFINISHED


def lines(facts: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """A Markdown table of the finished settings; runs that were trained side by side share their hours by seeds."""
    rows: dict[tuple[str, ...], list[tuple[int, float]]] = {}
    for fact in facts.values():
        for part in _parts(fact):
            steps = len(part["seeds"]) * part["summary"]["total_steps"]
            rows.setdefault(_machine(part["machine"]), []).append((steps, _seconds(part)))
    if not rows:
        return []
    cells = []
    for machine, parts in rows.items():
        steps, seconds = sum(part[0] for part in parts), sum(part[1] for part in parts)
        cells.append([*machine, f"{steps:,}", f"{seconds / 3600:.2f}", f"{steps / seconds:,.0f}"])
    head = ("machine", "jax", "env steps of all seeds", "hours", "env steps/s")
    return ["Hours of training, compiling and evaluations included:", "", *markdown.table(head, cells), ""]


def hours(studies: Iterable[Mapping[str, Mapping[str, Any]]]) -> float:
    """Of all finished settings of several studies' facts, on whatever machine; runs that they share count once."""
    seconds: dict[str, float] = {}
    for facts in studies:
        for fact in facts.values():
            settings = {key: value for key, value in fact["settings"].items() if key not in ("seed", "seeds")}
            for part in _parts(fact):
                run = json.dumps([settings, part["machine"], part["summary"]], sort_keys=True)
                seconds[run] = max(seconds.get(run, 0.0), _seconds(part))
    return sum(seconds.values()) / 3600


def _parts(fact: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A finished setting's runs whose time is known."""
    if fact["summary"] == UNFINISHED:
        return []
    return [part for part in collecting.parts_of(fact) if "seconds" in part["summary"]]


def _seconds(part: Mapping[str, Any]) -> float:
    """What counts for a run's seeds of those that were trained side by side."""
    seeds = len(part["seeds"])
    return part["summary"]["seconds"] * seeds / max(part["summary"].get("side_by_side", seeds), seeds)


def _machine(facts: Mapping[str, Any]) -> tuple[str, str]:
    """(devices, version of jax) in words."""
    kinds: dict[str, int] = {}
    for device in facts.get("devices", ["unknown"]):
        kind = device.partition(" ")[2] or device
        kinds[kind] = kinds.get(kind, 0) + 1
    names = [f"{n} x {facts.get('processor', kind) if kind == 'cpu' else kind}" for kind, n in kinds.items()]
    return ", ".join(names), facts.get("versions", {}).get("jax", "unknown")
