"""The report of `experiments.hybrid`: what it says of given runs."""

import csv
import dataclasses
import json
import shutil

import numpy as np
import pictures
import pytest

from experiments import ant, hybrid
from matd3_jax import config
from matd3_jax.runs.directory import RunDirectory

STEPS = (0, 10, 20, 30, 40, 50, 60, 70, 80, 90, 100)


def curve(name, steps):
    """MATD3 is early and ends at 50, TD3 late at 90, the hybrids as the one before step 30 and rise to 100 and 110."""
    early, late = np.minimum(2.0 * steps, 50), np.maximum(2.0 * steps - 110, 0)
    return {"MATD3": early, "TD3": late, "TD3, as wide": late + 1,
            "hybrid": np.where(steps <= 30, early, steps),
            "hybrid, distilled": np.where(steps <= 30, early, 1.1 * steps)}[name]  # fmt: skip


@pytest.fixture
def runs(tmp_path):
    options, folder = hybrid.HybridOptions(scale="small"), tmp_path / "runs"
    for name, (label, line) in zip(hybrid.COLORS, hybrid.settings("small", options).items(), strict=True):
        run = RunDirectory.create(folder / label, config.load([*line, "seeds=2"]), {"cores": 2})
        for step in STEPS:
            returns = curve(name, np.float64(step)) + np.array([-1.0, 1.0])
            run.append(
                {
                    "step": np.full(2, step),
                    "seed": np.arange(2),
                    "updates": np.full(2, step),
                    "return_agents": np.zeros(2),
                    "eval_return_agents": returns,
                    "eval_forward_velocity": returns / 100,
                }
            )
        run.write_summary({"total_steps": 100})
    return folder


def test_settings_differ_in_nothing_but_the_algorithm_and_its_width():
    found = hybrid.settings("small", hybrid.HybridOptions(scale="small"))
    loaded = {label: config.load(line) for label, line in found.items()}
    assert list(loaded) == ["matd3", "hybrid", "td3", "td3_wide", "hybrid_distilled"]
    assert [one.switch_at for one in loaded.values()] == [None, 60_000, None, None, 60_000]
    assert [one.algo.handover for one in loaded.values()] == ["join"] * 4 + ["distill"]
    assert [one.algo.hidden for one in loaded.values()] == [(128, 128)] * 3 + [(256, 256), (128, 128)]
    assert {(one.seeds, one.total_steps, one.batch_size, one.recipe) for one in loaded.values()} == {
        (5, 200_000, 512, "fast")
    }


def test_report(runs, tmp_path, monkeypatch):
    figures = pictures.written(monkeypatch)
    out = tmp_path / "out"
    assert hybrid.main(["scale=small", "train=false", f"runs={runs}", f"out={out}", "seeds=2"]) == 0
    with (out / "curves.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 5 * 2 * len(STEPS)
    table = (out / "table.md").read_text()
    # Before the switch: the mean of 0, 20, 40, 50 against 0; late: of 70 to 100, against 50 and against 2 s - 110.
    assert (
        "27.5" in table and "| hybrid | 2 | 100 | 100 ± 1 " in table and "| TD3, as wide | 2 | 100 | 91 ± 1 " in table
    )
    assert table.count("**same**") == 7, table
    assert "hybrid, distilled minus hybrid, seed by seed | hybrid, distilled 93.5 " in table
    assert table.count(", seed by seed") == 2 and ": hybrid minus MATD3, seed by seed | hybrid 85 " in table
    axes = figures[out / "curves.png"].axes
    assert [label.split(" (")[0] for label in pictures.lines(axes[0])][:5] == list(hybrid.COLORS)
    np.testing.assert_allclose(pictures.lines(axes[0])["hybrid (2 seeds)"][1], curve("hybrid", np.array(STEPS)))


@pytest.mark.parametrize(("steps", "taken"), [(200_000, True), (100_000, False)])
def test_what_the_ants_study_has_of_the_same_settings_is_taken_over(runs, tmp_path, steps, taken):
    """MATD3's and TD3's rows come from the folder beside, with what is said of them, and are kept."""
    out, beside = tmp_path / "results" / "hybrid", tmp_path / "results" / "half_cheetah"
    for algo in ("matd3", "td3"):  # where `ant` has trained them, for as long or not
        path = runs / algo
        settings = config.read(path / "config.yaml")
        config.write(dataclasses.replace(settings, total_steps=steps), path / "config.yaml")
    given = ["scale=small", "train=false", "seeds=2"]
    assert ant.main([*given, f"runs={runs}", f"out={beside}", f"total_steps={steps}", "algos=[matd3,td3]"]) == 0
    for algo in ("matd3", "td3"):
        shutil.rmtree(runs / algo)
    assert hybrid.main([*given, f"runs={runs}", f"out={out}"]) == 0
    facts = json.loads((out / "runs.json").read_text())
    shutil.rmtree(beside)
    assert hybrid.main([*given, f"runs={runs}", f"out={out}"]) == 0
    assert json.loads((out / "runs.json").read_text()) == facts
    assert ("matd3" in facts, "td3" in facts, "hybrid" in facts) == (taken, taken, True)
    assert (out / "table.md").read_text().count("**same**") == (7 if taken else 2)
    if taken:
        assert "experiments.ant" in facts["matd3"]["command"] and "experiments.hybrid" in facts["hybrid"]["command"]


def test_seeds_are_pairs_where_they_began_alike():
    """MATD3 has no evaluation at the switch itself; one number that differs before it is another run."""
    steps, values = np.array(STEPS), np.arange(22.0).reshape(2, 11)
    ours = np.insert(steps, 3, 28), np.insert(np.where(steps > 30, values + 5, values), 3, 1.0, axis=1)
    assert hybrid.began_alike(ours, (steps, values))
    other = values.copy()
    other[1, 2] += 1e-9
    assert not hybrid.began_alike(ours, (steps, other)) and not hybrid.began_alike(ours, (steps, values[:1]))
    assert not hybrid.began_alike(ours, None)
