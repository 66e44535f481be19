"""The policies of each seed's best evaluation: which they are, that they survive kills, and who plays them."""

import csv
import json
import shutil

import numpy as np
import pytest
from checkpoint_arrays import assert_same_run, back_to

from matd3_jax import config
from matd3_jax.cli import check, command, evaluate, render, sweep
from matd3_jax.errors import UserError
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.training import best, checkpoint, saved_policies
from matd3_jax.training.recording import Recorder
from matd3_jax.training.session import TrainingSession

SMALL = [
    "env=point_reach", "algo=iddpg", "seeds=3", "learning_starts=400", "num_envs=4", "rollout_length=5",
    "batch_size=32", "replay_capacity=800", "algo.hidden=[8]", "log_every=200", "eval_every=200", "eval_episodes=4",
    "normalize_observations=true",
]  # fmt: skip
RUN = [*SMALL, "total_steps=1600", "algo.actor_average=0.2", "checkpoint_every=100", "keep_checkpoints=9"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run with a checkpoint after each of its evaluations."""
    path = tmp_path_factory.mktemp("runs") / "whole"
    Recorder().start(config.load(RUN), path)
    return path


@pytest.fixture
def copy(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "run")


def kept(path):
    """What the last checkpoint keeps of each seed."""
    last = checkpoint.verify(path / "checkpoints")
    return [best.read(last, k) for k in range(3)]


def columns(path):
    with (path / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


@pytest.mark.slow
def test_it_is_the_best_of_all_evaluations_and_its_networks_are_those_of_then(whole):
    table = columns(whole)
    steps = checkpoint.steps(whole / "checkpoints")
    found = kept(whole)
    assert len({one.step for one in found}) > 1, "all seeds are best at the same step: the test shows little"
    for seed, one in enumerate(found):
        own = table["seed"] == seed
        values = table["eval_return_agents"][own]
        assert one.step == table["step"][own][values.argmax()] and one.step in steps
        assert one.mean_return == pytest.approx(values.max(), rel=1e-7) and one.episodes == 4
        state = checkpoint.read_state(whole / "checkpoints" / str(one.step), 0, 3, 3)
        assert {name.split("[")[0] for name in one.policies} == {".groups", ".statistics.mean", ".statistics.variance"}
        assert any("actor_average" in name for name in one.policies)
        assert not any("critic" in name or "target" in name for name in one.policies)
        for name, value in one.policies.items():
            np.testing.assert_array_equal(value, state[name][seed], err_msg=name)


def test_the_standard_error_is_that_of_the_episodes(whole):
    """Of the same episodes, played again with the checkpoint of that env step."""
    training = TrainingSession(config.read(whole / "config.yaml"))
    one = kept(whole)[0]
    state = checkpoint.restore_actors(whole / "checkpoints" / str(one.step), training.trainer)
    returns = training.evaluate(state, 4, deterministic=True).episode_return[0].mean(axis=-1)
    assert one.mean_return == pytest.approx(returns.mean(), rel=1e-5)
    assert one.standard_error == pytest.approx(np.sqrt(returns.var(ddof=1) / 4), rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("place", [0, 2])
def test_a_killed_run_comes_to_the_same_files(copy, whole, place):
    step = checkpoint.steps(whole / "checkpoints")[place]
    back_to(copy, step)
    assert kept(copy)[0].step <= step
    Recorder().resume(copy)
    assert_same_run(copy, whole)
    for one, other in zip(kept(copy), kept(whole), strict=True):
        assert one.facts == other.facts
        for name, value in other.policies.items():
            np.testing.assert_array_equal(one.policies[name], value, err_msg=name)
    summary = json.loads((copy / "summary.json").read_text())
    assert summary["best_evaluation"]["2"] == kept(whole)[2].facts


def test_evaluate_plays_them(whole, capsys):
    """With the episodes of the run's own evaluations: the mean that was kept."""
    assert evaluate.main([f"run={whole}", "checkpoint=best", "episodes=4"]) == 0
    with (whole / "evaluation.csv").open(newline="") as file:
        rows = [r for r in csv.DictReader(file) if r["quantity"] == "return_agents" and r["policy"] == "deterministic"]
    for row, one in zip(rows, kept(whole), strict=True):
        assert float(row["mean"]) == pytest.approx(one.mean_return, rel=1e-5)
        assert float(row["std"]) == pytest.approx(2 * one.standard_error, rel=1e-4)
    assert "best evaluations" in " ".join(capsys.readouterr().out.split())


def test_render_plays_them(whole, tmp_path, capsys):
    assert render.main([f"run={whole}", "checkpoint=best", f"out={tmp_path / 'a.gif'}", "size=100", "seed=1"]) == 0
    said = capsys.readouterr().out
    training = TrainingSession(config.read(whole / "config.yaml"))
    saved = saved_policies.load(RunDirectory(whole), training, "best")
    first = training.evaluate(saved.state, 1, deterministic=True).episode_return[1].mean()
    assert f"return {first:.1f}" in said


def test_check_tells_of_them_and_of_damage(copy, capsys):
    one = kept(copy)[1]
    assert check.main([f"run={copy}"]) == 0
    assert f"seed 1 {one}" in capsys.readouterr().out
    path = checkpoint.verify(copy / "checkpoints") / "best" / "1.npz"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    assert check.main([f"run={copy}"]) == 1
    assert "is damaged (best/1.npz)" in capsys.readouterr().out


def test_a_seed_that_diverged_later_plays_what_it_was(copy):
    """Its networks of then are finite; only by the last checkpoint they are not."""
    training = TrainingSession(config.read(copy / "config.yaml"))
    step = checkpoint.steps(copy / "checkpoints")[-1]
    state = checkpoint.restore(checkpoint.verify(copy / "checkpoints"), training.trainer)
    training.best.restore(copy / "checkpoints" / str(step), training.share)
    actor = {name: np.array(leaf) for name, leaf in state.groups[0].actor.items()}
    actor["bias_0"][1] = np.nan
    broken = state._replace(groups=(state.groups[0]._replace(actor=actor, actor_average=actor), *state.groups[1:]))
    checkpoint.save(copy / "checkpoints", step, training.trainer, broken, 9, best=training.best)
    run = RunDirectory(copy)
    assert list(saved_policies.load(run, training, None).diverged) == [1]
    assert not saved_policies.load(run, training, "best").diverged


def test_runs_without_them_say_so(copy):
    last = checkpoint.verify(copy / "checkpoints")
    shutil.rmtree(last / "best")
    sums = json.loads((last / "checksums.json").read_text())
    (last / "checksums.json").write_text(json.dumps({k: v for k, v in sums.items() if not k.startswith("best/")}))
    with pytest.raises(UserError, match="keeps no policies of best evaluations"):
        evaluate.main([f"run={copy}", "checkpoint=best"])
    assert check.main([f"run={copy}"]) == 0


@pytest.mark.slow
def test_runs_of_a_sweep_have_their_own(tmp_path):
    """As if each had been trained alone."""
    argv = [*SMALL, "total_steps=800", "algo.lr=0.05,0.01", "seeds=2", f"out={tmp_path}", "name=two"]
    assert sweep.main([text for text in argv if text != "seeds=3"]) == 0
    for path in sorted((tmp_path / "two" / "runs").iterdir()):
        table = columns(path)
        last = checkpoint.verify(path / "checkpoints")
        assert sorted(p.name for p in (last / "best").iterdir()) == ["0.npz", "1.npz"]
        for seed in range(2):
            own = table["seed"] == seed
            found = best.read(last, seed)
            assert found.mean_return == pytest.approx(table["eval_return_agents"][own].max(), rel=1e-7)
        assert json.loads((path / "summary.json").read_text())["best_evaluation"]["1"]["step"] == found.step


@pytest.mark.parametrize("name", ["evaluate", "render", "crossplay"])
@pytest.mark.parametrize("text", ["", "Best", "-1", "1.5", "nan", "[1]", "1,2", "9" * 5000])
def test_other_checkpoints_are_refused(name, text, capsys):
    run = "runs=nowhere" if name == "crossplay" else "run=nowhere"
    assert command.code(lambda argv: command.start(name, argv), [run, f"checkpoint={text}"]) == 2
    assert capsys.readouterr().err.startswith("error: checkpoint=")
