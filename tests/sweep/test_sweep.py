"""Sweeps: members equal to runs made alone, resuming, batches, the table, and one line for bad input."""

import csv
import dataclasses
import json
import shutil
import signal
from pathlib import Path

import numpy as np
import pictures
import pytest
from checkpoint_arrays import assert_same_run, state_leaves

from matd3_jax import config
from matd3_jax.cli import sweep, train
from matd3_jax.errors import UserError
from matd3_jax.figures import sweep as figure
from matd3_jax.figures.sweep import BEST
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.sweep import launcher, ranking, runner
from matd3_jax.sweep.batch import Batch
from matd3_jax.sweep.runner import Sweep
from matd3_jax.training.session import TrainingSession

pytestmark = pytest.mark.slow

# Small enough to run in a second or two; both teams, an evaluation and the delay are there.
TINY = [
    "env=simple_push", "adversary=maddpg", "algo.hidden=[8]", "adversary.hidden=[8]", "batch_size=16", "num_envs=2",
    "learning_starts=200", "replay_capacity=500", "total_steps=600", "log_every=100", "eval_every=300",
    "eval_episodes=3",
]  # fmt: skip
SWEPT = ["algo.lr=0.01,0.1", "algo.tau=0.01,0.5"]


@pytest.fixture(scope="module")
def swept(tmp_path_factory) -> Path:
    """A finished sweep of 2 x 2 settings with two seeds, in one batch."""
    out = tmp_path_factory.mktemp("sweeps")
    assert sweep.main([*TINY, *SWEPT, "seeds=2", "logger=[csv,tensorboard]", f"out={out}", "name=whole"]) == 0
    return out / "whole"


def test_one_batch_holds_what_shares_a_program(swept):
    assert len(Sweep(swept).batches) == 1 and len(Sweep(swept).batches[0]) == 4


def test_each_member_equals_the_same_run_made_alone(swept, tmp_path):
    """Metrics, networks, optimizers, environments and keys of one member, against a run of its settings."""
    assert train.main([*TINY, "algo.lr=0.1", "algo.tau=0.01", "seeds=2", f"out={tmp_path}", "name=alone"]) == 0
    member = swept / "runs" / "lr_0.1-tau_0.01"
    found, alone = (RunDirectory(path).read_metrics() for path in (member, tmp_path / "alone"))
    assert list(found) == list(alone)
    for name, values in alone.items():
        np.testing.assert_allclose(found[name], values, rtol=2e-5, atol=1e-5, err_msg=name)
    ours, theirs = state_leaves(member), state_leaves(tmp_path / "alone")
    assert set(ours) == set(theirs)
    for name, values in theirs.items():
        np.testing.assert_allclose(ours[name], values, rtol=1e-4, atol=1e-5, err_msg=name)
    settings = (config.read(path / "config.yaml") for path in (member, tmp_path / "alone"))
    one, other = (dataclasses.replace(s, name=None, out="", logger=("csv",)) for s in settings)
    assert one == other


def test_each_member_has_tensorboard_files_of_its_own(swept):
    for path in (swept / "runs").iterdir():
        (events,) = (path / "tensorboard").glob("events*")
        written = events.read_bytes()
        assert b"return_agents/seed_1" in written and b"seed_2" not in written


def test_members_learn_with_their_own_numbers(swept):
    actors = [state_leaves(path) for path in sorted((swept / "runs").iterdir())]
    for k, one in enumerate(actors):
        for other in actors[:k]:
            assert any(not np.array_equal(one[name], other[name]) for name in one if "critic" in name)


def test_a_member_can_be_evaluated_but_not_resumed(swept):
    from matd3_jax.cli import evaluate

    assert evaluate.main([f"run={swept / 'runs' / 'lr_0.1-tau_0.01'}", "episodes=2"]) == 0
    with pytest.raises(UserError, match="no replay"):
        train.main([f"resume={swept / 'runs' / 'lr_0.1-tau_0.01'}", "total_steps=1000"])


