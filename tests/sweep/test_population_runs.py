"""Sweeps with populations: who copies whom, what is trained on with what, resuming to the bit, and what is reported."""

import csv
import json
import signal
from pathlib import Path

import numpy as np
import pictures
import pytest
from checkpoint_arrays import assert_same_run

from matd3_jax import config
from matd3_jax.cli import check, evaluate, sweep
from matd3_jax.figures import lineage as figure
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.sweep import lineage as lineages
from matd3_jax.sweep.lineage import Lineage
from matd3_jax.training.copying import Copier
from matd3_jax.training.session import TrainingSession

pytestmark = pytest.mark.slow

TINY = [
    "env=point_reach", "algo=iddpg", "algo.hidden=[4]", "batch_size=8", "num_envs=2", "learning_starts=100",
    "replay_capacity=400", "total_steps=600", "log_every=50", "eval_every=0",
]  # fmt: skip
SWEPT = ["algo.lr=0.0001,0.001,0.01,0.1,1.0", "algo.gamma=0.9"]
RATES = [0.0001, 0.001, 0.01, 0.1, 1.0]
PBT = ["pbt=true", "pbt_every=100", "pbt_replay=true", "seeds=3", "seed=2"]
SEEDS = (2, 3, 4)


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "pbt.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """(folder of a finished sweep of five members in three populations, what was copied, the rates trained with)."""
    out, copies, rates = tmp_path_factory.mktemp("populations"), [], []
    copy, advance = Copier.copy, TrainingSession.advance
    with pytest.MonkeyPatch.context() as patch:

        def noted(self, state, sources, replay=(), environments=()):
            copies.append((dict(sources), list(replay), list(environments)))
            return copy(self, state, sources, replay, environments)

        def seen(self, state):
            rates.append(np.asarray(self.interval.hyper[0].critic_lr)[:15].reshape(5, 3))
            return advance(self, state)

        patch.setattr(Copier, "copy", noted)
        patch.setattr(TrainingSession, "advance", seen)
        assert sweep.main([*TINY, *SWEPT, *PBT, f"out={out}", "name=whole"]) == 0
    return out / "whole", copies, rates


def test_the_worst_copy_the_best_by_the_metrics_tables(trained):
    """Selection from metrics.csv by hand: one of five copies, from the best one; nobody at env step 100, where all have
    just begun to learn and play alike."""
    folder, copies, _ = trained
    table = rows(folder)
    steps = sorted({int(row["step"]) for row in table})
    assert steps == [50, 100, 200, 300, 400, 500] and len(table) == 15 * len(steps)
    settings = list(dict.fromkeys(row["setting"] for row in table))
    metrics = {name: RunDirectory(folder / "runs" / name).read_metrics() for name in settings}
    expected = []
    for step in steps:
        sources = {}
        for s, seed in enumerate(SEEDS):
            now = {row["setting"]: row for row in table if row["step"] == str(step) and row["seed"] == str(seed)}
            score = {}
            for name, m in metrics.items():
                there = (m["seed"] == seed) & (m["step"] <= step) & np.isfinite(m["return_agents"])
                score[name] = m["return_agents"][there][-1]
                assert float(now[name]["score"]) == pytest.approx(score[name], rel=1e-7)
            worst, best = (sorted(settings, key=lambda name: score[name])[k] for k in (0, -1))
            for name, row in now.items():
                copied = step > 100 and name == worst
                assert not copied or score[worst] < score[best]
                assert row["parent"] == (best if copied else name)
                if copied:
                    sources[settings.index(name) * 3 + s] = settings.index(best) * 3 + s
        assert step != 100 or len({score[name] for name in settings}) == 1
        expected += [sources] if sources else []
    assert len(expected) == 4
    assert [sources for sources, *_ in copies] == expected
    assert all(sorted(replay) == sorted(sources) and environments == [] for sources, replay, environments in copies)


def test_members_are_trained_with_the_values_that_the_table_says(trained):
    """And who copied has a neighbor of the value that it copied, others their own."""
    folder, _, rates = trained
    found, table = {}, rows(folder)
    for row in table:
        k, s = RATES.index(float(row["setting"].removeprefix("lr_"))), SEEDS.index(int(row["seed"]))
        found.setdefault(int(row["step"]), np.zeros((5, 3)))[k, s] = float(row["algo.lr"])
        if int(row["step"]) > 50:
            parent = RATES.index(float(row["parent"].removeprefix("lr_")))
            before, after = found[list(found)[-2]][parent, s], float(row["algo.lr"])
            steps = RATES.index(after) - RATES.index(before)
            assert steps == 0 if parent == k else steps in (-1, 1) or (steps == 0 and before in (0.0001, 1.0))
    assert len(rates) == 11
    for number, used in enumerate(rates):
        begin = 50 + 50 * number
        np.testing.assert_allclose(used, found[max(step for step in found if step <= begin)], rtol=1e-6)
    assert (found[500] != found[50]).any()


def test_after_the_end_there_are_a_table_a_picture_and_the_schedule_of_the_best(trained, tmp_path, monkeypatch, capsys):
    folder, *_ = trained
    (folder / "pbt.png").unlink()
    assert sweep.main([f"resume={folder}"]) == 0
    said = capsys.readouterr().out
    with (folder / "seeds.csv").open(newline="") as file:
        finals = [(float(row["final"]), row["setting"], row["seed"]) for row in csv.DictReader(file)]
    final, name, seed = max(finals)
    best = [max(one[0] for one in finals if one[2] == str(s)) for s in SEEDS]
    assert f"best member of each population (3), final: {np.mean(best):.4g}" in said
    assert f"hyper-parameters of the best, {name} seed {seed} ({final:.4g})" in said
    lineage = Lineage.read(folder / "pbt.csv")
    stages = lineage.schedule(lineage.settings.index(name), SEEDS.index(int(seed)))
    assert all(line in said for line in lineages.lines(stages, lineage.keys))
    summary = RunDirectory(folder / "runs" / name).summary()["population"][seed]
    assert summary == [{"step": s.step, "setting": s.setting, "algo.lr": s.values[0]} for s in stages]
    assert (folder / "pbt.png").is_file() and check.main([f"sweep={folder}"]) == 0
    written = pictures.written(monkeypatch)
    figure.draw(tmp_path / "again.png", lineage, "return_agents")
    axes = written[tmp_path / "again.png"].axes[:6]
    assert [axis.get_title() for axis in axes[:3]] == ["population 2", "population 3", "population 4"]
    for s, axis in enumerate(axes[:3]):
        x, y = axis.lines[-1].get_data()
        np.testing.assert_array_equal(x, lineage.steps)
        np.testing.assert_allclose(y, [scores[:, s].max() for scores in lineage.scores])
    members, copies = (c.get_segments() for c in axes[3].collections)
    assert len(members) == 5 * 5 and len(copies) == 4
    for (x0, y0), (x1, y1) in copies:
        e = lineage.steps.index(round(x1))
        child = next(k for k in range(5) if lineage.parents[e][k, 0] != k)
        assert y1 == float(lineage.values[e][child][0][0]) and x0 == x1 - 0.4 * (x1 - lineage.steps[e - 1])
        assert y0 == float(lineage.values[e - 1][lineage.parents[e][child, 0]][0][0])


def test_a_member_can_be_evaluated(trained):
    folder, *_ = trained
    assert evaluate.main([f"run={folder / 'runs' / 'lr_0.01'}", "episodes=2"]) == 0


def test_stopped_and_resumed_it_is_the_same_sweep(trained, tmp_path, monkeypatch):
    """Signals in the interval that a selection ends, and in the one after it."""
    folder, *_ = trained
    advance, calls = TrainingSession.advance, []

    def counted(self, state):
        calls.append(1)
        if len(calls) in (3, 5):
            signal.raise_signal(signal.SIGTERM)
        return advance(self, state)

    monkeypatch.setattr(TrainingSession, "advance", counted)
    assert sweep.main([*TINY, *SWEPT, *PBT, f"out={tmp_path}", "name=cut"]) == 128 + signal.SIGTERM
    cut = tmp_path / "cut"
    table = (cut / "pbt.csv").read_text()
    assert len(table.splitlines()) == 1 + 15 * 3
    (cut / "pbt.csv").write_text(table + "what a kill left after the checkpoint\r\n")
    assert sweep.main([f"resume={cut}"]) == 128 + signal.SIGTERM
    (cut / "pbt.csv").unlink()
    assert sweep.main([f"resume={cut}"]) == 0 and len(calls) == 11
    assert (cut / "pbt.csv").read_text() == (folder / "pbt.csv").read_text()
    for path in (folder / "runs").iterdir():
        assert_same_run(cut / "runs" / path.name, path)
    assert (cut / "table.csv").read_text() == (folder / "table.csv").read_text()


def test_a_population_does_not_depend_on_the_others(trained, tmp_path):
    """The second of the three alone."""
    folder, *_ = trained
    given = [*TINY, *SWEPT, *PBT[:3], "seeds=1", "seed=3"]
    assert sweep.main([*given, f"out={tmp_path}", "name=alone"]) == 0
    ours, theirs = rows(tmp_path / "alone"), [row for row in rows(folder) if row["seed"] == "3"]
    assert len(ours) == len(theirs) == 30
    for one, other in zip(ours, theirs, strict=True):
        assert {**one, "score": ""} == {**other, "score": ""}
        assert float(one["score"]) == pytest.approx(float(other["score"]), rel=1e-3)


def test_a_member_that_diverged_is_trained_again(tmp_path, capsys):
    """With a rate of 1e30 networks are lost at once; they, the replay and the environments are replaced."""
    given = ["algo.lr=0.001,0.01,1e30", "pbt=true", "pbt_every=300", "log_every=100", "total_steps=800", "seeds=1"]
    given = config.merge(TINY, given)
    taken, copy = [], Copier.copy
    with pytest.MonkeyPatch.context() as patch:

        def noted(self, state, sources, replay=(), environments=()):
            taken.append((sources, list(replay), list(environments)))
            return copy(self, state, sources, replay, environments)

        patch.setattr(Copier, "copy", noted)
        assert sweep.main([*given, "pbt_explore=resample", "sample_seed=2", f"out={tmp_path}", "name=lost"]) == 0
    folder = tmp_path / "lost"
    assert "lr_1e+30: seed 0 diverged" in capsys.readouterr().out
    start, selected, last = dict.fromkeys(row["step"] for row in rows(folder))
    first = {row["setting"]: row for row in rows(folder) if row["step"] == selected}
    assert np.isnan(float(first["lr_1e+30"]["score"])) and first["lr_1e+30"]["parent"] != "lr_1e+30"
    sources, replay, environments = taken[0]
    assert list(sources) == replay == environments == [2] and sources[2] in (0, 1)
    values = {row["setting"]: float(row["algo.lr"]) for row in rows(folder) if row["step"] == last}
    assert max(values.values()) < 1, "the draw of the test's seed"
    metrics = RunDirectory(folder / "runs" / "lr_1e+30").read_metrics()
    loss = metrics["agent_0_critic_loss"]
    before = (metrics["step"] > int(start)) & (metrics["step"] <= int(selected))
    assert before.sum() > 1 and not np.isfinite(loss[before]).any()
    assert np.isfinite(loss[metrics["step"] > int(selected)]).all()
    with (folder / "table.csv").open(newline="") as file:
        assert {row["setting"]: row["diverged"] for row in csv.DictReader(file)}["lr_1e+30"] == "0"
    assert json.loads((folder / "sweep.json").read_text())["pbt"]["explore"] == "resample"
