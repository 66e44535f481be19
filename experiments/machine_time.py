"""What the runs of a study took, from their facts: for each machine env steps, hours and rates."""

from collections.abc import Iterator, Mapping
from typing import Any

from experiments import collecting
from experiments.collecting import UNFINISHED


def lines(facts: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """A Markdown table of the finished settings; runs that were trained side by side share their hours by seeds."""
    rows: dict[tuple[str, ...], list[tuple[int, float]]] = {}
    for fact in facts.values():
        for machine, seeds, steps, seconds in _parts(fact):
            rows.setdefault(_machine(machine), []).append((seeds * steps, seconds))
    if not rows:
        return []
    table = ["| machine | jax | env steps of all seeds | hours | env steps/s |", "|---" * 5 + "|"]
    for machine, parts in rows.items():
        steps, seconds = sum(part[0] for part in parts), sum(part[1] for part in parts)
        table.append(f"| {' | '.join(machine)} | {steps:,} | {seconds / 3600:.2f} | {steps / seconds:,.0f} |")
    return ["Hours of training, compiling and evaluations included:", "", *table, ""]


def hours(facts: Mapping[str, Mapping[str, Any]]) -> float:
    """Of all finished settings, on whatever machine."""
    return sum(seconds for fact in facts.values() for *_, seconds in _parts(fact)) / 3600


def _parts(fact: Mapping[str, Any]) -> Iterator[tuple[Mapping[str, Any], int, int, float]]:
    """(machine, seeds, env steps of each, seconds that count for them) of a setting's runs."""
    for part in collecting.parts_of(fact) if fact["summary"] != UNFINISHED else ():
        summary, seeds = part["summary"], len(part["seeds"])
        if "seconds" in summary:
            together = summary.get("side_by_side", seeds)
            yield part["machine"], seeds, summary["total_steps"], summary["seconds"] * seeds / max(together, seeds)


def _machine(facts: Mapping[str, Any]) -> tuple[str, str]:
    """(devices, version of jax) in words."""
    kinds: dict[str, int] = {}
    for device in facts.get("devices", ["unknown"]):
        kind = device.partition(" ")[2] or device
        kinds[kind] = kinds.get(kind, 0) + 1
    names = [f"{n} x {facts.get('processor', kind) if kind == 'cpu' else kind}" for kind, n in kinds.items()]
    return ", ".join(names), facts.get("versions", {}).get("jax", "unknown")
