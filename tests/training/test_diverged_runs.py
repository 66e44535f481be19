"""Runs one of whose seeds diverges: what is said, left out and left behind; the other seeds know nothing of it."""

import csv
import json
import shutil
import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import matd3_jax
from matd3_jax import config
from matd3_jax.cli import evaluate, render, train
from matd3_jax.envs.point_reach import PointReach
from matd3_jax.errors import UserError
from matd3_jax.stats.intervals import mean_interval
from matd3_jax.training import checkpoint
from matd3_jax.training.loggers import DivergenceLogger
from matd3_jax.training.recording import Recorder
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.sharding import SeedSharding
from matd3_jax.training.state import networks_finite

pytestmark = pytest.mark.slow

SMALL = [
    "env=point_reach", "algo=iddpg", "seeds=3", "seed=4", "total_steps=1200", "learning_starts=400", "num_envs=4",
    "rollout_length=5", "batch_size=32", "replay_capacity=800", "algo.hidden=[8]", "log_every=200", "eval_every=400",
    "eval_episodes=2",
]  # fmt: skip
LOST, SOUND = 5, (4, 6)


@pytest.fixture
def blown(monkeypatch):
    """Seed 5 alone learns with an enormous rate, the member of this list."""
    hyper, rates = TrainingSession._hyper, [1e30]

    def one(self, team):
        found = hyper(self, team)
        rate = np.where(self.seeds == LOST, rates[0], found.critic_lr).astype(np.float32)
        return found._replace(critic_lr=rate, actor_lr=np.where(self.seeds == LOST, rate, found.actor_lr))

    monkeypatch.setattr(TrainingSession, "_hyper", one)
    return rates


def table(path):
    with (path / "metrics.csv").open(newline="") as file:
        return [row for row in csv.DictReader(file) if int(row["seed"]) != LOST]


def test_a_seed_that_diverges_is_reported_and_left_out(blown, tmp_path, monkeypatch, capsys):
    said, path = [], tmp_path / "run"
    recorded = Recorder(say=said.append).start(config.load(SMALL), path)
    (begin,) = {found.step for found in recorded.outcome.diverged.values()}
    assert recorded.outcome.finished and list(recorded.outcome.diverged) == [1]
    reported = [line for line in said if line.startswith(f"seed {LOST} diverged at env step {begin:,}: ")]
    assert len(reported) == 2  # when it happens, and at the end
    assert reported[1].endswith("; all means are over the other 2 seeds")
    assert f"| 2 of 3 seeds, seed {LOST} diverged at {begin:,}" in capsys.readouterr().out
    assert any("(95 % interval over 2 of 3 seeds)" in line for line in said)
    # The means are those of the others' rows.
    summary = json.loads((path / "summary.json").read_text(), parse_constant=pytest.fail)
    assert summary["diverged"] == {str(LOST): begin}
    rows = table(path)
    last = [float(row["eval_return_agents"]) for row in rows[-2:]]
    np.testing.assert_allclose(summary["last_evaluation"]["return_agents"], mean_interval(np.array(last)), rtol=1e-6)
    # Finished once more from what it left: the same.
    (path / "summary.json").unlink()
    Recorder().resume(path)
    again = json.loads((path / "summary.json").read_text())
    assert all(summary[key] == value for key, value in again.items())

    # The commands after it.
    assert evaluate.main([f"run={path}", "episodes=2"]) == 0
    shown = capsys.readouterr().out
    assert f"seed {LOST} (diverged)" in shown and "seed 4 (diverged)" not in shown and "2 of 3 seeds" in shown
    with (path / "evaluation.csv").open(newline="") as file:
        assert {(int(row["seed"]), row["diverged"]) for row in csv.DictReader(file)} == {(4, "0"), (5, "1"), (6, "0")}
    with pytest.raises(UserError, match=f"seed={LOST} of .* diverged: .*; they are with seed=4, 6"):
        render.main([f"run={path}", f"seed={LOST}"])

    # What the others learn is what they learn next to a sound seed.
    monkeypatch.undo()
    Recorder().start(config.load(SMALL), tmp_path / "sound")
    assert table(path) == table(tmp_path / "sound")


