"""`python -m matd3_jax.export run=RUN_DIR format=onnx`: write the policies of one seed for other programs."""

from collections.abc import Sequence

from matd3_jax.cli import catalog
from matd3_jax.errors import UserError
from matd3_jax.export import compare, export, onnx_file
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runs.paths import check_new_directory
from matd3_jax.runtime import devices
from matd3_jax.runtime.terminal import say
from matd3_jax.training import saved_policies
from matd3_jax.training.session import TrainingSession


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit code."""
    options = catalog.EXPORT.parse(argv)
    if options.which is not None and options.checkpoint is not None:
        raise UserError(f"which={options.which} and checkpoint={options.checkpoint} both say which policies: give one")
    if options.format == "onnx":
        onnx_file.check()
    if options.out is not None:
        check_new_directory(options.out, "out")
    devices.prepare()
    run, settings = RunDirectory.open(options.run)
    seed = settings.seed if options.seed is None else options.seed
    training = TrainingSession(settings)
    saved = saved_policies.load(run, training, options.which or options.checkpoint)
    place = min(max(0, seed - settings.seed), settings.seeds - 1)
    kept = "best" if saved.best else str(saved.steps[place])
    out = options.out or run.path / "export" / f"seed_{seed}-{kept}-{options.format}"
    found = export(training, saved, seed, options.format, out)
    say(
        f"{found.folder}: {', '.join(found.files)}\n"
        f"seed {seed}, env step {saved.steps[place]:,}{' (best evaluation)' * saved.best}; compared with JAX by "
        f"{found.checked_by} on {compare.OBSERVATIONS:,} observations: differs by {found.difference:.1e} at most"
    )
    return 0
