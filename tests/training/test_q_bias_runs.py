"""Overestimation in a run: its columns, figure and summary, resuming, and its settings."""

import csv
import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pictures
import pytest
from checkpoint_arrays import assert_same_run, back_to

from matd3_jax import config
from matd3_jax.cli import train
from matd3_jax.errors import UserError
from matd3_jax.figures.style import AGENT
from matd3_jax.runs import overestimation
from matd3_jax.training import checkpoint

SETTINGS = [
    "env=point_reach", "algo=iltd3", "seeds=2", "algo.hidden=[8]", "batch_size=16", "learning_starts=100",
    "total_steps=900", "log_every=100", "replay_capacity=500", "checkpoint_every=200", "keep_checkpoints=9",
    "eval_every=400", "eval_episodes=2", "normalize_observations=true",
    "diagnostics.q_bias=true", "diagnostics.q_bias_rollouts=7", "diagnostics.q_bias_steps=5",
]  # fmt: skip


def table(path):
    with (path / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs")
    assert train.main([*SETTINGS, f"out={out}", "name=full"]) == 0
    return out / "full"


@pytest.mark.slow
def test_a_run_reports_it(finished, capsys):
    """Columns at evaluations and nan between them, and before anything was collected; the figure, and the summary."""
    rows = table(finished)
    evaluated = np.array([row["eval_return_agents"] != "nan" for row in rows])
    there = evaluated & (np.array([row["step"] for row in rows]) != "0")
    assert there.sum() + 2 == evaluated.sum() < len(rows)
    for agent in ("agent_0", "agent_1"):
        for name in overestimation.COLUMNS:
            values = np.array([float(row[f"{agent}_{name}"]) for row in rows])
            np.testing.assert_array_equal(np.isfinite(values), there)
        for row in rows:
            over = float(row[f"{agent}_q_estimate"]) - float(row[f"{agent}_q_true"])
            np.testing.assert_allclose(float(row[f"{agent}_overestimation"]), over, rtol=1e-5, atol=1e-6)
            assert not float(row[f"{agent}_q_true"]) > 0  # its rewards are negative
    assert {f"#{r:02X}{g:02X}{b:02X}" for r, g, b in AGENT[:2]} <= pictures.colors(finished / "q_bias.png")
    summary = json.loads((finished / "summary.json").read_text())["overestimation"]
    last = [float(row["agent_1_overestimation"]) for row in rows[-2:]]
    want = np.mean(last), 12.706 * np.std(last, ddof=1) / np.sqrt(2)  # Student's t of one degree of freedom
    np.testing.assert_allclose(summary["agent_1"]["overestimation"], want, rtol=1e-4)
    every = [[float(r["agent_1_overestimation"]) for r in rows if r["seed"] == s] for s in "01"]
    np.testing.assert_allclose(summary["agent_1"]["overestimation_mean"][0], np.nanmean(every), rtol=1e-6)


@pytest.mark.slow
def test_stopped_between_evaluations_and_resumed(finished, tmp_path):
    """From a checkpoint half way to an evaluation, whose reservoir already holds what came before: the same table."""
    copy = Path(shutil.copytree(finished, tmp_path / "copy"))
    rows = table(copy)
    evaluated = {int(row["step"]) for row in rows if row["eval_return_agents"] != "nan"}
    steps = checkpoint.steps(copy / "checkpoints")
    between = next(step for step in steps if step not in evaluated)
    back_to(copy, between)
    assert train.main([f"resume={copy}"]) == 0
    assert_same_run(copy, finished)


# ---- settings --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("overrides", "words"), [
    (["diagnostics.q_bias_rollouts=0"], "diagnostics.q_bias_rollouts=0: must be at least 1"),
    (["diagnostics.q_bias_steps=0"], "diagnostics.q_bias_steps=0: must be at least 1"),
    (["diagnostics.q_bias=2"], "diagnostics.q_bias=2: must be true or false"),
    (["diagnostics=true"], "diagnostics=True: must be a group of keys"),
    (["diagnostics.q_bais=true"], "did you mean 'q_bias"),
    (["q_bias=true"], "did you mean 'diagnostics.q_bias'"),
    (["diagnostics.q_bias=true", "eval_every=0"], "eval_every=0 means none"),
])  # fmt: skip
def test_mistakes(overrides, words):
    with pytest.raises(UserError) as error:
        config.load(overrides)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_runs_from_before(tmp_path):
    """Without the group, or with a part of it, a run's settings mean what they meant: off."""
    old = config.load()
    assert old.diagnostics == config.DiagnosticsConfig(q_bias=False, q_bias_rollouts=200, q_bias_steps=100)
    on = dataclasses.replace(old, diagnostics=dataclasses.replace(old.diagnostics, q_bias=True))
    for settings, kept in ((old, None), (old, {}), (on, {"q_bias": True})):
        values = {key: value for key, value in settings.to_dict().items() if key != "diagnostics"}
        values |= {} if kept is None else {"diagnostics": kept}
        (tmp_path / "config.yaml").write_text(json.dumps(values))  # JSON is YAML
        assert config.read(tmp_path / "config.yaml") == settings