def test_the_table_ranks_by_the_mean_of_the_last_tenth(swept, tmp_path, monkeypatch):
    """Against the metrics tables, read and averaged by hand; and the picture shows them."""
    expected, curves = {}, {}
    for path in (swept / "runs").iterdir():
        with (path / "metrics.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        last = max(int(row["step"]) for row in rows)
        late = [float(row["return_agents"]) for row in rows if int(row["step"]) > 0.9 * last]
        expected[path.name] = sum(late) / len(late)
        steps = sorted({int(row["step"]) for row in rows})
        curves[path.name] = [
            np.mean([float(row["return_agents"]) for row in rows if int(row["step"]) == step]) for step in steps
        ]
    with (swept / "table.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["setting"] for row in table] == sorted(expected, key=expected.get, reverse=True)
    for row in table:
        assert float(row["final_mean"]) == pytest.approx(expected[row["setting"]], rel=1e-5)
        assert row["seeds"] == "2" and row["diverged"] == "0" and float(row["final_interval"]) > 0
        assert row["setting"] == f"lr_{row['algo.lr']}-tau_{row['algo.tau']}"
    with (swept / "seeds.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 8
    assert {BEST[k].upper() for k in range(4)} <= pictures.colors(swept / "sweep.png")
    figures, facts = pictures.written(monkeypatch), json.loads((swept / "sweep.json").read_text())
    ranked = ranking.rank(swept / "runs", facts["runs"], facts["settings"], "return_agents")
    figure.draw(tmp_path / "again.png", swept / "runs", facts["runs"], ranked, "return_agents")
    top, rate, tau = figures[tmp_path / "again.png"].axes
    drawn = pictures.lines(top)
    assert drawn.keys() == {f"{k + 1}: {row['setting']}" for k, row in enumerate(table)}
    for label, line in drawn.items():
        np.testing.assert_allclose(line, [steps, curves[label[3:]]], rtol=1e-5)
    finals = [expected[row["setting"]] for row in table]
    for axis, key in ((rate, "algo.lr"), (tau, "algo.tau")):
        values = sorted({row[key] for row in table}, key=float)
        assert axis.get_xlabel() == key and [label.get_text() for label in axis.get_xticklabels()] == values
        every, best = (c.get_offsets() for c in axis.collections if type(c).__name__ == "PathCollection")
        np.testing.assert_allclose(every, [(values.index(row[key]), f) for row, f in zip(table, finals, strict=True)])
        np.testing.assert_allclose(best, every[:1])


def test_diverged_seeds_are_counted_and_come_last(swept, tmp_path):
    """The best setting, with one seed's critic blown up by hand."""
    copy = tmp_path / "copy"
    shutil.copytree(swept, copy)
    with (copy / "table.csv").open(newline="") as file:
        best = next(csv.DictReader(file))["setting"]
    metrics = copy / "runs" / best / "metrics.csv"
    header, *rows = metrics.read_text().splitlines()
    column, seed = header.split(",").index("agent_0_critic_loss"), header.split(",").index("seed")
    last = max(k for k, row in enumerate(rows) if row.split(",")[seed] == "1")
    cells = rows[last].split(",")
    cells[column] = "inf"
    rows[last] = ",".join(cells)
    metrics.write_text("\n".join([header, *rows]) + "\n")
    facts = json.loads((copy / "sweep.json").read_text())
    ranked = ranking.rank(copy / "runs", facts["runs"], facts["settings"], "return_agents")
    assert ranked[-1].name == best and ranked[-1].diverged.tolist() == [False, True]
    assert ranked[-1].interval("final")[0] == ranked[-1].final[0]  # of the seed that did not


def test_seeds_of_one_member_stop_and_the_others_go_on(swept, tmp_path):
    given = ["algo.lr=0.01,1e30", "algo.tau=0.01", "seeds=2", "on_divergence=stop_seed"]
    assert sweep.main([*TINY, *given, f"out={tmp_path}", "name=stops"]) == 0
    lost, sound = (tmp_path / "stops" / "runs" / f"lr_{lr}" for lr in ("1e+30", "0.01"))
    assert RunDirectory(sound).summary()["diverged"] == {}
    assert set(RunDirectory(lost).summary()["diverged"]) == {"0", "1"}
    networks = {name: leaf for name, leaf in state_leaves(lost).items() if name.startswith(".groups")}
    assert state_leaves(lost)[".stopped"].all() and all(np.isfinite(leaf).all() for leaf in networks.values())
    there = state_leaves(sound)
    found = state_leaves(swept / "runs" / "lr_0.01-tau_0.01")
    for name, leaf in found.items():  # another program, which rounds otherwise
        np.testing.assert_allclose(there[name], leaf, rtol=1e-3, atol=1e-5, err_msg=name)


def test_a_sweep_that_diverged_everywhere_is_reported(swept, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(swept, copy)
    for metrics in (copy / "runs").glob("*/metrics.csv"):
        header, *rows = metrics.read_text().splitlines()
        kept = len(("step", "seed", "updates", "episodes"))
        lost = [",".join([*row.split(",")[:kept], *["nan"] * (len(row.split(",")) - kept)]) for row in rows]
        metrics.write_text("\n".join([header, *lost]) + "\n")
    assert sweep.main([f"resume={copy}"]) == 3
    with (copy / "table.csv").open(newline="") as file:
        assert [row["diverged"] for row in csv.DictReader(file)] == ["2"] * 4


def test_stopped_and_resumed_it_is_the_same_sweep(swept, tmp_path, monkeypatch, capsys):
    """A signal after the third interval; it is resumed, to the same numbers."""
    advance, calls = TrainingSession.advance, []

    def counted(self, state):
        calls.append(1)
        if len(calls) == 3:
            signal.raise_signal(signal.SIGTERM)
        return advance(self, state)

    monkeypatch.setattr(TrainingSession, "advance", counted)
    assert sweep.main([*TINY, *SWEPT, "seeds=2", f"out={tmp_path}", "name=cut"]) == 128 + signal.SIGTERM
    assert f"resume={tmp_path / 'cut'}" in capsys.readouterr().out
    assert not (tmp_path / "cut" / "table.csv").exists()
    assert sweep.main([f"resume={tmp_path / 'cut'}"]) == 0
    for path in (swept / "runs").iterdir():
        assert_same_run(tmp_path / "cut" / "runs" / path.name, path)
    assert not (tmp_path / "cut" / "batches" / "0").exists()  # its checkpoints, replays in them, are of no more use


def test_batches_are_jobs_of_their_own_and_cut_by_memory(swept, tmp_path, monkeypatch, capsys):
    """With memory for two seeds: two batches, trained apart, the same table in the end. What one process works at,
    another leaves alone."""
    monkeypatch.setattr(runner, "fitting_seeds", lambda settings, budget: 4)
    assert sweep.main([*TINY, *SWEPT, "seeds=2", f"out={tmp_path}", "name=apart", "train=false"]) == 0
    folder = tmp_path / "apart"
    assert [len(batch) for batch in Sweep(folder).batches] == [2, 2]
    assert sweep.main([f"resume={folder}", "batch=1"]) == 0
    assert Sweep(folder).finished(1) and not Sweep(folder).finished(0)
    assert not (folder / "table.csv").exists()
    with Sweep(folder)._taken(0) as mine:
        assert mine
        assert sweep.main([f"resume={folder}"]) == 1
    assert "another process trains it, skipped" in capsys.readouterr().out
    assert sweep.main([f"resume={folder}"]) == 0
    columns = ("setting", "seeds", "final_mean")
    tables = [
        [[row[c] for c in columns] for row in csv.DictReader((path / "table.csv").open(newline=""))]
        for path in (folder, swept)
    ]
    for ours, theirs in zip(*tables, strict=True):
        assert ours[:2] == theirs[:2] and float(ours[2]) == pytest.approx(float(theirs[2]), rel=1e-4)


def test_a_sweep_that_called_its_batches_pieces_is_read(swept, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(swept, copy)
    (copy / "batches.json").rename(copy / "pieces.json")
    (copy / "table.csv").unlink()
    old = Sweep(copy)
    assert old.batches == Sweep(swept).batches and old.folder_of(0) == copy / "pieces" / "0"
    old.add({"more": config.load([*TINY, "seeds=1", "algo.lr=0.5"])}, budget=10**10)
    assert len(Sweep(copy).batches[-1]) == 1 and not (copy / "batches.json").exists()
    shutil.rmtree(copy / "runs" / "more")
    (copy / "pieces.json").write_text((swept / "batches.json").read_text())
    assert sweep.main([f"resume={copy}"]) == 0
    assert (copy / "table.csv").read_text() == (swept / "table.csv").read_text()


def test_more_seeds_train_only_what_is_missing(swept, tmp_path, monkeypatch):
    copy = tmp_path / "copy"
    shutil.copytree(swept, copy)
    trained = []
    monkeypatch.setattr(Batch, "train", lambda self, stop: trained.append([(m.seed, m.seeds) for m in self.members]))
    settings = {"lr_0.1-tau_0.01": config.load([*TINY, "algo.lr=0.1", "algo.tau=0.01", "seeds=3"])}
    with pytest.raises(UserError, match="not finished"):
        runner.train(settings, copy)
    assert trained == [[(2, 1)]]
    settings = {name: dataclasses.replace(c, seeds=2) for name, c in settings.items()}
    assert runner.train(settings, copy) == {"lr_0.1-tau_0.01": [copy / "runs" / "lr_0.1-tau_0.01"]}
    assert len(trained) == 1


def test_a_launcher_trains_nothing_that_is_finished(swept, capfd):
    """Hydra starts the jobs, in folders of the sweep's own."""
    assert launcher.launch(swept, 1, "basic", []) == 0
    assert (swept / "jobs" / "0" / ".hydra" / "overrides.yaml").exists()


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["algo.lrr=1,2"], "no key 'algo.lrr'"),
        (["lr=1,2"], "did you mean 'algo.lr'"),
        (["algo.lr=range(3,1)"], "empty"),
        (["algo.lr=0.1,-1"], "actor_lr=-1"),
        (["algo.policy_delay=2,3", "updates_per_collect=2"], "with algo.policy_delay=3"),
        (["algo=matd3,maddgp"], "no algorithm is called 'maddgp'"),
        (["algo.lr=1,2", "samples=0"], "samples=0"),
        (["algo.lr=1,2", "memory=-1"], "memory=-1"),
        (["algo.lr=1,2", "memory=0.5"], "one seed needs"),
        (["algo.lr=1,2", "train=maybe"], "train=maybe"),
        (["algo.lr=1,2", "metric=return_agnets"], "did you mean 'return_agents'"),
        (["algo.lr=1,2", "bach=3"], "did you mean 'batch'"),
        (["algo.lr=1,2", "on_divergence=stop"], "on_divergence=stop: a sweep"),
        (["algo.lr=1,2", "batch=0"], "batch= goes with resume="),
        (["algo.lr=1,2", "launcher=submitti"], "no launcher is called 'submitti'"),
        (["algo.lr=1,2", "launcher.partition=gpu"], "say which launcher"),
        (["algo.lr=1,2", "launcher=basic", "launcher.partition=gpu"], "has no option 'partition'"),
        (["resume=nowhere"], "no sweep directory"),
    ],
)
def test_bad_input_gets_one_line_and_leaves_nothing(arguments, words, tmp_path):
    more = [] if arguments[0].startswith("resume") else [*TINY, "seeds=2", f"out={tmp_path}", "name=bad"]
    with pytest.raises(UserError, match=words) as error:
        sweep.main([*more, *arguments])
    assert "\n" not in str(error.value) and not (tmp_path / "bad").exists()


def test_bad_input_about_a_sweep_that_is_there(swept):
    for arguments, words in (
        ([f"resume={swept}", "batch=1"], "batches 0 to 0"),
        ([f"resume={swept}", "seeds=3"], "keeps its settings"),
        ([f"resume={swept}", "metric=return_agnets"], "did you mean 'return_agents'"),
        ([*TINY, f"out={swept.parent}", f"name={swept.name}", "algo.lr=1,2"], "is there already"),
    ):
        with pytest.raises(UserError, match=words):
            sweep.main(arguments)
