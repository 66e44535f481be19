"""The check of run directories and sweeps: what is said of each damage, the exit code, and that the way on leads on."""

import os
import shlex
import shutil

import pytest

from matd3_jax import config
from matd3_jax.cli import check, command, sweep
from matd3_jax.errors import UserError
from matd3_jax.runs import lock
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.training import checkpoint
from matd3_jax.training.recording import Recorder

SMALL = [
    "env=point_reach", "algo=iddpg", "seeds=2", "learning_starts=200", "num_envs=4", "rollout_length=5",
    "batch_size=16", "replay_capacity=400", "algo.hidden=[8]", "log_every=100", "eval_every=0",
]  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "a run"
    Recorder().start(config.load([*SMALL, "total_steps=600", "checkpoint_every=200", "keep_checkpoints=9"]), path)
    return path


@pytest.fixture
def run(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "a run")


def checked(path, capsys, key="run"):
    """Exit code, and what was said, of a check that must change nothing."""

    def contents():
        return {p: (p.read_bytes() if p.is_file() else None, p.lstat().st_mtime_ns) for p in path.rglob("*")}

    before = contents()
    code = check.main([f"{key}={path}"])
    assert contents() == before
    return code, capsys.readouterr().out


def way_on(said):
    """The arguments of the command that a check names."""
    (line,) = [line for line in said.splitlines() if "resume with: " in line]
    words = shlex.split(line.split("resume with: ")[1].removesuffix(" (from the start)"))
    assert words[:3] == ["python", "-m", "matd3_jax.train"]
    return words[3:]


@pytest.mark.slow
def test_a_finished_run(run, capsys):
    code, said = checked(run, capsys)
    steps = ", ".join(f"{step:,}" for step in checkpoint.steps(run / "checkpoints"))
    assert code == 0 and "damaged" not in said
    assert f"checkpoints: {steps}\n" in said and "summary: there" in said and "lock: free" in said
    assert said.splitlines()[-1] == f"finished; evaluate with: {command.line('matd3_jax.evaluate', run=run)}"


def unfinished(run):
    for name in ("summary.json", "learning_curve.png"):
        (run / name).unlink()


def damage_checkpoint(run):
    last = checkpoint.steps(run / "checkpoints")[-1]
    next(p for p in (run / "checkpoints" / str(last) / "replay").rglob("*") if p.is_file()).write_bytes(b"x")
    return [f"damaged: checkpoint {last:,} is damaged (replay/"]


def lose_all_checkpoints_files(run):
    for step in checkpoint.steps(run / "checkpoints"):
        (run / "checkpoints" / str(step) / "checksums.json").unlink()
    return ["(checksums.json is missing)", "no checkpoint can be read: take"]


def lose_rows(run):
    lines = (run / "metrics.csv").read_bytes().splitlines(keepends=True)
    (run / "metrics.csv").write_bytes(b"".join(lines[:3] + lines[5:]))
    return ["lacks rows between env steps"]


def lose_all_rows(run):
    shutil.rmtree(run / "checkpoints" / str(checkpoint.steps(run / "checkpoints")[-1]))  # there are rows to come
    (run / "metrics.csv").unlink()
    return ["lacks rows between env steps 0 and", "metrics: none yet"]


def change_a_digit(run):
    lines = (run / "metrics.csv").read_bytes().splitlines(keepends=True)
    at = max(k for k, byte in enumerate(lines[2]) if chr(byte).isdigit())
    other = b"7" if lines[2][at : at + 1] != b"7" else b"8"
    lines[2] = lines[2][:at] + other + lines[2][at + 1 :]
    (run / "metrics.csv").write_bytes(b"".join(lines))
    return ["metrics.csv: its rows up to env step", "are not those that the checkpoint knows"]


def tear_a_row(run):
    with (run / "metrics.csv").open("ab") as file:
        file.write(b"700,0,1")
    return ["1 damaged line, left out"]


def half_a_summary(run):
    (run / "summary.json").write_text('{"total_steps": 6')
    return ["summary.json is not whole", "summary: none"]


