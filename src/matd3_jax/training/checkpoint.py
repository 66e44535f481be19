"""Checkpoints: everything a run carries, written with Orbax, checked by checksum before it is read back.

Layout of one: `STEP/state` (all but the replay; several processes write `STEP/state/FIRST`, each its seeds, from number
FIRST on), `STEP/replay/SEED` (the rows filled so far, see `training.saved_replay`; none in what a sweep leaves of its
runs), `STEP/best/SEED.npz` (see `training.best`), `STEP/host/SEED` (of environments on the host that are pickled),
`STEP/metrics.json` (see `runs.table_digest`), `STEP/population.json` (of a sweep's population), `STEP/checksums.json`
(see `training.checksums`). A checkpoint appears under its name only when it is whole. What some processes wrote any
other number of them can read.
"""

import contextlib
import glob
import json
import logging
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from matd3_jax.core import replay
from matd3_jax.errors import UserError
from matd3_jax.runs import table_digest
from matd3_jax.runtime import files
from matd3_jax.runtime.multihost import SINGLE_PROCESS, Share
from matd3_jax.training import checksums, host_states, saved_replay
from matd3_jax.training.best import BestPolicies
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.state import TrainState

RENAMED = ((".rollouts", ".collects"), ("_optimizer", "_optimiser"))
"""Parts of leaves' paths, and what older checkpoints have instead."""

ASIDE = ".set_aside"
"""At the end of the names of checkpoints that a run no longer leads to."""

# Orbax logs every step at INFO, warns of its own defaults, and logs what it raises with its traceback.
logging.getLogger("absl").setLevel(logging.CRITICAL)


def save(
    folder: Path,
    step: int,
    trainer: TrainLoop,
    state: TrainState,
    keep: int,
    seeds: slice | None = None,
    share: Share | None = None,
    best: BestPolicies | None = None,
    tables: Sequence[Path] = (),
    more: Callable[[Path], Path] | None = None,
) -> Path:
    """Write the checkpoint of env step `step` and delete all but the newest `keep`.

    Args:
        seeds: write these seeds' part alone, without their replay: enough to evaluate them, not to resume. None: all.
        share: which seeds the trainer has. Every process writes its own, the first makes a checkpoint of it. None:
            there are no others.
        best: the policies of the trainer's seeds to be kept with it.
        tables: metrics tables of its runs, so that it is noticed when they are changed.
        more: writes a further file into its folder, and returns it.
    """
    share = share or SINGLE_PROCESS.share(trainer.num_seeds)
    processes, wanted = share.processes, seeds or slice(0, share.total)
    folder = folder.resolve()
    final, partial_ = folder / str(step), folder / f".{step}.partial"
    if processes.first:
        shutil.rmtree(partial_, ignore_errors=True)
        partial_.mkdir(parents=True)
    processes.barrier()
    written = []
    first, last = max(share.first, wanted.start), min(share.last, wanted.stop)
    with _without_wildcards(partial_) as there, ocp.StandardCheckpointer() as checkpointer:
        if first < last:
            written.append(partial_ / "state")
            if last - first < wanted.stop - wanted.start:
                written[0] /= str(first - wanted.start)
            own = slice(first - share.first, last - share.first)
            checkpointer.save(there / written[0].relative_to(partial_), _leaves(trainer, state, own))
        if seeds is None and processes.first:
            (partial_ / "replay").mkdir(exist_ok=True)  # there even before the first row
        for seed, rows in saved_replay.filled_rows(trainer, state) if seeds is None else ():
            if not rows.size:
                continue  # Orbax does not write what has no numbers
            written.append(partial_ / "replay" / str(share.first + seed))
            checkpointer.save(there / written[-1].relative_to(partial_), {"rows": rows})
            checkpointer.wait_until_finished()
    if best is not None:
        written += best.write(partial_, {k - share.first: k - wanted.start for k in range(first, last)})
    if seeds is None:
        written += host_states.save(partial_, trainer, state, share)
    if tables and processes.first:
        written.append(table_digest.write(partial_, tables))
    if more is not None and processes.first:
        written.append(more(partial_))
    parts = processes.gather_messages(json.dumps(checksums.of(partial_, written)).encode())
    if processes.first:
        checksums.write(partial_, [json.loads(part) for part in parts])
        if final.is_symlink():
            _remove(final)
        elif final.exists():  # kept until its successor has its name
            _aside(final)
        partial_.rename(final)
        files.sync_folder(folder)
        for old in steps(folder)[:-keep]:
            _remove(folder / str(old))
        for aside in folder.glob(f"*{ASIDE}"):
            _remove(aside)
    return final


