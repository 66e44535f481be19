"""How rows of the metrics table become numbers with names."""

import subprocess
import sys

import numpy as np
import pytest
import scipy.stats

from matd3_jax.tracking import messages

ROW = {
    "step": np.array([500, 500, 500]),
    "seed": np.array([4, 5, 6]),
    "updates": np.array([7, 7, 7]),
    "return_agents": np.array([1.0, 2.0, 6.0]),
    "eval_return_agents": np.array([np.nan, np.nan, np.nan]),
    "agent_0_actor_loss": np.array([np.inf, 1.0, np.nan]),
}


def test_a_seed_has_its_own_numbers_and_no_nan():
    assert messages.of_seed(ROW, 1) == {"updates": 7, "return_agents": 2, "agent_0_actor_loss": 1}
    assert messages.of_seed(ROW, 0) == {"updates": 7, "return_agents": 1, "agent_0_actor_loss": np.inf}


def test_bands_are_means_of_sound_seeds_with_their_t_interval():
    found = messages.as_bands(ROW, [True, True, True])
    low, high = scipy.stats.t.interval(0.95, 2, 3.0, scipy.stats.sem([1, 2, 6]))
    assert found["return_agents/mean"] == 3
    np.testing.assert_allclose([found["return_agents/low"], found["return_agents/high"]], [low, high], rtol=1e-9)
    assert found["updates"] == 7 and "updates/mean" not in found
    assert not any(name.startswith("eval_return_agents") for name in found)
    without = messages.as_bands(ROW, [True, True, False])
    assert without["return_agents/mean"] == 1.5 and without["return_agents/seed_6"] == 6
    alone = messages.as_bands(ROW, [False, True, False])
    assert alone["return_agents/mean"] == 2 and "return_agents/low" not in alone


def test_numbers_of_a_summary():
    found = {"seconds": 3, "diverged": {"2": 450}, "last_tenth": {"agents": (1.5, None)}, "name": "x", "ok": True}
    found["last_evaluation"] = {"return_agents": [2.0, 0.5]}
    assert messages.numbers(found) == {
        "seconds": 3, "diverged/2": 450, "last_tenth/agents/mean": 1.5,
        "last_evaluation/return_agents/mean": 2, "last_evaluation/return_agents/half_width": 0.5,
    }  # fmt: skip


def test_the_process_that_tracks_imports_no_jax():
    """It would take an accelerator's memory."""
    modules = "process, messages, backend, wandb_backend, mlflow_backend"
    code = f"import sys; from matd3_jax.tracking import {modules}; import matd3_jax.stats.intervals; print([m for m in "
    code += "('jax', 'hydra', 'matplotlib', 'wandb', 'mlflow') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"


@pytest.mark.parametrize("text", ["{", "[]", '{"runs": 3}', '{"runs": {"seed_0": "../x"}}', '{"runs": {"seed_0": 3}}'])
def test_names_from_a_damaged_file_are_not_believed(text, tmp_path):
    from matd3_jax.tracking.backend import Known

    (tmp_path / "wandb.json").write_text(text)
    assert Known(str(tmp_path), "wandb").run(0) is None
    Known(str(tmp_path), "wandb").keep(0, "abc1", project="p", entity=None)
    again = Known(str(tmp_path), "wandb")
    assert again.run(0) == "abc1" and again.text("project") == "p" and again.text("entity") is None
