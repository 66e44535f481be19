"""estimate=true: what is missing, in which programs, and how long it takes; nothing is written."""

import re

import pytest
from study_cases import NOISE, fake_run

from experiments import all as everything
from experiments import cooperative, estimating, target_smoothing
from experiments.estimating import Batch, Estimator, Rate
from experiments.study import StudyOptions
from matd3_jax import config
from matd3_jax.runtime import devices
from matd3_jax.sweep.runner import Sweep

TINY = ["algo.hidden=[8]", "batch_size=16", "learning_starts=200", "replay_capacity=1000", "log_every=200"]


def test_estimate_measures_and_writes_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(estimating, "EACH", 0.05)
    monkeypatch.setattr(estimating, "STEPS", 200)
    measured = []
    measure = estimating.measure
    monkeypatch.setattr(estimating, "measure", lambda batch: measured.append(measure(batch)) or measured[-1])
    argv = ["scale=small", "only=simple_spread-maddpg", "seeds=2", "total_steps=1000000", *TINY]
    argv += [f"runs={tmp_path / 'runs'}", f"out={tmp_path / 'out'}", "estimate=true"]
    assert cooperative.main(argv) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "Cooperative tasks: 1 of 4 settings to train, 3 not"
    assert lines[1] == "program 1: simple_spread-maddpg (2 seeds)"
    found = re.fullmatch(
        r"    2 seeds x (1,00\d,\d00) env steps at ([\d,]+) env steps/s .*\(measured\): (.*), .* GB", lines[2]
    )
    steps, rate = (int(number.replace(",", "")) for number in found.groups()[:2])
    exact = measured[0].steps  # the printed rate is rounded, and may lie beyond the next minute
    assert len(measured) == 1 and exact > 100 and rate == pytest.approx(exact, rel=0.05)
    assert found[3] == estimating.cost.duration(2 * steps / exact)
    assert lines[3].startswith(f"total: {2 * steps:,} env steps in 1 program, {found[3]}")
    assert not list(tmp_path.iterdir())


def test_what_is_not_measured_is_scaled_by_its_products(monkeypatch):
    measured = []

    def measure(batch):
        measured.append(batch.members[0].name)
        return Rate(batch.env, 1e6, 1000.0)

    monkeypatch.setattr(estimating, "measure", measure)
    monkeypatch.setattr(Batch, "flops", 4e6)
    one = Batch([config.load(["env=simple_spread", "name=one", *TINY])])
    two = Batch([config.load(["env=simple_spread", "name=two", "seeds=2", *TINY])])
    other = Batch([config.load(["env=simple_spread", "name=other", "algo.lr=0.5", *TINY])])
    estimator = Estimator(seconds=0.0)
    assert estimator.rate(one) == (1000.0, True)
    assert estimator.rate(two) == (250.0, False)
    assert estimator.rate(other) == (1000.0, True)  # another learning rate, the same program
    estimator.seconds = 10.0
    assert estimator.rate(two) == (1000.0, True)
    assert measured == ["one", "two"]


def test_begun_batches_are_resumed_and_new_ones_share_programs(tmp_path):
    lines = target_smoothing.settings("small", StudyOptions())
    settings = {label: config.load([*line, *TINY]) for label, line in lines.items()}
    found = estimating.planned(settings, tmp_path)
    # Without noise a program has no smoothing in it; the others differ in a number.
    assert sorted(len(batch.members) for batch in found) == [1, 3] and not list(tmp_path.iterdir())
    first = next(iter(settings))
    Sweep(tmp_path).add({first: settings[first]}, devices.free_memory())
    again = estimating.planned(settings, tmp_path)
    assert sorted(member.name for batch in again for member in batch.members) == sorted(settings)
    assert [member.name for member in again[0].members] == [first] and again[0].done == 0


def test_finished_settings_are_not_counted_and_all_adds_up(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(everything, "STUDIES", {s.STUDY.name: s.STUDY for s in (cooperative, target_smoothing)})
    monkeypatch.setattr(estimating, "measure", lambda batch: Rate(batch.env, 1e6, 1000.0))
    out, runs = tmp_path / "out", tmp_path / "runs"
    for label, line in target_smoothing.settings("small", StudyOptions()).items():
        returns = {"return_agents": (NOISE, NOISE)}
        fake_run(runs / "target_smoothing_small" / label, [t for t in line if "seeds" not in t], returns)
    places = [f"{key}={path / 'target_smoothing_small'}" for key, path in (("out", out), ("runs", runs))]
    assert target_smoothing.main(["scale=small", "train=false", *places]) == 0
    capsys.readouterr()
    before = sorted(tmp_path.rglob("*"))
    assert everything.main(["scale=small", "estimate=true", "seeds=4", f"out={out}", f"runs={runs}"]) == 0
    told = capsys.readouterr().out
    assert "0 of 4 settings to train, 4 not\ntotal: nothing is missing" in told
    assert re.search(r"\nall: [\d,]+ env steps, about", told)
    assert sorted(tmp_path.rglob("*")) == before
