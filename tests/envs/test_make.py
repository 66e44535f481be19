"""Making environments by name: what is there, what is refused, and how the refusal reads."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from matd3_jax import envs
from matd3_jax.envs import Box, Discrete, MultiDiscrete, OptionError, Simplex, make, names, options


def test_names_and_options():
    assert set(names()) >= {"simple_spread", "simple_tag", "simple_crypto", "simple_push", "simple_adversary"}
    assert options("simple_tag") == {
        "rules": "orig",
        "actions": "soft",
        "episode_length": 25,
        "num_good": 1,
        "num_adversaries": 3,
        "num_obstacles": 2,
    }
    for name in [name for name in names() if "id" not in options(name)]:
        defaults = options(name)
        assert make(name) == make(name, **defaults)
        assert make(name).episode_length == defaults["episode_length"]
        assert make(name, episode_length=7) != make(name)


def test_agents():
    agents = {
        "simple_spread": ("agent_0", "agent_1", "agent_2"),
        "simple_speaker_listener": ("speaker_0", "listener_0"),
        "simple_crypto": ("eve_0", "bob_0", "alice_0"),
        "simple_push": ("adversary_0", "agent_0"),
        "simple_adversary": ("adversary_0", "agent_0", "agent_1"),
        "simple_tag": ("adversary_0", "adversary_1", "adversary_2", "agent_0"),
        "simple": ("agent_0",),
        "simple_reference": ("agent_0", "agent_1"),
        "simple_world_comm": ("leadadversary_0", "adversary_0", "adversary_1", "adversary_2", "agent_0", "agent_1"),
        "point_reach": ("agent_0", "agent_1"),
    }
    for name, expected in agents.items():
        assert make(name).agents == expected
    assert make("simple_crypto").teams == ("adversaries", "agents", "agents")
    assert make("simple_tag", num_good=2, num_adversaries=1).teams == ("adversaries", "agents", "agents")


@pytest.mark.parametrize(
    ("name", "given", "words"),
    [
        ("simple_spraed", {}, ["'simple_spraed'", "did you mean 'simple_spread'"]),
        ("chess", {}, ["'chess'", "simple_tag", "point_reach"]),
        ("simple_spread", {"num_agent": 3}, ["'num_agent'", "did you mean 'num_agents'"]),
        ("simple_push", {"zzz": 3}, ["'zzz'", "episode_length", "rules", "actions"]),
        ("simple_push", {"num_agents": 3}, ["simple_push", "'num_agents'"]),
        ("simple_push", {"rules": "mpe"}, ["rules='mpe'", "'orig'", "'mpe2'"]),
        ("simple_push", {"actions": None}, ["actions=None", "'soft'", "'discrete'", "'continuous'"]),
        ("simple_push", {"episode_length": 0}, ["episode_length=0", "at least 1"]),
        ("simple_push", {"episode_length": "25"}, ["episode_length='25'", "integer"]),
        ("simple_push", {"episode_length": True}, ["episode_length=True", "integer"]),
        ("simple_spread", {"num_agents": 0}, ["num_agents=0", "at least 1"]),
        ("simple_spread", {"num_agents": 2.0}, ["num_agents=2.0", "integer"]),
        ("simple_spread", {"local_ratio": 0.5}, ["local_ratio=0.5", "mpe2"]),
        ("simple_spread", {"local_ratio": 1.5, "rules": "mpe2"}, ["local_ratio=1.5", "between 0 and 1"]),
        ("simple_spread", {"local_ratio": "half", "rules": "mpe2"}, ["local_ratio='half'", "between 0 and 1"]),
        ("simple_spread", {"local_ratio": float("nan"), "rules": "mpe2"}, ["local_ratio=nan"]),
        ("simple_speaker_listener", {"speaking_steps": 0}, ["speaking_steps=0", "at least 1"]),
        ("simple_speaker_listener", {"speaking_steps": 2.0}, ["speaking_steps=2.0", "integer"]),
        ("simple_speaker_listener", {"speaking_steps": True}, ["speaking_steps=True", "integer"]),
        ("simple_crypto", {"speaking_steps": 2}, ["simple_crypto has no option 'speaking_steps'"]),
        ("hopper", {"velocities": "false"}, ["velocities='false'", "true or false"]),
        ("hopper", {"velocities": None}, ["velocities=None", "true or false"]),
        ("hopper", {"velocities": 0}, ["velocities=0", "true or false"]),
        ("simple_tag", {"velocities": False}, ["simple_tag has no option 'velocities'"]),
        ("simple_reference", {"local_ratio": 0.5}, ["local_ratio=0.5", "rules='mpe2'"]),
        ("simple_reference", {"local_ratio": -1, "rules": "mpe2"}, ["local_ratio=-1", "between 0 and 1"]),
        ("simple_world_comm", {"num_adversaries": 0}, ["num_adversaries=0", "at least 1"]),
        ("simple_world_comm", {"num_food": 0}, ["num_food=0", "at least 1"]),
        ("simple_world_comm", {"num_forests": -1}, ["num_forests=-1", "at least 0"]),
        ("simple_adversary", {"num_good": -1}, ["num_good=-1", "at least 1"]),
        ("simple_tag", {"num_good": 0}, ["num_good=0"]),
        ("simple_tag", {"num_adversaries": 0}, ["num_adversaries=0"]),
        ("simple_tag", {"num_obstacles": -1}, ["num_obstacles=-1", "at least 0"]),
        ("point_reach", {"dim": 0}, ["dim=0", "at least 1"]),
        ("point_reach", {"num_agents": None}, ["num_agents=None"]),
        ("point_reach", {"rules": "orig"}, ["'rules'"]),
    ],
)
def test_refusals(name, given, words):
    with pytest.raises(OptionError) as error:
        make(name, **given)
    message = str(error.value)
    assert isinstance(error.value, ValueError) and "\n" not in message
    for word in words:
        assert word in message


def test_unhashable_and_odd_values_are_refused_too():
    for value in ([], {}, ["orig"]):
        with pytest.raises(OptionError):
            make("simple_push", rules=value)


def test_importing_loads_no_task():
    code = "import sys, matd3_jax.envs; print([m for m in sys.modules if 'envs.particle' in m or 'envs.point' in m])"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert out.stdout.strip() == "[]"


def test_samples_lie_in_their_spaces():
    keys = jax.random.split(jax.random.key(0), 400)
    soft = np.asarray(jax.vmap(Simplex((2, 3)).sample)(keys))
    assert soft.shape == (400, 5) and (soft >= 0).all()
    np.testing.assert_allclose(soft[:, :2].sum(axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(soft[:, 2:].sum(axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(soft.mean(axis=0), [1 / 2] * 2 + [1 / 3] * 3, atol=0.08)
    box = np.asarray(jax.vmap(Box(2, -1.0, 3.0).sample)(keys))
    assert box.shape == (400, 2) and -1 <= box.min() < -0.9 and 2.9 < box.max() <= 3
    assert set(np.asarray(jax.vmap(Discrete(3).sample)(keys)).tolist()) == {0, 1, 2}
    several = np.asarray(jax.vmap(MultiDiscrete((2, 4)).sample)(keys))
    assert several.dtype == np.int32 and [set(c) for c in several.T.tolist()] == [{0, 1}, {0, 1, 2, 3}]
    assert MultiDiscrete((2, 4)).size == 6 and Discrete(3).size == 3
    with pytest.raises(ValueError, match="unbounded"):
        envs.Box(2).sample(keys[0])
