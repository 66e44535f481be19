"""What the paper found compared with what we found: differences with intervals and tests, and a word for each claim.

The word is decided by the 95 % confidence interval of one difference, which the paper's claim says is positive, or nil:

- `same`: the claim is borne out. "Greater": the whole interval lies above zero. "No difference": the whole interval
  lies within plus or minus the margin that the claim names. "No gain": the whole interval lies below the margin.
- `opposite`: the claim is contradicted. "Greater": the whole interval lies below zero. "No difference" and "no gain":
  the whole interval lies outside zero (above it, for "no gain"), and it is not `same`.
- `not shown`: neither; the data do not decide.
- `not yet run`: a setting that the claim speaks of has no finished runs.

Means are compared by Welch's t test, single means and differences within a seed by Student's, correlations by Fisher's
transformation. p-values are two-sided. Where a table has several, Holm's correction for all of its claims of the kind
"greater" is given, too; the words go by the uncorrected intervals.
"""

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy import stats

from experiments import markdown
from matd3_jax.stats import intervals
from matd3_jax.stats.text import NOTHING, ends, number

DEFINITIONS = (
    "*Same*: the 95 % interval of the difference lies wholly on the side that the paper claims; for claims of no "
    "difference wholly within ± margin, of no gain wholly below the margin. *Opposite*: it lies wholly on the other "
    "side of zero (no difference: outside zero and not *same*; no gain: above zero and not *same*). *Not shown*: "
    "neither. *Not yet run*: no finished runs. p-values are two-sided (means: Welch's or Student's t test; "
    "correlations: Fisher's transformation); verdicts go by the uncorrected intervals; p (Holm) is corrected for the "
    "claims of this table that name a direction."
)


@dataclasses.dataclass(frozen=True)
class Difference:
    """An estimate with its 95 % confidence interval and two-sided p-value; nan where there is none (one seed)."""

    estimate: float
    low: float
    high: float
    p: float
    unit: float = 0.0
    """Standard deviation over seeds, in which differences of different things can be compared; 0: none."""


@dataclasses.dataclass(frozen=True)
class Claim:
    """One thing that the paper found, and what we found.

    Attributes:
        paper: the claim in words.
        quantity: what `difference` is a difference of.
        difference: oriented so that the paper's claim, if it has a direction, is "greater than zero"; None: not yet
        run. kind: what the paper claims of it.
        margin: with "no difference" and "no gain": what still counts as none, in the units of the difference.
        found: our numbers in words.
    """

    paper: str
    quantity: str
    difference: Difference | None = None
    kind: Literal["greater", "no difference", "no gain"] = "greater"
    margin: float = 0.0
    found: str = ""

    @property
    def verdict(self) -> str:
        """same, opposite, not shown, or not yet run, as the module says."""
        if self.difference is None:
            return "not yet run"
        low, high = self.difference.low, self.difference.high
        if self.kind == "greater":
            same, opposite = low > 0, high < 0
        elif self.kind == "no difference":
            same, opposite = -self.margin <= low and high <= self.margin, low > 0 or high < 0
        else:
            same, opposite = high <= self.margin, low > 0
        return "same" if same else "opposite" if opposite else "not shown"


# ---- tests -----------------------------------------------------------------------------------------------------------


def difference(a: np.ndarray, b: np.ndarray) -> Difference:
    """Mean of a [n] minus mean of b [m], seeds of two settings (Welch)."""
    unit = np.sqrt((a.var(ddof=1) + b.var(ddof=1)) / 2) if min(len(a), len(b)) > 1 else 0.0
    return _of(intervals.compare(a, b), unit)


def mean(values: np.ndarray) -> Difference:
    """Mean of values [n] against zero (Student)."""
    unit = values.std(ddof=1) if len(values) > 1 else 0.0
    return _of(intervals.compare(values, np.zeros_like(values), paired=True), unit)


def correlation(x: np.ndarray, y: np.ndarray) -> Difference:
    """Pearson's correlation of x [n] and y [n] against zero; an interval from four points on."""
    if len(x) < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return Difference(np.nan, np.nan, np.nan, np.nan)
    test = stats.pearsonr(x, y)
    low, high = test.confidence_interval(0.95) if len(x) > 3 else (np.nan, np.nan)
    return Difference(float(test.statistic), float(low), float(high), float(test.pvalue), unit=1.0)


