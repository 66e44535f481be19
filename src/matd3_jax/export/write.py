"""Exporting the policies of one seed: files, compared with JAX before they get their names."""

import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from matd3_jax.core.acting import PolicyParams
from matd3_jax.errors import UserError
from matd3_jax.export import compare, describe, numpy_file, onnx_file, saved_function
from matd3_jax.export.policy import function, perceptron
from matd3_jax.runs.paths import check_new_directory
from matd3_jax.runtime import files
from matd3_jax.training.saved_policies import SavedPolicies
from matd3_jax.training.session import TrainingSession

FORMATS = ("onnx", "numpy", "saved_fn")
INDEX = "policies.json"
"""What the folder holds, and what the policies' observations and actions mean."""


class Exported(NamedTuple):
    """What was written."""

    folder: Path
    files: tuple[str, ...]
    checked_by: str
    difference: float
    """The largest from JAX, in half ranges or as probabilities."""


def export(training: TrainingSession, saved: SavedPolicies, seed: int, format: str, out: Path) -> Exported:
    """Write each agent's deterministic policy of one seed into a new directory.

    Args:
        saved: policies of all seeds of the run.
        seed: number of the seed.
        format: one of `FORMATS`.
        out: the directory, not there yet or empty.

    Raises UserError where the seed's networks are not finite, the format does not hold them or its library is missing,
    something is at `out` already, or what was written differs from JAX: nothing is left then.
    """
    place = seed - training.config.seed
    if not 0 <= place < training.config.seeds:
        last = training.config.seed + training.config.seeds - 1
        raise UserError(f"seed={seed}: the seeds of the run are {training.config.seed} to {last}")
    if not saved.finite[place]:
        raise UserError(f"seed={seed} diverged: its networks are not finite at env step {saved.steps[place]:,}")
    if training.layout.recurrent:
        raise UserError("export writes policies of one observation; actors of actor=gru also have states")
    if format == "onnx":
        onnx_file.check()
    check_new_directory(out, "out")
    policy = training.trainer.policy(saved.state, average=True)
    one = jax.device_get(jax.tree.map(lambda leaf: leaf[place], policy))
    best = saved.evaluations[place] if saved.evaluations is not None else None
    which = "checkpoint" if best is None else "best evaluation"
    facts = {"format": format, **describe.facts(training, seed, int(saved.steps[place]), which)}
    facts["best_evaluation"] = None if best is None else best.facts
    partial = out.with_name(f".{out.name}.{os.getpid()}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        found = _written(training, one, facts, format, partial)
        if out.is_dir():
            out.rmdir()
        partial.rename(out)
        files.sync_folder(out.parent)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return found._replace(folder=out)


def _written(
    training: TrainingSession, policy: PolicyParams, facts: dict[str, Any], format: str, folder: Path
) -> Exported:
    """Write, read back, compare, and write the index."""
    layout, agents = training.layout, facts["agents"]
    functions = [function(layout, policy, i) for i in range(layout.num_agents)]
    names = _file_names(layout.agents, {"onnx": ".onnx", "saved_fn": ".saved_fn"}.get(format, ""))
    if format == "numpy":
        plain = [perceptron(layout, policy, i, format) for i in range(layout.num_agents)]
        names = list(numpy_file.write(folder, plain, facts).values())
        read = numpy_file.read(folder)
        runners = [
            lambda x, own=own: {"action": own(x), "probabilities": own.probabilities(x)}
            for own in (read[name] for name in layout.agents)
        ]
        by = f"NumPy {np.__version__}"
    else:
        runners, by = [], f"jax {jax.__version__}, jax.export"
        for i, name in enumerate(names):
            if format == "onnx":
                common = {key: value for key, value in facts.items() if key != "agents"}
                plain_one = perceptron(layout, policy, i, format)
                onnx_file.write(folder / name, plain_one, layout.agents[i], {**common, **agents[i]})
                run, by = onnx_file.runner(folder / name)
            else:
                saved_function.write(folder / name, functions[i], layout.observation_sizes[i])
                run = saved_function.read(folder / name)
            runners.append(run)
    seen = compare.observations(training, policy)
    expected = compare.wanted(training, policy, seen)
    apart = 0.0
    for i, (run, agent) in enumerate(zip(runners, layout.agents, strict=True)):
        own = np.asarray(layout.observation_part(seen, i))
        space, in_jax = layout.action_spaces[i], jax.jit(functions[i])
        apart = max(apart, compare.check(agent, by, space, run(own), expected[i], in_jax, own))
    checked = {"by": by, "observations": len(seen), "largest_difference": apart, "tolerance": compare.TOLERANCE}
    agents = [{"file": name, **agent} for name, agent in zip(names, agents, strict=True)]
    files.write_json(folder / INDEX, {**facts, "agents": agents, "checked": checked})
    for path in folder.iterdir():
        files.sync(path)
    return Exported(folder, tuple(sorted(path.name for path in folder.iterdir())), by, apart)


def _file_names(agents: Sequence[str], suffix: str) -> list[str]:
    """A name for each agent's file, made of its own."""
    plain = [re.sub(r"[^\w.+-]", "_", agent) for agent in agents]
    alike = len(set(plain)) < len(plain) or any(name.startswith(".") for name in plain)
    return [f"{i}-{name}{suffix}" if alike else f"{name}{suffix}" for i, name in enumerate(plain)]
