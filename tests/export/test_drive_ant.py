"""The example that drives gymnasium's Ant: its episode is the one that our own physics in C plays."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from matd3_jax import config
from matd3_jax.evaluation import trajectory
from matd3_jax.export import export
from matd3_jax.training.saved_policies import SavedPolicies
from matd3_jax.training.session import TrainingSession

EXAMPLE = Path(__file__).parents[2] / "examples" / "drive_ant.py"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("drive_ant", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize(
    "lines", [["env.split=halves"], ["algo=td3", "env.split=2x4"], ["env.velocities=false"]], ids=str
)
def test_an_episode_has_the_return_of_our_own_evaluation(example, lines, tmp_path):
    """From the same start: the first 20 env steps to 1e-3 by themselves, all to 1e-4 on our episode's states.

    Our state is kept in float32 between env steps, and so is gymnasium's here; what is left apart are sums in another
    order, 1e-8 m after the first step. Contacts make that half as large again with every step: after 100 steps two
    episodes are two different ones, so that gymnasium's robot is put back on our states, from which it is 1e-5 m away.
    When it falls, if it does within 100 env steps, depends on the processor for the same reason.
    """
    small = ["seeds=1", "algo.hidden=[16,16]", "env.episode_length=100", "env.physics=c", "total_steps=20000"]
    training = TrainingSession(config.load(["env=ant", "normalize_observations=true", *lines, *small]))
    state = training.trainer.init(training.keys())
    state = state._replace(statistics=state.statistics._replace(variance=0.25 + 0 * state.statistics.variance))
    saved = SavedPolicies(state, np.array([0]), np.array([True]), {})
    export(training, saved, 0, "numpy", tmp_path / "policies")
    policies, facts = example.load(tmp_path / "policies")
    played = trajectory.play(training, state, keep=lambda robot: (robot.qpos, robot.qvel, robot.qacc_warmstart))
    states, returns = [np.asarray(part, np.float64) for part in played.states], played.returns["agents"]
    assert played.length > 50
    env, start, after = example.make(), (states[0][0], states[1][0]), []

    def rounded(data):
        for part in (data.qpos, data.qvel, data.qacc_warmstart):
            part[:] = part.astype(np.float32)

    def put_back(data):
        after.append(np.abs(data.qpos - states[0][len(after) + 1]).max())
        for part, ours in zip((data.qpos, data.qvel, data.qacc_warmstart), states, strict=True):
            part[:] = ours[len(after)]

    alone = {**facts, "environment": {**facts["environment"], "episode_length": 20}}
    found = example.episode(env, policies, alone, seed=0, start=start, after_step=rounded)
    assert found == pytest.approx(returns[20], rel=1e-3)
    found = example.episode(env, policies, facts, seed=0, start=start, after_step=put_back)
    assert found == pytest.approx(returns[-1], rel=1e-4) and max(after) < 1e-5
    assert len(after) >= played.length - 1  # not after a fall


@pytest.mark.slow
def test_the_program_prints_a_mean(example, tmp_path, capsys):
    training = TrainingSession(config.load(["env=ant", "seeds=1", "algo.hidden=[4]", "env.episode_length=20"]))
    saved = SavedPolicies(training.trainer.init(training.keys()), np.array([0]), np.array([True]), {})
    export(training, saved, 0, "numpy", tmp_path / "policies")
    example.main(str(tmp_path / "policies"), 2)
    assert capsys.readouterr().out.startswith("return of 2 episodes: ")
    facts = json.loads((tmp_path / "policies" / "policies.json").read_text())
    names = facts["agents"][0]["observation"]["entries"]
    assert names[0] == "root: position z (m)" and any("external torque x (N m)" in name for name in names)
    assert facts["robot"]["controls"][0] == "actuator hip_4 (150 N m at 1)"