def slope(x: np.ndarray, y: np.ndarray) -> Difference:
    """Slope of the least-squares line of y [n] over x [n] against zero."""
    if len(x) < 3 or np.ptp(x) == 0:
        return Difference(np.nan, np.nan, np.nan, np.nan)
    line = stats.linregress(x, y)
    slope, half = float(line.slope), float(stats.t.ppf(0.975, len(x) - 2) * line.stderr)
    rest = y - line.intercept - slope * x
    unit = float(np.sqrt((rest**2).sum() / (len(x) - 2)))
    return Difference(slope, slope - half, slope + half, float(line.pvalue), unit)


def negative(found: Difference) -> Difference:
    """The same difference the other way round."""
    return Difference(-found.estimate, -found.high, -found.low, found.p, found.unit)


def spread(values: np.ndarray) -> np.ndarray:
    """Distance of each value from the median: compared by `difference` this is Brown and Forsythe's test of
    variances."""
    return np.abs(values - np.median(values))


def holm(p: Sequence[float]) -> list[float]:
    """p-values corrected for their number (Holm 1979); nan stays nan and does not count."""
    found = [float("nan")] * len(p)
    there = sorted((value, i) for i, value in enumerate(p) if not np.isnan(value))
    largest = 0.0
    for rank, (value, i) in enumerate(there):
        largest = max(largest, min(1.0, (len(there) - rank) * value))
        found[i] = largest
    return found


def _of(found: intervals.Comparison, unit: float) -> Difference:
    return Difference(*map(float, (found.difference, found.low, found.high, found.p, unit)))


# ---- claims ----------------------------------------------------------------------------------------------------------


def compare(
    paper: str,
    quantity: str,
    first: tuple[str, np.ndarray | None],
    second: tuple[str, np.ndarray | None],
    kind: Literal["greater", "no difference", "no gain"] = "greater",
    margin: float = 0.0,
    more: str = "",
    paired: bool = False,
) -> Claim:
    """The claim that the mean of `first` is greater than that of `second` (or another `kind`): (name, values
    [seeds]). `paired`: seed by seed, for what is the same run up to some point."""
    quantity = f"{quantity}: {first[0]} minus {second[0]}{', seed by seed' * paired}"
    (one, a), (other, b) = first, second
    if a is None or b is None:
        return Claim(paper, quantity, kind=kind, margin=margin)
    found = ", ".join(f"{name} {number(v.mean())} (n = {len(v)})" for name, v in ((one, a), (other, b)))
    between = mean(a - b) if paired else difference(a, b)
    return Claim(paper, quantity, between, kind, margin, found + more)


def lines(claims: Sequence[Claim]) -> list[str]:
    """A Markdown table of the claims."""
    head = ("the paper", "measured", "what we found", "difference (95 % interval)", "p", "p (Holm)", "verdict")
    rows = []
    directed = {i: c.difference.p for i, c in enumerate(claims) if c.difference is not None and c.kind == "greater"}
    corrected = dict(zip(directed, holm(list(directed.values())), strict=True))
    for i, claim in enumerate(claims):
        cells = [claim.paper, claim.quantity, claim.found or NOTHING, NOTHING, NOTHING, NOTHING, f"**{claim.verdict}**"]
        if claim.difference is not None:
            cells[3], cells[4] = in_words(claim), _p(claim.difference.p)
            cells[5] = _p(corrected[i]) if i in corrected else NOTHING
        rows.append(cells)
    return markdown.table(head, rows)


def in_words(claim: Claim) -> str:
    """The difference of a claim that has one, with its interval and the claim's margin."""
    d = claim.difference
    assert d is not None
    text = f"{'+' if d.estimate > 0 else ''}{number(d.estimate)} ({_interval(d)})"
    return text if claim.kind == "greater" else f"{text}; margin {number(claim.margin)}"


def _interval(d: Difference) -> str:
    return "no interval" if np.isnan(d.low) else ends(d.low, d.high)


def _p(p: float) -> str:
    return NOTHING if np.isnan(p) else "< 0.0001" if p < 0.0001 else f"{p:.2g}"