def test_a_loss_that_is_nan_in_some_updates_of_an_iteration_is_noticed_in_its_interval(monkeypatch):
    """A row's losses are means without nan; the networks say so at once."""
    hyper = TrainingSession._hyper
    monkeypatch.setattr(
        TrainingSession, "_hyper", lambda *args: hyper(*args)._replace(critic_lr=np.full(3, np.nan, np.float32))
    )
    training = TrainingSession(config.load([*SMALL, "updates_per_collect=2", "log_every=20", "eval_every=0"]))
    state, row = training.start()
    assert training.iterations_per_interval == 1  # the first loss is sound, the second is not
    said = []
    watch = DivergenceLogger(training, said.append)
    watch.log(row)
    assert not watch.diverged
    state, row = training.advance(state)
    assert np.isfinite(row["agent_0_critic_loss"]).all()
    watch.log(row)
    assert len(said) == len(watch.diverged) == 3
    assert {found.step for found in watch.diverged.values()} == {int(row["step"][0])}


def test_stop_ends_the_run_with_a_checkpoint(blown, tmp_path, capsys):
    assert train.main([*SMALL, f"out={tmp_path}", "name=run", "on_divergence=stop"]) == 3
    out = capsys.readouterr().out
    step = checkpoint.steps(tmp_path / "run" / "checkpoints")[-1]
    assert step < 1200 and f"stopped at env step {step:,} since a seed diverged; resume with:" in out
    assert not (tmp_path / "run" / "summary.json").exists() and (tmp_path / "run" / "learning_curve.png").exists()
    # Resumed, it continues: no other seed diverges.
    assert train.main([f"resume={tmp_path / 'run'}"]) == 0
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["diverged"] == {str(LOST): step}


def leaves(state, seed):
    return [np.asarray(leaf)[seed] for leaf in jax.tree.leaves(state.groups)]


@pytest.mark.parametrize("together", [1, pytest.param(3, marks=pytest.mark.slow)])  # in turns, and side by side
def test_stop_seed_keeps_the_networks_from_before_the_updates(blown, together, monkeypatch):
    monkeypatch.setattr(SeedSharding, "apart", lambda self, seed_bytes: together == 1)
    sharding = SeedSharding.__init__
    alone = {"devices": jax.devices()[:1], "seeds_together": together, "devices_per_seed": 1}
    monkeypatch.setattr(
        SeedSharding, "__init__", lambda self, seeds, batch, *rest: sharding(self, seeds, batch, **alone)
    )
    blown[0], runs = 1e9, {}  # small enough for the first updates
    for mode in ("continue", "stop_seed"):
        training = TrainingSession(config.load([*SMALL, "log_every=20", "eval_every=0", f"on_divergence={mode}"]))
        assert training.iterations_per_interval == 1
        state, row = training.start()
        rows, networks = [row], [[leaves(state, seed) for seed in range(3)]]
        for _ in range(8):
            state, row = training.advance(state)
            rows.append(row)
            networks.append([leaves(state, seed) for seed in range(3)])
        runs[mode] = rows, networks
    (rows, networks), (stopped_rows, stopped) = runs["continue"], runs["stop_seed"]
    lost = [
        not all(np.isfinite(leaf).all() for leaf in after[1]) or not np.isfinite(row["agent_0_critic_loss"][1])
        for after, row in zip(networks[1:], rows[1:], strict=True)
    ]
    first = lost.index(True)  # of the intervals; networks[first] is what there was before it
    assert 0 < first < 6 and all(lost[first:])
    # Side by side the choice between the networks is fused with the updates, which rounds otherwise.
    tolerance = 0 if together == 1 else 1e-4
    same = partial(np.testing.assert_allclose, rtol=tolerance, atol=tolerance * 1e-4)
    for number, (row, other) in enumerate(zip(stopped_rows, rows, strict=True)):
        for seed in (0, 2):
            jax.tree.map(same, stopped[number][seed], networks[number][seed])
            for name, values in row.items():
                same(values[seed], other[name][seed], err_msg=name)
        jax.tree.map(same, stopped[number][1], networks[min(number, first)][1])
        jax.tree.map(np.testing.assert_array_equal, stopped[number][1], stopped[min(number, first)][1])
        nothing = [np.isnan(row[f"agent_0_{name}"][1]) for name in ("critic_loss", "q_value", "actor_loss")]
        assert all(nothing) if number > first or number == 0 else not any(nothing[:2])