def _remove(path: Path) -> None:
    """Remove a checkpoint, if it is there; of a link to one the link."""
    if path.is_symlink():
        path.unlink()
    elif path.exists():
        shutil.rmtree(path)


def set_aside_after(folder: Path, step: int) -> None:
    """Rename the checkpoints after env step `step`, which the run is resumed from: it is going to have others there.

    They are kept until the next checkpoint is written.
    """
    for later in steps(folder):
        if later > step:
            _aside(folder / str(later))


def _aside(path: Path) -> None:
    aside = path.with_name(f"{path.name}{ASIDE}")
    _remove(aside)
    path.rename(aside)


def recover(folder: Path) -> None:
    """Give a checkpoint that was whole when the process was killed its name, and delete what is not whole.

    Nobody else may work in `folder` now.
    """
    for left in folder.glob(".*.partial"):
        final = folder / left.name.removeprefix(".").removesuffix(".partial")
        if not final.exists() and final.name.isdigit() and checksums.damage(left) is None:
            left.rename(final)
        else:
            shutil.rmtree(left, ignore_errors=True)


@contextlib.contextmanager
def _without_wildcards(folder: Path) -> Iterator[Path]:
    """`folder` by a path that a pattern matches literally: Orbax looks for the files that it has written by a pattern
    made of their path, and would leave a checkpoint that cannot be read where a directory is called `[1]`."""
    if glob.escape(str(folder)) == str(folder):
        yield folder
        return
    with tempfile.TemporaryDirectory() as place:
        link = Path(place) / "checkpoint"
        link.symlink_to(folder, target_is_directory=True)
        yield link


def steps(folder: Path) -> list[int]:
    """Env steps of the whole checkpoints in `folder`, ascending."""
    if not folder.is_dir():
        return []
    return sorted(int(path.name) for path in folder.iterdir() if path.name.isdigit() and path.is_dir())


def verify(folder: Path, step: int | None = None) -> Path:
    """The checkpoint of env step `step` (None: the last). Raises UserError if it is missing or damaged; the message
    names the damaged file, and the checkpoint before it."""
    found = steps(folder)
    if not found:
        raise UserError(f"{folder} holds no checkpoint")
    step = found[-1] if step is None else step
    if step not in found:
        raise UserError(f"{folder} holds no checkpoint of step {step}; there: {', '.join(map(str, found))}")
    path = folder.resolve() / str(step)
    damaged = checksums.damage(path)
    if damaged is not None:
        before = [other for other in found if other < step]
        hint = f"resume from the one before it with checkpoint={before[-1]}" if before else "there is none before it"
        raise UserError(f"the checkpoint {folder / str(step)} is damaged ({damaged}); {hint}")
    return path


def restore(
    path: Path,
    trainer: TrainLoop,
    share: Share | None = None,
    unpickle: bool = False,
    best: BestPolicies | None = None,
) -> TrainState:
    """The state in the checkpoint at `path`, as `verify` gave it. Raises UserError if it holds no replay or does not
    fit the trainer.

    Args:
        share: which of the checkpoint's seeds the trainer has; None: all.
        unpickle: let environments on the host go on from their pickles, where there are any; what is unpickled can run
            any program. Otherwise they start new episodes.
        best: gets the policies of the best evaluations up to there.
    """
    if not (path / "replay").is_dir():
        raise UserError(f"{path} holds no replay: what a sweep leaves of a run can be evaluated, not resumed")
    share = share or SINGLE_PROCESS.share(trainer.num_seeds)
    small = _rebuild(trainer, path, share)
    rows = saved_replay.restore(path, trainer, share, int(small.rollouts))
    if best is not None:
        best.restore(path, share)
    return host_states.restored(path, trainer, small._replace(replay=rows), share, unpickle)


