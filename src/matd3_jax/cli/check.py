"""`python -m matd3_jax.check run=RUN_DIR`: what a run directory, or a sweep's, holds, and how to resume it."""

from collections.abc import Sequence
from pathlib import Path

from matd3_jax import envs
from matd3_jax.cli import catalog, command
from matd3_jax.cli.sweep import open_sweep
from matd3_jax.errors import UserError
from matd3_jax.runs import lock
from matd3_jax.runtime.terminal import say
from matd3_jax.sweep.runner import Sweep
from matd3_jax.training import checkpoint, checksums, condition
from matd3_jax.training.condition import Condition


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code: 0 where nothing is damaged, 1 where something is. Changes nothing.

    Raises UserError (exit code 2) where there is no run, or none that can be resumed.
    """
    given = catalog.CHECK.parse(argv)
    if given.run is not None and given.sweep is None:
        return of_run(given.run)
    if given.sweep is not None and given.run is None:
        return of_sweep(given.sweep)
    raise UserError("say what to check: run=RUN_DIR or sweep=SWEEP_DIR")


def of_run(path: Path) -> int:
    """Say the condition of a run."""
    found = condition.of_run(path)
    say(f"run directory: {path}")
    _tell(found.lines(), found.problems)
    say(_way_on(found))
    return int(bool(found.problems))


def of_sweep(folder: Path) -> int:
    """Say the condition of a sweep, of its batches and of their runs."""
    if Sweep(folder).unfinished_plan():
        say(f"sweep directory: {folder}\ndamaged: its planning was cut short\n"
            "start it again: with the same command and the same name=")  # fmt: skip
        return 1
    sweep, _ = open_sweep(folder)
    batches, problems = sweep.batches, 0
    say(f"sweep directory: {folder}, {len(batches)} batches")
    left = []
    for number, names in enumerate(batches):
        wrong: list[str] = []
        place = sweep.folder_of(number)
        steps = checkpoint.steps(place / "checkpoints")
        for step in steps:
            why = checksums.damage(place / "checkpoints" / str(step))
            wrong += [f"checkpoint {place / 'checkpoints' / str(step)} is damaged ({why})"] if why else []
        finished, holder = True, lock.holder(place)
        for name in names:
            try:
                found = condition.of_run(sweep.runs / name)
            except UserError as error:
                wrong.append(str(error))
                finished = False
                continue
            wrong += [f"{name}: {problem}" for problem in found.problems]
            finished = finished and found.finished
        left += [] if finished else [number]
        state = "finished" if finished else f"at env step {steps[-1]:,}" if steps else "not begun"
        held = "" if holder is None else f", {holder} trains it"
        say(f"batch {number}: {len(names)} runs, {state}{held}")
        _tell([], wrong)
        problems += len(wrong)
    line = command.line("matd3_jax.sweep", resume=folder)
    say(f"resume with: {line}" if left else f"finished; make its table again with: {line}")
    return int(problems > 0)


def _tell(lines: Sequence[str], problems: Sequence[str]) -> None:
    for line in lines:
        say(f"  {line}")
    for problem in problems:
        say(f"damaged: {problem}")


def _way_on(found: Condition) -> str:
    path, env = found.run.path, found.settings.env["name"]
    if found.holder is not None:
        return f"wait for its end, or stop it: {found.holder} works in it"
    if found.damaged and not found.whole:
        return (
            f"no checkpoint can be read: take {found.run.checkpoints} away and train from the start with: "
            f"{command.line('matd3_jax.train', resume=path)}"
        )
    if env not in envs.names() and (found.whole or found.run.sweep is None):
        more = ", total_steps=N" if found.finished else ""
        state = "finished; train it on" if found.finished else "resume it"
        return f"{state} from Python: matd3_jax.resume({str(path)!r}, env={env}(...){more})"
    if found.finished and not found.needs_step:
        return f"finished; evaluate with: {command.line('matd3_jax.evaluate', run=path)}"
    if not found.whole and found.run.sweep is not None:
        return f"its sweep trains it; resume with: {command.line('matd3_jax.sweep', resume=found.run.sweep)}"
    step = {"checkpoint": found.resumable_from} if found.needs_step else {}
    start = "" if found.whole else " (from the start)"
    return f"resume with: {command.line('matd3_jax.train', resume=path, **step)}{start}"