def test_a_seed_that_has_stopped_is_reported_once_and_survives_a_resume(blown, tmp_path, capsys):
    given = [*SMALL, f"out={tmp_path}", "name=run", "on_divergence=stop_seed", "checkpoint_every=400"]
    assert train.main([*given, "keep_checkpoints=9"]) == 0
    assert capsys.readouterr().out.count("seed 5 diverged at env step") == 2  # when it happened, and at the end
    path = tmp_path / "run"
    found = json.loads((path / "summary.json").read_text())["diverged"]
    assert list(found) == [str(LOST)]
    whole, state = (path / "metrics.csv").read_bytes(), last_networks(path)
    assert all(np.isfinite(leaf).all() for leaf in state.values())
    assert evaluate.main([f"run={path}", "episodes=2"]) == 0
    assert f"seed {LOST} (diverged)" in capsys.readouterr().out

    (path / "summary.json").unlink()
    step = checkpoint.steps(path / "checkpoints")[1]
    assert found[str(LOST)] <= step < 1200
    assert train.main([f"resume={path}", f"checkpoint={step}"]) == 0
    assert (path / "metrics.csv").read_bytes() == whole
    jax.tree.map(np.testing.assert_array_equal, last_networks(path), state)


def last_networks(path):
    last = path / "checkpoints" / str(checkpoint.steps(path / "checkpoints")[-1])
    return {name: leaf for name, leaf in checkpoint.read_state(last, 0, 3, 3).items() if name.startswith(".groups")}


@pytest.mark.parametrize("wrong", ["reward", "seeds"])
def test_where_all_seeds_have_stopped_the_run_ends(wrong, tmp_path, monkeypatch):
    """A reward that is not a number stops a seed before the updates that would learn from it."""
    if wrong == "reward":
        step = PointReach.step

        def bad(self, key, state, action):
            found = step(self, key, state, action)
            return found._replace(reward=found.reward * jnp.nan)

        monkeypatch.setattr(PointReach, "step", bad)
    options = dict(text.split("=") for text in SMALL if not text.startswith(("env=", "algo")))
    options |= {"on_divergence": "stop_seed"} | ({"algo.lr": 1e30} if wrong == "seeds" else {})
    with pytest.warns(RuntimeWarning, match="diverged at env step"):
        found = matd3_jax.train("algo.hidden=[8]", env="point_reach", algo="iddpg", run_dir=tmp_path / "run", **options)
    assert len(found.diverged) == 3 and found.metrics["step"][0, -1] < 1200
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["last_tenth"] == {}
    assert all(np.isfinite(leaf).all() for leaf in last_networks(tmp_path / "run").values())
    with pytest.raises(UserError, match="all its seeds have diverged and stopped"):
        Recorder().resume(tmp_path / "run")


def test_a_run_all_of_whose_seeds_diverge_has_no_means(tmp_path, capsys):
    assert train.main([*SMALL, f"out={tmp_path}", "name=run", "algo.lr=1e30"]) == 3
    out = capsys.readouterr().out
    assert "none of 3 seeds" in out and "all seeds diverged: there are no means" in out and "evaluation -" not in out
    summary = json.loads((tmp_path / "run" / "summary.json").read_text(), parse_constant=pytest.fail)
    assert len(summary["diverged"]) == 3 and summary["last_tenth"] == {} and "last_evaluation" not in summary


def test_from_python_it_is_a_warning(blown):
    options = dict(text.split("=") for text in SMALL if not text.startswith(("env=", "algo")))
    with pytest.warns(RuntimeWarning, match=f"seed {LOST} diverged at env step"):
        result = matd3_jax.train("algo.hidden=[8]", env="point_reach", algo="iddpg", **options)
    assert list(result.diverged) == [LOST]
    step, losses = result.metrics["step"][0], result.metrics["agent_0_critic_loss"]
    assert result.diverged[LOST] == step[~np.isfinite(losses[1]) & (result.metrics["updates"][1] > 0)][0]


def test_networks_that_no_loss_shows(tmp_path):
    """A weight of -inf before a ReLU leaves outputs finite."""
    settings = config.load(SMALL)
    recorded = Recorder().start(settings, tmp_path / "run")
    training, state = recorded.training, recorded.outcome.state
    assert training.finite(state).tolist() == [True] * 3
    group = state.groups[0]
    actor = {**group.actor, "bias_0": group.actor["bias_0"].at[1, 0, 0].set(-jnp.inf)}
    broken = state._replace(groups=(group._replace(actor=actor), *state.groups[1:]))
    assert training.finite(broken).tolist() == [True, False, True]
    assert np.asarray(networks_finite(broken)).tolist()[:3] == [True, False, True]
    step = int(recorded.outcome.row["step"][0])
    shutil.rmtree(tmp_path / "run" / "checkpoints")
    checkpoint.save(tmp_path / "run" / "checkpoints", step, training.trainer, broken, 1)
    (tmp_path / "run" / "summary.json").unlink()
    said = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Recorder(say=said.append).resume(tmp_path / "run")
    assert any(line.startswith("seed 5 diverged at env step") and "networks are not finite" in line for line in said)
    assert recorded.directory.summary()["diverged"] == {"5": step}
