"""The cross-play of the competitive study: run directories with random policies, and the numbers that come of them."""

import csv
import json
import shutil

import numpy as np
import pytest
from cross_cases import make

from experiments import competitive, cross_play, cross_play_data
from experiments.cross_play_data import Task
from experiments.study import StudyOptions
from matd3_jax.cli import crossplay
from matd3_jax.errors import UserError
from matd3_jax.evaluation import entrants
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.training import checkpoint

TINY = ["env.episode_length=5", "batch_size=8", "num_envs=2", "rollout_length=5", "learning_starts=20", "seeds=3",
        "replay_capacity=100", "total_steps=100", "algo.hidden=[4]", "eval_every=0"]  # fmt: skip

SIDES = ("adversaries", "agents")
"""In Predator-Prey, of the team and of the single agent."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Runs of Predator-Prey, whose team are the adversaries, and one of Keep-away."""
    folder = tmp_path_factory.mktemp("competitive")
    lines = competitive.settings("small", StudyOptions())
    chosen = [label for label in lines if label.startswith("simple_tag")] + ["simple_push-matd3-vs-matd3"]
    for number, label in enumerate(chosen):
        training, state = make([*lines[label][:3], *TINY], number=number)
        run = RunDirectory.create(folder / "runs" / label, training.config, {})
        checkpoint.save(run.checkpoints, 100, training.trainer, state, 1)
        run.write_summary({"total_steps": 100})
    return folder


