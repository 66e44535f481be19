"""Env steps/s over seeds and over environments, into rates.png."""

from benchmarks.gpu.report import Report, Row
from experiments import figures
from matd3_jax.figures.style import SERIES

PANELS = {
    "seeds": ("simple_spread", "seeds", ("loop", "update", "rollout")),
    "ant": ("Ant", "environments of each seed", ("loop, mjx", "physics, mjx", "physics, mjx_fast")),
}


def draw(report: Report) -> None:
    """Nothing where no rate was measured."""
    there = {part: rows for part in PANELS if (rows := report.rows(part))}
    if not there:
        return
    figure, axes = figures.canvas(len(there))
    for axis, (part, rows) in zip(axes, there.items(), strict=True):
        title, label, kinds = PANELS[part]
        for kind, color in zip(kinds, SERIES, strict=False):
            points = sorted(
                (place(part, row), row["env_steps_per_second"])
                for name, row in rows.items()
                if f"{kind}," in f"{name},"  # not mjx_fast for mjx
            )
            if points:
                axis.loglog(*zip(*points, strict=True), "o-", color=color, label=kind)
        axis.set_title(title)
        axis.set_xlabel(label)
        axis.set_ylabel("env steps/s, all seeds together")
        axis.legend(frameon=False)
    figures.save(figure, report.out / "rates.png")


def place(part: str, row: Row) -> int:
    return row["num_envs"] if part == "ant" else row["seeds"]
