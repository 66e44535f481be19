"""The table that comes last: what was measured, its target, and what bounds it."""

from typing import Any

from benchmarks.gpu.report import Report, Row

SECONDS, RATE, ANT_MINUTES = 60.0, 1e6, 15.0
"""For 20 seeds x 60,000 episodes of simple_spread; env steps/s of all seeds; for 6 seeds x 1M env steps of the Ant."""


def lines(report: Report) -> list[str]:
    found = [f"WRONG: {what}" for what in report.wrong]
    clock = report.get("wall_clock", "default")
    if clock is not None:
        full = (clock["seeds"], clock["episodes"]) >= (20, 60_000)
        what = f"simple_spread, {clock['seeds']} seeds x {clock['episodes']:,} episodes"
        found += verdict(what, f"{clock['seconds']:.1f} s", clock["seconds"] <= SECONDS, f"{SECONDS:.0f} s", full)
        found += [f"  compilation, apart: {clock['compile_seconds']:.0f} s", *bound(report, clock["seeds"])]
        last = clock["returns"][-1]
        found.append(
            f"  return after {last['episodes']:,} episodes {last['ours']:.1f}, CPU {last['cpu']:.1f}: difference "
            f"{last['difference']:+.1f} ({last['low']:+.1f} to {last['high']:+.1f}), p = {last['p']:.2f}"
        )
    loops = [row for name, row in report.rows("seeds").items() if name.endswith("loop")]
    if loops:
        best = max(loops, key=lambda row: row["env_steps_per_second"])
        rate, what = best["env_steps_per_second"], f"simple_spread, most env steps/s ({best['seeds']} seeds)"
        found += [*verdict(what, f"{rate:,.0f}", rate >= RATE, f"{RATE:,.0f}"), *bound(report, best["seeds"])]
    ants = [row for name, row in report.rows("ant").items() if name.startswith("loop")]
    if ants:
        best = min(ants, key=lambda row: row["seconds_for_all"])
        minutes = best["seconds_for_all"] / 60
        what = f"Ant, mjx, {best['seeds']} seeds x 1M env steps ({best['num_envs']} environments)"
        full = best["seeds"] >= 6
        found += verdict(what, f"{minutes:.1f} min", minutes <= ANT_MINUTES, f"{ANT_MINUTES:.0f} min", full)
        found += shares(report.get("launches", "ant, 20 environments"))
    return [*found, *table(report)]


def verdict(what: str, value: str, met: bool, target: str, full: bool = True) -> list[str]:
    """full: measured at the size that the target is for."""
    return [f"{what}: {value}" + (f"; target {target}: {'met' if met else 'MISSED'}" if full else "")]


def bound(report: Report, seeds: int) -> list[str]:
    """What is known of where the time of an iteration goes with `seeds` seeds of simple_spread."""
    found = shares(report.get("launches", f"simple_spread, {seeds} seeds"))
    roofline = report.get("floor", f"{seeds} seeds")
    if roofline is not None:
        found.append(
            f"  roofline of an iteration: {1e3 * roofline['products_seconds']:.2f} ms of products, each at its own "
            f"shape ({roofline['flops'] / roofline['products_seconds'] / 1e12:.3g} TFLOP/s), "
            f"{1e3 * roofline['bytes_seconds']:.2f} ms of memory traffic at least"
        )
    return found


def shares(row: Row | None) -> list[str]:
    if row is None:
        return []
    if "idle" not in row:
        return [f"  launches: {row['device_stream']}"]
    whole, busy = 1e3 * row["cycle_seconds"], 1e3 * row["busy_seconds_per_cycle"]
    return [
        f"  an iteration takes {whole:.2f} ms, {busy:.2f} of them with a kernel running "
        f"({row['kernels_per_cycle']:.0f} kernels, {row['copies_per_cycle']:.0f} copies); "
        f"the rest, {row['idle']:.0%}, waits for launches"
    ]


def table(report: Report) -> list[str]:
    """All rates, a line for each case."""
    found = [f"{'part':<10} {'case':<55} {'env steps/s':>12} {'updates/s':>10} {'ms/iter':>10} {'compiled, s':>11}"]
    for part in report.parts:
        for name, row in report.parts[part].items():
            if "failed" in row:
                found.append(f"{part:<10} {name:<55} {row['failed'][:80]}")
            elif "cycle_seconds" in row:
                found.append(f"{part:<10} {name:<55} " + " ".join(cells(row)))
    return found


def cells(row: dict[str, Any]) -> list[str]:
    def cell(key: str, width: int, digits: int, scale: float = 1.0) -> str:
        return f"{scale * row[key]:>{width},.{digits}f}" if row.get(key) is not None else " " * width

    return [
        cell("env_steps_per_second", 12, 0),
        cell("updates_per_second", 10, 0),
        cell("cycle_seconds", 10, 2, 1e3),
        cell("compile_seconds", 11, 1),
    ]
