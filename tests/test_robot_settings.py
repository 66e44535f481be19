"""What robots bring along: the paper's settings of its Ant experiments, and the two schedules."""

import pytest

from matd3_jax import config, devices
from matd3_jax.errors import UserError

ROBOTS = [
    f"{prefix}{name}"
    for prefix in ("", "brax_")
    for name in ("ant", "half_cheetah", "hopper", "walker2d", "humanoid", "swimmer")
]

# tau, delay, smoothing, critics, whose critic, one agent in everybody's place: Ackermann et al. 2019, on decentralised
# controllers of robots; iddpg and ddpg, not in the paper, with iltd3's and td3's settings.
ALGORITHMS = {
    "matd3": (0.01, 2, 0.2, 2, "central", False),
    "maddpg": (0.01, 1, 0.0, 1, "central", False),
    "iltd3": (0.005, 2, 0.2, 2, "own", False),
    "td3": (0.005, 2, 0.2, 2, "own", True),
    "iddpg": (0.005, 1, 0.0, 1, "own", False),
    "ddpg": (0.005, 1, 0.0, 1, "own", True),
}


@pytest.mark.parametrize("algo", ALGORITHMS)
@pytest.mark.parametrize("env", ["ant", "brax_hopper"])
def test_the_papers_settings_come_with_the_robot(env, algo):
    settings = config.load([f"env={env}", f"algo={algo}"])
    a = settings.algo
    found = (a.tau, a.policy_delay, a.target_noise, a.num_critics, a.critic, a.joint)
    assert found == ALGORITHMS[algo]
    assert (a.actor_lr, a.critic_lr, a.gamma, a.exploration_noise) == (0.001, 0.001, 0.99, 0.1)
    assert (a.hidden, a.target_noise_clip, a.clip, a.logit_regulariser) == ((400, 300), 0.5, "none", 0.0)
    assert (settings.num_envs, settings.rollout_length, settings.updates_per_collect, settings.batch_size) == (
        1,
        1,
        1,
        100,
    )
    assert (settings.total_steps, settings.learning_starts, settings.warmup) == (1_000_000, 10_000, "random")
    assert (settings.n_step, settings.normalise_observations) == (1, False)


@pytest.mark.parametrize("env", ROBOTS)
def test_every_robot_has_the_wide_schedule(env):
    for spelling in ("schedule=wide", "+schedule=wide"):
        settings = config.load([f"env={env}", spelling])
        steps = settings.num_envs * settings.rollout_length
        assert steps == 20
        # As many replayed transitions for each env step as in the paper's, in products ten times as large.
        assert settings.updates_per_collect * settings.batch_size / steps == 100
        assert settings.batch_size == 1000


def test_given_values_win_over_what_robots_and_schedules_bring():
    settings = config.load(["env=ant", "schedule=wide", "algo.tau=0.02", "algo.lr=0.003", "num_envs=40"])
    assert (settings.algo.tau, settings.algo.actor_lr, settings.num_envs, settings.batch_size) == (
        0.02,
        0.003,
        40,
        1000,
    )


def test_an_accelerator_gets_the_wide_schedule_unless_one_is_given(monkeypatch):
    assert config.load(["env=ant"]).num_envs == 1
    monkeypatch.setattr(devices, "accelerated", lambda: True)
    assert config.load(["env=ant"]).num_envs == 20
    assert config.load(["env=ant", "schedule=paper"]).num_envs == 1
    assert config.load(["env=ant", "batch_size=200"]).num_envs == 1
    assert config.load(["env=simple_spread"]).num_envs == 4


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["schedule=wide"], "schedule=wide is for robots; simple_spread has the paper's only"),
        (["env=ant", "schedule=wied"], "no schedule is called 'wied'; did you mean 'wide'?"),
        (["env=ant", "env.splt=halves"], "'split'"),
    ],
)
def test_bad_settings_are_named(overrides, message):
    with pytest.raises(UserError) as error:
        config.load(overrides)
    assert message in str(error.value)