def no_machine(run):
    (run / "machine.json").write_text("")
    return ["machine.json is missing or not whole"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "damage",
    [
        damage_checkpoint,
        lose_all_checkpoints_files,
        lose_rows,
        lose_all_rows,
        change_a_digit,
        tear_a_row,
        half_a_summary,
        no_machine,
    ],  # fmt: skip
)
def test_damages_are_named_and_the_way_on_is_one(run, damage, capsys):
    unfinished(run)
    words = damage(run)
    code, said = checked(run, capsys)
    assert code == 1 and all(word in said for word in words), said
    if damage is not lose_all_checkpoints_files:
        assert command.start("train", way_on(said)) == 0
        assert RunDirectory(run).summary() is not None
        capsys.readouterr()
        code, said = checked(run, capsys)
        assert code == int(damage in (lose_rows, lose_all_rows, change_a_digit, no_machine))  # not to be made again


def test_what_is_no_damage(run, capsys):
    """A run that was killed: no summary, files half written, a checkpoint half written or set aside,
    and before its first checkpoint."""
    unfinished(run)
    (run / ".config.7.partial.yaml").write_text("")
    (run / ".run.7.partial").mkdir()  # of the agents' part of a hybrid run
    (run / "checkpoints" / ".900.partial").mkdir()
    first, *_ = checkpoint.steps(run / "checkpoints")
    (run / "checkpoints" / f"{first}").rename(run / "checkpoints" / f"{first}{checkpoint.ASIDE}")
    code, said = checked(run, capsys)
    left = ".config.7.partial.yaml, .run.7.partial, .900.partial"
    assert code == 0 and f"cut short, removed by the next resume: {left}" in said
    assert f"set aside, until the next checkpoint: {first}{checkpoint.ASIDE}" in said
    assert way_on(said) == [f"resume={run}"]
    shutil.rmtree(run / "checkpoints")
    code, said = checked(run, capsys)
    assert code == 0 and "checkpoints: none" in said and said.endswith("(from the start)\n")


def test_a_process_that_works_there_is_named(run, capsys):
    with lock.held(run):
        code, said = checked(run, capsys)
    assert code == 0 and f"lock: held: process {os.getpid()} on " in said and said.splitlines()[-1].startswith("wait ")


def test_where_there_is_no_run(run, tmp_path):
    (tmp_path / "empty").mkdir()
    (run / "config.yaml").write_text("[]")
    for path in (tmp_path / "empty", tmp_path / "nothing", run):
        with pytest.raises(UserError):
            check.main([f"run={path}"])
        with pytest.raises(UserError):
            check.main([f"sweep={path}"])
    for argv in ([], [f"run={run}", f"sweep={run}"]):
        with pytest.raises(UserError, match="say what to check"):
            check.main(argv)


@pytest.mark.slow
def test_a_sweep(tmp_path, capsys):
    settings = [*SMALL, "total_steps=400", "algo.lr=0.01,0.001", f"out={tmp_path}", "name=sweep"]
    assert sweep.main([*settings, "train=false"]) == 0
    folder = tmp_path / "sweep"
    capsys.readouterr()
    code, said = checked(folder, capsys, "sweep")
    assert code == 0 and "batch 0: 2 runs, not begun" in said
    assert f"resume with: {command.line('matd3_jax.sweep', resume=folder)}" in said
    assert sweep.main([f"resume={folder}"]) == 0
    capsys.readouterr()
    code, said = checked(folder, capsys, "sweep")
    assert code == 0 and "batch 0: 2 runs, finished" in said and "finished; make its table again with" in said
    tear_a_row(folder / "runs" / "lr_0.01")
    code, said = checked(folder, capsys, "sweep")
    assert code == 1 and "damaged: lr_0.01: " in said and "1 damaged line" in said
    shutil.rmtree(folder / "runs" / "lr_0.001")
    code, said = checked(folder, capsys, "sweep")
    assert code == 1 and "there is no run directory" in said and "batch 0: 2 runs, not begun" in said
    for name in ("sweep.json", "table.csv", "seeds.csv", "sweep.png"):
        (folder / name).unlink()
    shutil.rmtree(folder / "runs")
    shutil.rmtree(folder / "batches")
    code, said = checked(folder, capsys, "sweep")
    assert code == 1 and "its planning was cut short" in said
