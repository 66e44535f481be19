"""`python -m experiments.all`: every experiment of the paper, one after another, and a summary of all claims.

    python -m experiments.all [scale=paper|small] [seeds=N] [train=true|false] [skip=[ant,...]] [runs=DIR] [out=DIR]
                              [key=value ...]

Takes the options of the single experiments and gives them to each. Whatever is finished is used as it is, so a call
that was stopped resumes with the same command. `runs` and `out` are folders of folders here, one for each experiment;
the summary is summary.md (summary_small.md) in `out`. `skip` leaves experiments out. An experiment that cannot be run
(no memory, a setting that it does not take) is reported in the summary, and the next one follows.
"""

from collections.abc import Sequence
from pathlib import Path

from experiments import (
    ant,
    competitive,
    cooperative,
    grid_search,
    number_of_agents,
    overestimation,
    policy_delay,
    study,
    target_smoothing,
    verdict,
)
from experiments.study import RESULTS, Stopped, Study
from experiments.tidy import Table
from matd3_jax import config
from matd3_jax.cli import command
from matd3_jax.errors import UserError, nearest

STUDIES: dict[str, Study] = {
    module.STUDY.name: module.STUDY
    for module in (
        cooperative,
        overestimation,
        competitive,
        policy_delay,
        target_smoothing,
        number_of_agents,
        grid_search,
        ant,
    )
}
"""In this order: first what the paper's main claims are about, last what takes longest."""


def main(argv: Sequence[str]) -> int:
    if {"-h", "--help"} & set(argv):
        print(str(__doc__).strip() + "\n" + study.HELP)
        return 0
    taken, rest = config.take(argv, ("skip", "runs", "out"))
    skip = taken.get("skip", [])
    for name in skip if isinstance(skip, list) else [skip]:
        if name not in STUDIES:
            raise UserError(f"skip={skip}: there is no experiment {name!r}; {nearest(str(name), tuple(STUDIES))}")
    out = Path(str(taken.get("out", RESULTS)))
    lines: list[str] = []
    failed = 0
    for name, one in STUDIES.items():
        if name in skip:
            continue
        options, _ = study.parse(one, rest)
        runs_folder, out_folder = study.folders(one, options)
        more = [f"out={out / out_folder.name}"]
        more += [f"runs={Path(str(taken['runs'])) / runs_folder.name}"] if "runs" in taken else []
        print(f"\n==== {name}", flush=True)
        lines += [f"## {one.title}", ""]
        try:
            claims = study.run(one, [*rest, *more])
            lines += verdict.lines(one.claims(Table({})) if claims is None else claims)
            lines += [] if claims is None else ["", f"[Protocol, all values, figure]({out_folder.name}/table.md)"]
        except UserError as error:
            print(f"error: {error}")
            lines += [*verdict.lines(one.claims(Table({}))), "", f"Could not be run: {error}"]
            failed = 2
        except Stopped as stopped:
            print("stopped; resume with the same command")
            return stopped.code
        lines.append("")
    small = options["scale"] == "small"
    head = ["# The paper's claims, one by one" + (" (small runs)" if small else ""), "", verdict.DEFINITIONS, ""]
    out.mkdir(parents=True, exist_ok=True)
    summary = out / ("summary_small.md" if small else "summary.md")
    summary.write_text("\n".join([*head, *lines]).rstrip() + "\n")
    print(f"\nsummary: {summary}")
    return failed


if __name__ == "__main__":
    command.run(main)
