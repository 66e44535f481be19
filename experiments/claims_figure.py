"""The paper's claims in one figure: standardized differences with intervals, colored by verdict."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from experiments import figures
from experiments.verdict import Claim
from matd3_jax.figures import style
from matd3_jax.figures.style import web

REACH = 3.0
"""Standard deviations that the axis shows each way; beyond, an arrow."""

VERDICTS = {"same": web(style.BLUE), "not shown": web(style.GREY), "opposite": web(style.VERMILION)}

SHORT: dict[str, tuple[str, ...]] = {
    "cooperative": (
        "Navigation: similar final level",
        "Navigation: MATD3 learns faster (mean return)",
        "Navigation: MATD3 learns faster (time until learned)",
        "Communication: MATD3 ends better",
    ),
    "overestimation": (
        "MADDPG overestimates",
        "... most of all early",
        "MATD3 underestimates",
        "MATD3 reaches higher true values",
        "MADDPG: overestimating seeds end worse",
        "MADDPG overestimates, beyond the targets' lag",
        "MATD3 underestimates, beyond the targets' lag",
    ),
    "competitive": (
        "Keep-away: MATD3 wins",
        "Physical Deception: MATD3 wins",
        "Predator-Prey: MATD3 wins",
        "Covert Communication: MADDPG wins",
    ),
    "policy_delay": (
        "Navigation: d = 2 better than 1",
        "Navigation: d = 3 better than 1",
        "Navigation: d = 2 varies less",
        "Navigation: d = 3 varies less",
        "Covert Comm.: d = 2 helps the adversary",
        "Covert Comm.: d = 3 helps the adversary",
        "Covert Comm.: d = 2 does not help the team",
        "Covert Comm.: d = 3 does not help the team",
    ),
    "target_smoothing": ("no gain from σ = 0.1", "no gain from σ = 0.2", "no gain from σ = 0.4"),
    "number_of_agents": (
        "MADDPG: number of agents does not matter",
        "MATD3: number of agents does not matter",
        "MADDPG: the same beyond the targets' lag",
        "MATD3: the same beyond the targets' lag",
    ),
    "grid_search": ("lr 0.01, batch 1000, d 2 work best",),
    "ant": (
        "Ant: MATD3 better than MADDPG",
        "Ant: MATD3 better than IL-TD3",
        "Ant: IL-TD3 fails",
        "Ant: single-agent TD3 ends best",
        "Ant: ... and is slower at first",
    ),
}
"""The claims of each study in its order, in a few words."""

TITLES = {
    "cooperative": "Cooperative tasks",
    "overestimation": "Overestimation",
    "competitive": "Competitive tasks",
    "policy_delay": "Delayed policy updates",
    "target_smoothing": "Target policy smoothing",
    "number_of_agents": "Number of agents",
    "grid_search": "Grid search",
    "ant": "Robots",
}


def draw(found: Sequence[tuple[str, str, Claim, bool]], path: Path) -> None:
    """Write the figure of (study, short claim, claim, whether of small runs); claims without data are left out, and
    counted."""
    there = [entry for entry in found if entry[2].difference is not None]
    groups = list(dict.fromkeys(name for name, *_ in there))
    rows = len(there) + len(groups)
    figure, (axis,) = figures.canvas(1, width=8.0, height=1.3 + 0.235 * rows)
    axis.grid(False)
    position, ticks = 0, {}
    above = axis.get_yaxis_transform()
    axis.text(1.02, -1.0, "difference", transform=above, fontsize=8, va="center", ha="left")
    for group in groups:
        axis.text(
            -0.72, position, TITLES.get(group, group), transform=axis.get_yaxis_transform(), fontsize=9, va="center",
            fontweight="bold",
        )  # fmt: skip
        position += 1
        for name, short, claim, small in there:
            if name == group:
                _row(axis, position, claim, small)
                ticks[position] = short
                position += 1
    axis.set_yticks(list(ticks), list(ticks.values()), fontsize=8.5)
    axis.tick_params(axis="y", length=0)
    axis.set_ylim(rows - 0.4, -0.6)
    axis.set_xlim(-REACH, REACH)
    axis.axvline(0, color="black", linewidth=0.8)
    axis.spines["left"].set_visible(False)
    axis.set_xlabel("difference in standard deviations over seeds, positive as the paper has it")
    handles = [Line2D([], [], marker="o", color=color, label=word) for word, color in VERDICTS.items()]
    handles.append(Line2D([], [], color="black", alpha=0.15, linewidth=7, label='margin of "no difference"'))
    if any(small for *_, small in there):
        handles.append(
            Line2D(
                [], [], marker="o", color="black", markerfacecolor="white", label="small runs (robots: half-cheetah)"
            )
        )
    missing = len(found) - len(there)
    title = f"not yet run: {missing} more" if missing else None
    figure.legend(
        handles=handles, loc="outside upper center", ncols=5, frameon=False, fontsize=8.5, title=title,
        title_fontsize=8.5, handlelength=1.5, columnspacing=1.2,
    )  # fmt: skip
    style.save(figure, path, dpi=100)


def _row(axis: Axes, position: int, claim: Claim, small: bool) -> None:
    """A claim's difference with its interval; at the edge an arrow for what lies beyond; its numbers at the right."""
    d, color = claim.difference, VERDICTS[claim.verdict]
    assert d is not None
    unit = d.unit or 1.0
    value, low, high = (end / unit for end in (d.estimate, d.low, d.high))
    if claim.kind != "greater":
        margin = claim.margin / unit
        left = -REACH if claim.kind == "no gain" else max(-REACH, -margin)
        axis.barh(position, min(REACH, margin) - left, 0.7, left, color="black", alpha=0.12, linewidth=0)
    if low == low:
        axis.plot([max(low, -REACH), min(high, REACH)], [position] * 2, color=color, linewidth=2, solid_capstyle="butt")
    inside = min(max(value, -REACH), REACH)
    if inside == value:
        axis.plot(value, position, "o", color=color, markersize=5.5, markerfacecolor="white" if small else color)
    for end, sign, marker in ((high, 1, ">"), (low, -1, "<")):
        if sign * end > REACH or sign * value > REACH:
            fill = "white" if small else color
            axis.plot(sign * REACH, position, marker, color=color, markersize=6, markerfacecolor=fill, clip_on=False)
    text = f"{d.estimate:+,.0f}" if abs(d.estimate) >= 100 else f"{d.estimate:+.3g}"
    axis.annotate(
        text, (1.02, position), xycoords=axis.get_yaxis_transform(), va="center", fontsize=8, color=color,
        annotation_clip=False,
    )  # fmt: skip
