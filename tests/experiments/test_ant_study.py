"""The report of `experiments.ant`: what it says of given runs."""

import csv
import json

import numpy as np
import pictures
import pytest

from experiments import ant
from experiments.tidy import Table
from matd3_jax import config
from matd3_jax.errors import UserError
from matd3_jax.runs.directory import RunDirectory


@pytest.fixture
def runs(tmp_path):
    """Two seeds of MATD3, evaluated at 0, 20 and 40 env steps, and a finished run of TD3."""
    folder = tmp_path / "runs"
    for algo, level in {"matd3": 0.0, "td3": 500.0}.items():
        settings = config.load(["env=ant", f"algo={algo}", "seeds=2"])
        run = RunDirectory.create(folder / algo, settings, {"cores": 2})
        for step in (0, 10, 20, 30, 40):
            there = step % 20 == 0
            returns = np.array([1.0, 3.0]) * step + level
            run.append(
                {
                    "step": np.full(2, step),
                    "seed": np.arange(2),
                    "updates": np.full(2, step // 10),
                    "return_agents": np.zeros(2),
                    "eval_return_agents": returns if there else np.full(2, np.nan),
                    "eval_forward_velocity": returns / 100 if there else np.full(2, np.nan),
                }
            )
    run.write_summary({"total_steps": 40})
    return folder


def test_report(runs, tmp_path, monkeypatch):
    figures = pictures.written(monkeypatch)
    out = tmp_path / "out"
    assert ant.main(["algos=[matd3,td3,iltd3]", "train=false", f"runs={runs}", f"out={out}"]) == 0
    with (out / "curves.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    found = {(row["algo"], int(row["seed"]), int(row["step"])): float(row["eval_return_agents"]) for row in rows}
    assert found == {
        (algo, seed, step): level + (1 + 2 * seed) * step
        for algo, level in {"matd3": 0, "td3": 500}.items()
        for seed in (0, 1)
        for step in (0, 20, 40)
    }
    table = (out / "table.md").read_text()
    # Last returns 40 and 120: mean 80, sd 56.57, Student's 95 % interval 80 +- 12.706 * 40.
    assert "| MATD3 | 2 | 40 | 80 ± 57 (-428 to 588) | 80 | 0.80 |" in table
    assert "| SA-TD3 | 2 | 40 | 580 ± 57 (72 to 1088) | 580 | 5.80 |" in table
    assert "| IL-TD3 |" not in table and "Not yet run: iltd3" in table
    # Of two algorithms only one is finished: nothing is claimed.
    assert table.count("**not yet run**") == 5
    facts = json.loads((out / "runs.json").read_text())
    assert facts["matd3"]["summary"] == "not finished"
    assert facts["td3"]["summary"] == {"total_steps": 40}
    assert facts["td3"]["settings"]["algo"]["joint"] is True
    returns, velocity = figures[out / "curves.png"].axes
    matd3, td3 = "#0072B2", "#CC79A7"
    # Mean and standard deviation of 1 and 3 times the env step, 2 and sqrt(2) times.
    step = np.array([0, 20, 40])
    for axis, scale in ((returns, 1), (velocity, 100)):
        drawn, bands = pictures.lines(axis), pictures.bands(axis)
        assert list(drawn) == ["MATD3 (2 seeds)", "SA-TD3 (2 seeds)"]
        assert [line.get_color() for line in axis.lines[:2]] == [matd3, td3]
        for curve, band, level in zip(drawn.values(), bands, (0, 500), strict=True):
            np.testing.assert_allclose(curve, [step, (2 * step + level) / scale])
            ends = (2 + np.sqrt(2) * np.array([[-1], [1]])) * step + level
            np.testing.assert_allclose(band, [step, *ends / scale])
        assert axis.get_xlabel() == "env steps of each seed"
    labels = ["evaluation: return", "evaluation: forward velocity (m/s)"]
    assert [axis.get_ylabel() for axis in (returns, velocity)] == labels
    assert [text.get_text() for text in returns.texts] == ["standing still"] and not velocity.texts
    np.testing.assert_array_equal(returns.lines[2].get_ydata(), [1000, 1000])
    assert figures[out / "curves.png"].get_suptitle() == "ant: mean ± sd over seeds"
    assert {matd3, td3} <= pictures.colors(out / "curves.png")


def test_failing_is_no_better_than_standing_still():
    """What walks does not fail, however much less it is than what MATD3 gets; and there is one height to stand at."""

    def verdicts(iltd3, env="ant"):
        rows = [
            {"env": env, "algo": algo, "seed": seed, "step": step, "eval_return_agents": level + 10 * seed}
            for algo, level in {"matd3": 3000.0, "iltd3": iltd3}.items()
            for seed in range(4)
            for step in (0, 100)
        ]
        table = Table({name: np.array([row[name] for row in rows]) for name in rows[0]})
        return [claim.verdict for claim in ant.claims(table)[1:3]]

    assert verdicts(2500.0) == ["same", "opposite"] and verdicts(900.0) == ["same", "same"]
    assert verdicts(990.0)[1] == "not shown" and verdicts(2500.0, env="half_cheetah") == ["same", "not yet run"]
    claim = ant.failing("x", np.array([990.0, 1010.0, 1020.0]))
    assert claim.found == "IL-TD3 1,007 (n = 3), 2 of 3 better than standing still"
    assert claim.difference.estimate == pytest.approx(-20 / 3)


def test_bad_input_is_named(tmp_path):
    with pytest.raises(UserError, match=r"algos=\[matd4\]: must be one of matd3, .*did you mean 'matd3'"):
        ant.main(["algos=[matd4]"])
    with pytest.raises(UserError, match="there is no run to report"):
        ant.main(["train=false", f"runs={tmp_path}", f"out={tmp_path / 'out'}"])
