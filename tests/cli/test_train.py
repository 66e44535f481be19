"""The commands: what a run leaves, resuming to the bit, signals, damage, bad input that writes nothing."""

import csv
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import event_records
import jax
import numpy as np
import pytest
from checkpoint_arrays import assert_resumes_to_the_bit, assert_same_run, leaves

from matd3_jax import config
from matd3_jax.cli import command, evaluate, train
from matd3_jax.errors import UserError
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.runtime import devices
from matd3_jax.training import announcement, checkpoint, cost
from matd3_jax.training.session import TrainingSession

pytestmark = pytest.mark.slow

# A schedule and networks so small that a run takes a second; every part of the real one is there, two teams included.
TINY = [
    "env=simple_push", "adversary=maddpg", "seeds=3", "algo.hidden=[8]", "adversary.hidden=[8]", "batch_size=16",
    "num_envs=2", "learning_starts=200", "replay_capacity=500", "total_steps=1500", "log_every=200",
    "eval_every=400", "eval_episodes=5",
]  # fmt: skip


def run(out: Path, *more: str) -> int:
    return train.main([*TINY, f"out={out}", *more])


def rows(path: Path) -> list[dict[str, str]]:
    with (path / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A run that was never stopped, with checkpoints on the way."""
    out = tmp_path_factory.mktemp("runs")
    assert run(out, "name=whole", "checkpoint_every=400", "keep_checkpoints=3") == 0
    return out / "whole"


@pytest.mark.parametrize(
    "env, wanted",
    [
        (["env=simple_tag", "adversary=maddpg"], "simple_tag-matd3-vs-maddpg"),
        (["env=jaxmarl", "env.id=MPE_simple_tag_v3"], "jaxmarl-MPE_simple_tag_v3-matd3"),
        (["env=pettingzoo", "env.id=mpe2.simple_tag_v3:env"], "pettingzoo-mpe2.simple_tag_v3_env-matd3"),
        (["env=gymnasium", "env.id='../CartPole-v1'"], "gymnasium-.._CartPole-v1-matd3"),
        (["env=playground", "env.id=CheetahRun"], "playground-CheetahRun-matd3"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_a_run_without_a_name_is_called_after_its_environment_algorithm_and_time(env, wanted, tmp_path, monkeypatch):
    """One part of a path, which tells the environments of another library apart."""
    asked = []

    def start(self, settings, path, or_another):
        asked.append(path)
        raise UserError("enough")

    monkeypatch.setattr(train.Recorder, "start", start)
    with pytest.raises(UserError, match="^enough$"):
        train.main([*env, f"out={tmp_path}"])
    assert asked[0].parent == tmp_path and re.fullmatch(re.escape(wanted) + r"-\d{8}-\d{6}", asked[0].name)


def test_a_run_leaves_all_its_files(whole):
    assert {p.name for p in whole.iterdir()} == {
        "config.yaml", "machine.json", "metrics.csv", "checkpoints", "learning_curve.png", "summary.json", ".lock",
    }  # fmt: skip
    machine = json.loads((whole / "machine.json").read_text())
    assert machine["versions"]["jax"] and machine["devices"]
    summary = json.loads((whole / "summary.json").read_text())
    assert summary["training_env_steps_per_second"] > summary["env_steps_per_second"] > 0
    assert 0 < summary["evaluation_share"] < 1 and summary["updates_per_second"] > 0
    assert (whole / "learning_curve.png").read_bytes()[:4] == b"\x89PNG"
    assert len(checkpoint.steps(whole / "checkpoints")) == 3


def test_the_metrics_table_is_tidy(whole):
    """One row for each seed and interval, steps ascending, everything counted."""
    assert list(rows(whole)[0]) == TrainingSession(config.read(whole / "config.yaml")).columns
    table = rows(whole)
    steps = sorted({int(row["step"]) for row in table})
    assert [(int(row["step"]), int(row["seed"])) for row in table] == [(s, seed) for s in steps for seed in range(3)]
    assert steps[0] == 150 and steps[-1] >= 1500  # warm-up: one rollout of 50 before 200 transitions are reached
    for row in table:
        # 25-step episodes in two environments: as many have ended as steps were played.
        assert int(row["updates"]) == max(0, int(row["step"]) - 150) // 50
        assert float(row["episode_length"]) == 25
        assert float(row["return_agents"]) == pytest.approx(float(row["agent_0_return"]))
        assert float(row["return_adversaries"]) == pytest.approx(float(row["adversary_0_return"]))
    assert sum(int(row["episodes"]) for row in table if row["seed"] == "1") == steps[-1] // 25
    evaluated = sorted({int(row["step"]) for row in table if row["eval_return_agents"] != "nan"})
    assert evaluated == [150, 550, 950, 1350, 1550]  # intervals of 200 from 150 on: 400, 800, 1200, and the end
    late = [row for row in table if int(row["step"]) > 150]
    assert all(np.isfinite(float(row["agent_0_critic_loss"])) for row in late)


def test_evaluations_are_reported(whole, tmp_path, capsys):
    """The last evaluation, of the table's last rows, on the progress line, in the lines at the end and in the summary;
    without evaluations no word of them."""
    last = {name: np.array([float(row[name]) for row in rows(whole)[-3:]]) for name in rows(whole)[-1]}
    summary = json.loads((whole / "summary.json").read_text())["last_evaluation"]
    names = ("return_agents", "return_adversaries", "episode_length")
    assert set(summary) == {*names, "adversary_0_return", "agent_0_return"}
    for name in names:
        # Student's t of 2 degrees of freedom, from a table: 4.303.
        want = last[f"eval_{name}"].mean(), 4.303 * last[f"eval_{name}"].std(ddof=1) / np.sqrt(3)
        np.testing.assert_allclose(summary[name], want, rtol=1e-4)
    assert run(tmp_path, "name=again") == 0
    printed = capsys.readouterr().out
    mean, spread = last["eval_return_agents"].mean(), last["eval_return_agents"].std(ddof=1)
    assert f"(evaluation {mean:.1f} ± {spread:.1f})" in printed
    assert f"\n  return_agents: {mean:.4g} ± " in printed and "\n  episode_length: 25 ± 0 " in printed
    assert run(tmp_path, "name=never", "eval_every=0", "seeds=1", "total_steps=400") == 0
    printed = capsys.readouterr().out
    assert "(evaluation" not in printed and "last evaluation" not in printed
    assert "last_evaluation" not in json.loads((tmp_path / "never" / "summary.json").read_text())


def test_the_announcement(tmp_path, monkeypatch):
    """What a run says before it starts: how long it will take, and for robots alone recipe and engine."""
    monkeypatch.setattr(cost, "product_rate", lambda *_: 1e6)
    monkeypatch.setattr(cost, "physics_rate", lambda *_: None)

    def announced(*settings, done=0, recipe=None):
        training = TrainingSession(config.load([*settings, "seeds=2", "learning_starts=200"]))
        object.__setattr__(training.config, "recipe", recipe)
        return announcement.first_lines(training, RunDirectory(tmp_path / "run"), done)

    lines = announced("env=ant", "env.physics=c", "algo=td3", recipe="fast")
    assert lines[2:4] == ["recipe: fast; for the paper's settings: recipe=paper", "physics: c (C MuJoCo)"]
    assert lines[-1].startswith("expected: about ") and "hours, compiling apart (products at 0.001 GFLOP/s" in lines[-1]
    assert announced("env=ant", "env.physics=mjx", recipe="paper")[2:4] == [
        "recipe: paper",
        "physics: mjx (MuJoCo in JAX)",
    ]
    assert announced("env=brax_ant", recipe="fast")[2].startswith("recipe: fast")
    plain = announced("env=simple_spread", recipe="paper")
    assert not any(line.startswith(("recipe", "physics")) for line in plain) and plain[-1].startswith("expected: ")
    whole, rest = (float(re.search(r"about ([\d,]+) hours", announced("env=simple", done=done)[-1])[1].replace(",", ""))
                   for done in (0, 1000000))  # fmt: skip
    assert rest == pytest.approx(whole / 3, rel=0.1)


def test_stopped_and_resumed_is_the_same_to_the_bit(whole, tmp_path, monkeypatch, capsys):
    """SIGTERM comes in the middle; the resumed run ends in the same table and the same checkpoint, bit for bit."""
    append = RunDirectory.append

    def append_and_signal(self, row):
        append(self, row)
        if int(row["step"][0]) == 750:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(RunDirectory, "append", append_and_signal)
    assert run(tmp_path, "name=cut") == 128 + signal.SIGTERM
    monkeypatch.undo()
    cut = tmp_path / "cut"
    assert (
        f"stopped by SIGTERM at env step 750; resume with: python -m matd3_jax.train resume={cut}"
        in capsys.readouterr().out
    )
    assert checkpoint.steps(cut / "checkpoints")[-1] == 750
    # A row that was written after the checkpoint, as by a run that died, is written again and not twice.
    with (cut / "metrics.csv").open("a") as file:
        file.write(",".join(["950"] + ["0"] * (len(rows(cut)[0]) - 1)) + "\n")
    assert train.main([f"resume={cut}"]) == 0
    assert_same_run(cut, whole)
    ours = leaves(cut)
    assert any("optimizer" in name for name in ours)
    assert np.abs(ours["replay 2"]).max(axis=1).min() > 0 and len(ours["replay 2"]) == 500


def test_several_steps_and_normalized_observations_resume_to_the_bit(tmp_path):
    """With what these carry: ends of episodes in the replay, statistics in the state. `evaluate` plays with the saved
    statistics: its numbers are those of the run's own last evaluation."""
    settings = [
        "env=point_reach", "algo=iddpg", "seeds=2", "algo.hidden=[8]", "batch_size=16", "learning_starts=100",
        "total_steps=900", "log_every=100", "replay_capacity=500", "checkpoint_every=300", "keep_checkpoints=9",
        "n_step=3", "normalize_observations=true",
    ]  # fmt: skip
    assert train.main([*settings, f"out={tmp_path}", "name=full"]) == 0
    full = tmp_path / "full"
    assert sum("statistics" in name for name in leaves(full)) == 2
    assert_resumes_to_the_bit(full, tmp_path / "cut")
    assert evaluate.main([f"run={full}", "episodes=10"]) == 0
    with (full / "evaluation.csv").open(newline="") as file:
        found = {(r["policy"], r["quantity"], r["seed"]): float(r["mean"]) for r in csv.DictReader(file)}
    for row in rows(full)[-2:]:
        got = found["deterministic", "return_agents", row["seed"]]
        assert got == pytest.approx(float(row["eval_return_agents"]), rel=1e-6)  # nine digits in the table


def test_a_finished_run_can_be_lengthened(tmp_path):
    """Beyond the first end: the replay rows not allocated before are there, and the settings say so."""
    small = ["env=point_reach", "algo=iddpg", "seeds=1", "algo.hidden=[8]", "batch_size=16", "learning_starts=100"]
    assert train.main([*small, f"out={tmp_path}", "name=longer", "total_steps=400", "log_every=100"]) == 0
    longer = tmp_path / "longer"
    end = int(rows(longer)[-1]["step"])
    before = leaves(longer)["replay 0"]
    assert train.main([f"resume={longer}", "total_steps=900"]) == 0
    assert int(rows(longer)[-1]["step"]) >= 900 > end == len(before)
    after = leaves(longer)["replay 0"]
    assert len(after) == int(rows(longer)[-1]["step"]) and np.abs(after).max(axis=1).min() > 0
    np.testing.assert_array_equal(after[:end], before)


def test_damage_is_named_and_the_checkpoint_before_it_used_on_request(whole, tmp_path, capsys):
    run(tmp_path, "name=damaged", "checkpoint_every=400", "keep_checkpoints=3")
    damaged = tmp_path / "damaged"
    found = checkpoint.steps(damaged / "checkpoints")
    victim = max((damaged / "checkpoints" / str(found[-1]) / "replay").rglob("*"), key=lambda p: p.stat().st_size)
    data = bytearray(victim.read_bytes())
    data[len(data) // 2] ^= 1
    victim.write_bytes(data)
    before = {p: p.stat().st_mtime_ns for p in damaged.rglob("*") if p.name != ".lock"}
    with pytest.raises(UserError) as error:
        train.main([f"resume={damaged}", "total_steps=2000"])
    assert victim.name in str(error.value) and f"checkpoint={found[-2]}" in str(error.value)
    assert before == {p: p.stat().st_mtime_ns for p in damaged.rglob("*") if p.name != ".lock"}
    assert train.main([f"resume={damaged}", f"checkpoint={found[-2]}"]) == 0
    assert_same_run(damaged, whole)


def test_checkpoints_from_before_a_leaf_was_renamed_are_read(whole, monkeypatch):
    """They hold the count of rollouts and the optimizers under other names."""
    read, settings = checkpoint.read_state, config.read(whole / "config.yaml")
    trainer, path = TrainingSession(settings).trainer, checkpoint.verify(whole / "checkpoints")
    state = checkpoint.restore_actors(path, trainer)

    def before(*args):
        found = read(*args)
        old = {name.replace(".rollouts", ".collects").replace("optimizer", "optimiser"): name for name in found}
        assert sum(name not in found for name in old) > 2
        return {name: found[now] for name, now in old.items()}

    monkeypatch.setattr(checkpoint, "read_state", before)
    again = checkpoint.restore_actors(path, trainer)
    assert int(again.rollouts) == int(state.rollouts) > 0
    jax.tree.map(np.testing.assert_array_equal, again.groups, state.groups)


def test_a_missing_checksum_file_is_damage(whole, tmp_path):
    copy = tmp_path / "checkpoints" / "400"
    copy.mkdir(parents=True)
    with pytest.raises(UserError, match="checksums.json"):
        checkpoint.verify(tmp_path / "checkpoints")


def test_tensorboard_files_hold_the_table(whole, tmp_path):
    assert run(tmp_path, "name=tb", "logger=[csv,tensorboard]") == 0
    (path,) = (tmp_path / "tb" / "tensorboard").glob("events*")
    written = event_records.scalars(path)
    wanted = [
        (int(row["step"]), f"{name}/seed_{row['seed']}", np.float32(value))
        for row in rows(tmp_path / "tb")
        for name, value in row.items()
        if name not in ("step", "seed") and value != "nan"  # the losses before the first update, say
    ]
    assert len(wanted) > 100 and sorted(one[:2] for one in written) == sorted(one[:2] for one in wanted)
    values = dict((one[:2], one[2]) for one in written)
    for step, tag, value in wanted:
        np.testing.assert_allclose(values[step, tag], value, rtol=1e-6)  # the table has nine digits


def test_evaluate_prints_and_leaves_a_table(whole, capsys):
    assert evaluate.main([f"run={whole}", "episodes=20"]) == 0
    printed = capsys.readouterr().out
    with (whole / "evaluation.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    names = ["return_adversaries", "return_agents", "adversary_0_return", "agent_0_return", "episode_length"]
    assert [(r["policy"], r["quantity"], r["seed"]) for r in table] == [
        (policy, name, str(seed)) for policy in ("deterministic", "sampled") for name in names for seed in range(3)
    ]
    assert all(word in printed for word in ("deterministic", "sampled", "return_adversaries", "seed 2"))
    values = {(r["policy"], r["quantity"], r["seed"]): float(r["mean"]) for r in table}
    assert values["deterministic", "agent_0_return", "0"] != values["sampled", "agent_0_return", "0"]
    assert values["sampled", "agent_0_return", "1"] == values["sampled", "return_agents", "1"]
    assert values["sampled", "episode_length", "2"] == 25
    # The same start states and policies again: the same numbers.
    before = (whole / "evaluation.csv").read_bytes()
    evaluate.main([f"run={whole}", "episodes=20"])
    assert (whole / "evaluation.csv").read_bytes() == before


def test_a_table_that_cannot_be_written_is_one_line(whole, tmp_path, capsys):
    """On a file system that takes nothing; here a folder has the file's name."""
    copy = shutil.copytree(whole, tmp_path / "copy", ignore=shutil.ignore_patterns("evaluation.csv"))
    (copy / "evaluation.csv").mkdir()
    assert command.code(evaluate.main, [f"run={copy}", "episodes=20"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and str(copy / "evaluation.csv") in said and said.count("\n") == 1


def test_evaluate_plays_the_online_actors_and_the_averaged_ones(tmp_path):
    """Averaging changes no training: the online actors are those of the same run without it."""
    small = ["env=point_reach", "seeds=2", "algo.hidden=[8]", "batch_size=16", "learning_starts=100"]
    found = {}
    for name, average in (("averaged", 0.05), ("plain", 0.0)):
        more = ["total_steps=400", "log_every=100", f"algo.actor_average={average}", f"out={tmp_path}", f"name={name}"]
        assert train.main([*small, *more]) == 0
        assert evaluate.main([f"run={tmp_path / name}", "episodes=5"]) == 0
        with (tmp_path / name / "evaluation.csv").open(newline="") as file:
            table = list(csv.DictReader(file))
        for kind in dict.fromkeys(row["policy"] for row in table):
            found[name, kind] = [float(row["mean"]) for row in table if row["policy"] == kind]
    assert [kind for name, kind in found if name == "averaged"] == ["deterministic", "online", "sampled"]
    assert [kind for name, kind in found if name == "plain"] == ["deterministic", "sampled"]
    np.testing.assert_array_equal(found["averaged", "online"], found["plain", "deterministic"])
    np.testing.assert_array_equal(found["averaged", "sampled"], found["plain", "sampled"])
    assert found["averaged", "deterministic"] != found["plain", "deterministic"]


BAD = {
    "run directory that exists": (["name=whole"], "is there already"),
    "unknown key": (["sedes=3"], "seeds"),
    "no such run": (["resume=nowhere"], "no run directory nowhere"),
    "not a run": (["resume={whole}/checkpoints"], "no config.yaml"),
    "changed settings": (["resume={whole}", "algo.lr=1"], "algo.lr=1"),
    "finished": (["resume={whole}"], "total_steps"),
    "no such checkpoint": (["resume={whole}", "checkpoint=7", "total_steps=9000"], "no checkpoint of step 7"),
    "checkpoint of what": (["checkpoint=700"], "resume="),
    "checkpoint=last": (["resume={whole}", "checkpoint=last"], "checkpoint=last"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_to_train_writes_nothing(case, whole, monkeypatch):
    arguments, wanted = BAD[case]
    before = {p: p.stat().st_mtime_ns for p in whole.parent.rglob("*") if p.name != ".lock"}
    tiny = [] if any(a.startswith("resume") for a in arguments) else [*TINY, f"out={whole.parent}"]
    with pytest.raises(UserError, match=wanted.replace("(", r"\(")):
        train.main([*tiny, *(a.format(whole=whole) for a in arguments)])
    assert before == {p: p.stat().st_mtime_ns for p in whole.parent.rglob("*") if p.name != ".lock"}


CANNOT = {
    "a missing package": (["logger=[csv,tensorboard]"], "needs the package tensorboardX"),
    "memory": (["replay_capacity=100000000", "total_steps=100000000"], "GB are free"),
    "a file in the way": (["out={out}/file"], "cannot make this directory"),
    "a name too long": (["name=" + 300 * "a"], "at most 255 bytes"),
    "a backslash": ([r"name=a\b"], "a path has a backslash"),
    "an environment that does not take its options": (["env.episode_length=0"], "episode_length"),
}


@pytest.mark.parametrize("case", CANNOT)
def test_a_run_that_cannot_be_trained_leaves_no_directory(case, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    monkeypatch.setattr(devices, "free_memory", lambda sharing=1: 10_000_000)
    (tmp_path / "file").touch()
    arguments, wanted = CANNOT[case]
    with pytest.raises(ValueError, match=wanted):
        run(tmp_path / "new" / "runs", *(text.format(out=tmp_path) for text in arguments))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_runs_may_be_called_anything_and_printed_lines_can_be_pasted(tmp_path, capsys):
    """Train, evaluate by the printed line, and resume by the line of an error message."""
    name = "it's [1e3, a=b] ü"
    assert run(tmp_path, f"name={name}") == 0
    assert (tmp_path / name / "summary.json").exists()
    line = next(text for text in capsys.readouterr().out.splitlines() if text.startswith("evaluate with: "))
    words = shlex.split(line.removeprefix("evaluate with: "))
    assert words[:3] == ["python", "-m", "matd3_jax.evaluate"]
    assert evaluate.main([*words[3:], "episodes=2"]) == 0
    with pytest.raises(UserError) as error:
        run(tmp_path, f"name={name}")
    argument = shlex.split(str(error.value).split("resume it with ")[1])
    assert argument == [f"resume={tmp_path / name}"]
    with pytest.raises(UserError, match="raise total_steps="):
        train.main(argument)


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        ([], "run=RUN_DIR"),
        (["run=nowhere"], "no run directory nowhere"),
        (["run={whole}", "episods=3"], "episodes"),
        (["run={whole}", "episodes=0"], "episodes=0"),
        (["run={whole}", "checkpoint=7"], "no checkpoint of step 7"),
    ],
)
def test_bad_input_to_evaluate(arguments, wanted, whole):
    with pytest.raises(UserError, match=wanted):
        evaluate.main([a.format(whole=whole) for a in arguments])


def test_mistakes_end_with_one_line_and_exit_code_2(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(sys, "argv", ["train", "env=simple_sprad", f"out={tmp_path}"])
    with pytest.raises(SystemExit) as end:
        command.run(train.main)
    printed = capsys.readouterr()
    assert end.value.code == 2 and printed.out == ""
    assert printed.err.startswith("error: ") and printed.err.count("\n") == 1 and "simple_spread" in printed.err
    assert not list(tmp_path.iterdir())


def test_a_real_process_stops_at_sigint_with_a_checkpoint(tmp_path):
    """As a user would: the module by name, control-C while it runs, then the printed line."""
    words = [sys.executable, "-m", "matd3_jax.train", *TINY, "name=live", f"out={tmp_path}", "total_steps=100000000"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    metrics = tmp_path / "live" / "metrics.csv"
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and not (metrics.exists() and metrics.read_text().count("\n") > 3):
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert "Traceback" not in err
    assert "stopped by SIGINT at env step" in out and f"resume={tmp_path / 'live'}" in out
    assert checkpoint.verify(tmp_path / "live" / "checkpoints").is_dir()


def test_help_and_cfg_write_nothing(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert command.start("train", ["--help"]) == 0
    assert "learning_starts: 25600" in capsys.readouterr().out
    assert train.main(["--cfg", "algo.lr=0.5"]) == 0
    assert "actor_lr: 0.5" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())