def restore_actors(path: Path, trainer: TrainLoop, share: Share | None = None) -> TrainState:
    """The state without its replay (an empty one instead): enough to evaluate. share: as for `restore`."""
    return _rebuild(trainer, path, share or SINGLE_PROCESS.share(trainer.num_seeds))


def read_state(path: Path, first: int, last: int, total: int) -> dict[str, np.ndarray]:
    """Leaves of the state by path, with the seeds from number `first` to before `last` of the checkpoint's `total`."""
    starts = sorted(int(part.name) for part in (path / "state").iterdir() if part.name.isdigit())
    ends = [*starts[1:], total] if starts else [total]
    found: list[dict[str, np.ndarray]] = []
    with ocp.StandardCheckpointer() as checkpointer:
        for start, end in zip(starts or [0], ends, strict=True):
            if first < end and start < last:
                saved = checkpointer.restore(path / "state" / str(start) if starts else path / "state")
                leaves = {name: np.asarray(leaf) for name, leaf in saved.items()}
                if any(leaf.ndim and len(leaf) != end - start for leaf in leaves.values()):
                    raise UserError(f"{path} has other seeds than these settings")
                own = slice(max(first - start, 0), last - start)
                found.append({name: leaf[own] if leaf.ndim else leaf for name, leaf in leaves.items()})
    return {
        name: np.concatenate([part[name] for part in found]) if leaf.ndim else leaf for name, leaf in found[0].items()
    }


def _leaves(trainer: TrainLoop, state: TrainState, seeds: slice) -> dict[str, np.ndarray]:
    """All leaves but the replay by path, keys as their data, without the copies that fill up the devices; `seeds` of
    them."""
    plain = state._replace(replay=None, key=jax.random.key_data(state.key))  # type: ignore[arg-type]
    found = jax.tree_util.tree_flatten_with_path(plain)[0]
    whole = {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in found}
    whole = {name: leaf for name, leaf in whole.items() if leaf.size}  # Orbax does not write what has no numbers
    return {name: leaf[: trainer.num_seeds][seeds] if leaf.ndim else leaf for name, leaf in whole.items()}


def _rebuild(trainer: TrainLoop, path: Path, share: Share) -> TrainState:
    saved = read_state(path, share.first, share.last, share.total)
    template = trainer.abstract_state()
    shape = jax.eval_shape(jax.random.key_data, template.key)
    template = template._replace(replay=None, key=shape)  # type: ignore[arg-type]
    names, treedef = jax.tree_util.tree_flatten_with_path(template)
    leaves = []
    for name, leaf in names:
        now = before = jax.tree_util.keystr(name)
        for new, old in RENAMED:
            before = before.replace(new, old)
        wanted = (trainer.num_seeds, *leaf.shape[1:]) if leaf.ndim else ()
        nothing = np.zeros(wanted, leaf.dtype) if 0 in wanted else np.array(np.nan)  # without numbers: not written
        value = saved.get(now, saved.get(before, nothing))
        if value.shape != wanted or value.dtype != leaf.dtype:
            raise UserError(f"{path}: {jax.tree_util.keystr(name)} does not fit these settings")
        leaves.append(value if not leaf.ndim else np.asarray(trainer.sharding.pad(value)))
    state = jax.tree.unflatten(treedef, leaves)
    state = state._replace(
        key=jax.random.wrap_key_data(jnp.asarray(state.key)),
        replay=replay.allocate(trainer.sharding.padded_seeds, 0, 0),
    )
    return jax.device_put(state, trainer.shardings)