@pytest.mark.slow
def test_command(folder, tmp_path, monkeypatch, capsys):
    argv = [f"runs={folder}", f"out={tmp_path / 'out'}", "episodes=3", "deterministic=true"]
    assert cross_play.main(argv) == 0
    told = capsys.readouterr().out
    assert "simple_push: not played" in told and "MADDPG against MATD3" in told and "simple_tag: played" in told
    ((env, task),) = cross_play_data.read(
        tmp_path / "out" / "cross_play.csv", tmp_path / "out" / "cross_play.json"
    ).items()
    assert env == "simple_tag" and task.facts["runs"]["matd3-vs-maddpg"] == {"checkpoint": 100, "seeds": [0, 1, 2]}
    assert len(task.returns) == 16 * 9
    # The same pairs by the other command: MADDPG prey's run (algo=maddpg adversary=matd3) has a MATD3 team.
    other = tmp_path / "other" / "cross_play_simple_tag"
    where = f"runs={folder / 'runs' / 'simple_tag-*'}"
    assert crossplay.main([where, "episodes=3", "deterministic=true", f"out={other}"]) == 0
    with (other / "pairs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 16 * 9
    for row in rows:
        # The label of a run is ENV-PREY-vs-PREDATORS, a pairing (predators, prey).
        pairs = [tuple(reversed(row[name].removeprefix("simple_tag-").split("-vs-"))) for name in SIDES]
        same = (task.runs == [competitive.PAIRINGS.index(pair) for pair in pairs]).all(axis=1)
        same &= (task.seeds == [int(row[f"{name}_seed"]) for name in SIDES]).all(axis=1)
        np.testing.assert_allclose(task.returns[same], [float(row["return_adversaries"])], rtol=1e-4, atol=1e-4)
    # What that command left is taken as it is.
    assert cross_play.main(["play=false", f"out={tmp_path / 'other'}"]) == 0
    for name in ("cross_play.json", "cross_play.md"):
        assert (tmp_path / "other" / name).read_text() == (tmp_path / "out" / name).read_text()
    taken = cross_play_data.read(*(tmp_path / "other" / name for name in cross_play.FILES))["simple_tag"]
    np.testing.assert_allclose(taken.returns, task.returns, rtol=1e-4)
    text = (tmp_path / "out" / "cross_play.md").read_text()
    assert "Predator-Prey: 3 seeds of each pairing after 100 env steps, 3 deterministic episodes" in text
    assert text.count("**not yet run**") == 6
    # Nothing is played again, nor lost where the runs are gone; other episodes are another thing.
    before = (tmp_path / "out" / "cross_play.csv").read_bytes()
    monkeypatch.setattr(entrants, "play", None)
    assert cross_play.main(argv) == 0
    assert cross_play.main([f"out={tmp_path / 'out'}", "play=false"]) == 0
    assert (tmp_path / "out" / "cross_play.csv").read_bytes() == before
    with pytest.raises(TypeError):
        cross_play.main([f"runs={folder}", f"out={tmp_path / 'out'}", "episodes=4", "deterministic=true"])


def made_up(returns):
    """A task with 3 seeds whose returns are a function of the two pairings and seeds."""
    who = [(i, j, k, m) for i in range(4) for j in range(4) for k in range(3) for m in range(3)]
    facts = {"runs": {"-vs-".join(pair): {"checkpoint": 1, "seeds": [5, 6, 7]} for pair in competitive.PAIRINGS}}
    runs, seeds = np.array(who)[:, :2], np.array(who)[:, 2:]
    return Task(facts, runs, seeds, np.array([float(returns(*one)) for one in who]))


def test_means_and_contrasts():
    """The team's algorithm is that of its own pairing, the opponent's that of the opponent's; own partners apart."""
    teams, singles = ([algo for algo, _ in competitive.PAIRINGS], [algo for _, algo in competitive.PAIRINGS])

    def returns(i, j, k, m):
        return 100 if (i, k) == (j, m) else 10 * (teams[i] == "matd3") - 4 * (singles[j] == "matd3") + (k - 1)

    task = made_up(returns)
    assert task.mean([("matd3", "maddpg")], own=True).value[0] == 100
    strangers = task.mean([("matd3", "maddpg")], own=False)
    assert strangers.value[0] == pytest.approx(10) and strangers.pairs == 4 * 9 - 3
    value, half = task.contrast([("matd3", "maddpg")], [("maddpg", "matd3")])
    assert value == pytest.approx(14)
    # Four cells on either side; only the team's seeds differ, by 1 (sd): two runs of three seeds on each side.
    assert half == pytest.approx(2.8 * np.sqrt(4 * 1 / 3 / 4), rel=0.35)
    matrix = task.matrix()
    assert matrix[0, 1] == pytest.approx(10) and matrix[3, 0] == pytest.approx(-4)
    assert matrix[2, 2] == pytest.approx(-4)


def test_one_seed_has_no_intervals():
    """Where everybody's only partner is their own there are no strangers in a cell; nothing is claimed."""
    task = made_up(lambda i, j, k, m: 10.0 * i)
    few = (task.seeds == 0).all(axis=1)
    task = Task(task.facts, task.runs[few], task.seeds[few], task.returns[few])
    value, half = task.contrast([("matd3", "maddpg")], [("maddpg", "matd3")])
    assert np.isfinite(value) and np.isnan(half)
    assert np.isnan(np.diag(task.matrix())).all() and task.matrix()[3, 0] == 30
    claims = cross_play.claims({"simple_tag": task})
    assert [claim.verdict for claim in claims] == ["not yet run"] * 6 + ["not shown"] * 2


def test_data_are_read_as_they_were_written(tmp_path):
    task = made_up(lambda i, j, k, m: 1000 * i + 100 * j + 10 * k + m)
    sound = ~((task.runs[:, 0] == 1) & (task.seeds[:, 0] == 2))  # a seed that diverged
    task = Task(task.facts, task.runs[sound], task.seeds[sound], task.returns[sound])
    where = tmp_path / "a.csv", tmp_path / "a.json"
    cross_play_data.write({"simple_tag": task}, *where)
    again = cross_play_data.read(*where)["simple_tag"]
    for name in ("runs", "seeds", "returns"):
        np.testing.assert_array_equal(getattr(again, name), getattr(task, name))
    assert again.facts == task.facts
    where[1].write_text(json.dumps({"simple_push": {}}))
    with pytest.raises(UserError, match="cannot read .*a.csv.*remove both"):
        cross_play_data.read(*where)


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (["only=simple_spread"], "only=simple_spread: matches none of simple_crypto"),
        (["episodes=0"], "episodes=0: must be"),
        (["scale=big"], "scale=big: must be one of"),
        ([], "there is nothing to report"),
    ],
)
def test_bad_input_is_one_line(tmp_path, argv, line):
    with pytest.raises(UserError, match=line):
        cross_play.main([f"runs={tmp_path}", f"out={tmp_path / 'out'}", *argv])
    assert not list(tmp_path.iterdir())


def test_two_runs_of_a_pairing_are_refused(folder, tmp_path):
    shutil.copytree(folder / "runs", tmp_path / "runs", ignore=shutil.ignore_patterns("checkpoints"))
    (tmp_path / "runs" / "simple_push-matd3-vs-matd3").rename(tmp_path / "simple_push")
    shutil.copytree(tmp_path / "simple_push", tmp_path / "runs" / "again")
    with pytest.raises(UserError, match="both have seed 0 of the same pairing"):
        cross_play.main([f"runs={tmp_path}", f"out={tmp_path / 'out'}"])


def test_a_cross_play_of_other_runs_is_refused(tmp_path):
    played = tmp_path / "cross_play_simple_push"
    played.mkdir()
    run = {"algorithms": {"agents": "matd3", "adversaries": "matd3"}, "checkpoint": 1, "seeds": [0]}
    (played / "crossplay.json").write_text(json.dumps({"runs": {"one": run}, "episodes": 1, "deterministic": True}))
    with pytest.raises(UserError, match="cannot read .*cross_play_simple_push .*not one run of each pairing"):
        cross_play.main(["play=false", f"out={tmp_path}"])
