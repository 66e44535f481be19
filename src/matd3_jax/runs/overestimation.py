"""How far the critics overestimate: columns of the metrics table, and what a run says of them."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from matd3_jax.core.algorithm import HyperParams
from matd3_jax.core.q_bias import Values
from matd3_jax.runs.metrics import by_seed
from matd3_jax.runs.summary import final
from matd3_jax.stats.intervals import mean_interval
from matd3_jax.stats.text import plus_minus

COLUMNS = ("q_estimate", "q_true", "q_true_interval", "overestimation", "overestimation_interval")
"""Of each agent, in the metrics table as AGENT_COLUMN."""

TOLERATED_TAIL = 0.02
"""Share of a constant reward's value beyond the rollouts' end, gamma^steps, above which a run says so."""

Final = tuple[float, float | None]
"""Mean and half width of its 95 % interval over seeds; None with one seed."""


def columns(agents: Sequence[str], found: Values | None, seeds: int) -> dict[str, np.ndarray]:
    """Columns [seeds] of the metrics table: means over the pairs, overestimation = estimate - truth, and half widths of
    95 % confidence intervals (Student's t, the pairs taken as independent; nan for one pair).

    found: [seeds, pairs, num_agents]; None: nan everywhere.
    """
    if found is None:
        return {f"{agent}_{name}": np.full(seeds, np.nan) for agent in agents for name in COLUMNS}
    estimates, truths = (np.asarray(values, np.float64) for values in found)
    truth, truth_half = mean_interval(truths, axis=1)
    over, over_half = mean_interval(estimates - truths, axis=1)
    table = dict(zip(COLUMNS, (estimates.mean(axis=1), truth, truth_half, over, over_half), strict=True))
    return {f"{agent}_{name}": table[name][:, i] for i, agent in enumerate(agents) for name in COLUMNS}


def tail_note(hyper: Sequence[HyperParams], steps: int) -> str | None:
    """One line where rollouts of `steps` end too early to be compared with the critics' infinite horizon; else None."""
    gamma = max(float(np.max(h.gamma)) for h in hyper)
    if gamma**steps <= TOLERATED_TAIL:
        return None
    line = (
        f"diagnostics.q_bias_steps={steps} leaves out {100 * gamma**steps:.0f} % of a constant reward's value "
        f"(gamma {gamma:g}), which counts as overestimation where rewards are positive"
    )
    if gamma == 1:
        return line
    enough = math.ceil(math.log(TOLERATED_TAIL) / math.log(gamma))
    return f"{line}; diagnostics.q_bias_steps={enough} leaves out {100 * TOLERATED_TAIL:.0f} %"


def summary(metrics: Mapping[str, np.ndarray], agents: Sequence[str]) -> dict[str, dict[str, Final]]:
    """For each agent its last estimate, truth and overestimation, and the mean overestimation of all evaluations of
    trained critics (of all, if there are none).

    Args:
        metrics: columns [rows] of the metrics table.
    """
    found = {}
    trained = metrics["updates"] > 0
    if trained.any():
        metrics = {name: column[trained] for name, column in metrics.items()}
    for agent in agents:
        values = {name: by_seed(metrics, f"{agent}_{name}")[1] for name in ("q_estimate", "q_true", "overestimation")}
        found[agent] = {name: final(curves[:, -1]) for name, curves in values.items()}
        found[agent]["overestimation_mean"] = final(values["overestimation"].mean(axis=1))
    return found


def lines(metrics: Mapping[str, np.ndarray], agents: Sequence[str], rollouts: int) -> list[str]:
    """The last evaluation of each agent's critics, for the terminal."""
    seeds = len(np.unique(metrics["seed"]))
    over = f"95 % interval over {seeds} seeds" if seeds > 1 else f"95 % interval over {rollouts} rollouts"
    found = [f"critics at the last evaluation ({rollouts} rollouts of each seed, {over}):"]
    for agent, finals in summary(metrics, agents).items():
        (estimate, _), (truth, _), (mean, half) = (finals[n] for n in ("q_estimate", "q_true", "overestimation"))
        if half is None:
            half = by_seed(metrics, f"{agent}_overestimation_interval")[1][0, -1] if rollouts > 1 else math.nan
        over = plus_minus(mean, half)
        found.append(f"  {agent}: estimate {estimate:.4g}, truth {truth:.4g}, overestimation {over}")
    return found


def team_values(metrics: Mapping[str, np.ndarray], agents: Sequence[str], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Env steps [evaluations] and the mean over `agents` of one of `COLUMNS`, [seeds, evaluations]."""
    steps = by_seed(metrics, f"{agents[0]}_{name}")[0]
    return steps, np.mean([by_seed(metrics, f"{agent}_{name}")[1] for agent in agents], axis=0)
