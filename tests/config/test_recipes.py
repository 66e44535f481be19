"""Recipes: which settings robots have, and that the paper's are the paper's."""

import dataclasses

import jax
import pytest

from matd3_jax import config
from matd3_jax.errors import UserError

ROBOTS = [
    f"{prefix}{name}"
    for prefix in ("", "brax_")
    for name in ("ant", "half_cheetah", "hopper", "walker2d", "humanoid", "swimmer")
]

# tau, delay, smoothing, critics, whose critic, one agent in everybody's place: Ackermann et al. 2019, on decentralized
# controllers of robots; iddpg and ddpg, not in the paper, with iltd3's and td3's settings, m3ddpg, m3matd3 and hybrid
# with maddpg's and matd3's.
ALGORITHMS = {
    "matd3": (0.01, 2, 0.2, 2, "central", False),
    "maddpg": (0.01, 1, 0.0, 1, "central", False),
    "iltd3": (0.005, 2, 0.2, 2, "own", False),
    "td3": (0.005, 2, 0.2, 2, "own", True),
    "iddpg": (0.005, 1, 0.0, 1, "own", False),
    "ddpg": (0.005, 1, 0.0, 1, "own", True),
    "m3ddpg": (0.01, 1, 0.0, 1, "central", False),
    "m3matd3": (0.01, 2, 0.2, 2, "central", False),
    "hybrid": (0.01, 2, 0.2, 2, "central", True),
}


@pytest.mark.parametrize("algo", ALGORITHMS)
@pytest.mark.parametrize("env", ["ant", "brax_hopper"])
def test_the_papers_recipe_is_the_papers(env, algo):
    settings = config.load([f"env={env}", f"algo={algo}", "recipe=paper"])
    a = settings.algo
    found = (a.tau, a.policy_delay, a.target_noise, a.num_critics, a.critic, a.joint)
    assert found == ALGORITHMS[algo]
    assert (a.actor_lr, a.critic_lr, a.gamma, a.exploration_noise) == (0.001, 0.001, 0.99, 0.1)
    assert (a.hidden, a.target_noise_clip, a.clip, a.logit_regularizer) == ((400, 300), 0.5, "none", 0.0)
    assert (a.actor_output, a.actor_average, a.reward_scale) == ("sigmoid", 0.0, 1.0)
    schedule = (settings.num_envs, settings.rollout_length, settings.updates_per_collect, settings.batch_size)
    assert schedule == (1, 1, 1, 100)
    assert (settings.total_steps, settings.learning_starts, settings.warmup) == (1_000_000, 10_000, "random")
    assert (settings.n_step, settings.normalize_observations, settings.shared_minibatch) == (1, False, False)
    assert settings.recipe == "paper"


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_algorithms_stay_what_they_are_in_the_fast_recipe(algo):
    """One recipe for all: critics, delay, smoothing and the step of the others distinguish the algorithms, and nothing
    else does."""
    mine, base = (config.load(["env=ant", f"algo={name}"]) for name in (algo, "matd3"))
    assert mine.recipe == "fast"
    a = mine.algo
    found = (a.policy_delay, a.target_noise, a.num_critics, a.critic, a.joint)
    assert found == ALGORITHMS[algo][1:]
    own = {"name", "policy_delay", "target_noise", "num_critics", "critic", "joint"}
    own |= {"adversarial_step", "adversarial_step_team", "hands_over"}
    differing = {k for k, v in dataclasses.asdict(a).items() if v != getattr(base.algo, k)}
    assert differing <= own
    assert dataclasses.replace(mine, algo=base.algo) == base


@pytest.mark.parametrize("env", ROBOTS)
def test_every_robot_has_every_recipe_and_the_fast_one_by_default(env):
    found = {recipe: config.load([f"env={env}", f"recipe={recipe}"]) for recipe in config.known_names("recipe")}
    assert set(found) == {"fast", "paper", "wide"}
    assert config.load([f"env={env}"]) == found["fast"]
    assert config.load([f"env={env}", "+recipe=wide"]) == found["wide"]
    for name, settings in found.items():
        assert settings.recipe == name


def test_the_wide_recipe_replays_as_much_as_the_fast_one():
    """As many replayed transitions for each env step, from a thousand environments or more; actors averaged over as
    many env steps."""
    fast, wide = (config.load(["env=ant", f"recipe={name}"]) for name in ("fast", "wide"))

    def replayed(settings):
        return settings.updates_per_collect * settings.batch_size / (settings.num_envs * settings.rollout_length)

    def averaged(settings):
        steps_of_a_move = settings.num_envs * settings.algo.policy_delay / settings.updates_per_collect
        return steps_of_a_move / settings.algo.actor_average

    assert replayed(wide) == replayed(fast)
    assert averaged(wide) == averaged(fast) == 8000
    assert wide.num_envs >= 1024
    assert dataclasses.replace(wide.algo, actor_average=fast.algo.actor_average) == fast.algo


def test_given_values_win_over_the_recipe():
    settings = config.load(["env=ant", "recipe=paper", "algo.tau=0.02", "algo.lr=0.003", "num_envs=40"])
    found = (settings.algo.tau, settings.algo.actor_lr, settings.num_envs, settings.batch_size)
    assert found == (0.02, 0.003, 40, 100)
    assert config.load(["algo.tau=0.02", "env=ant"]).algo.tau == 0.02


def test_an_accelerator_changes_the_engine_and_no_setting_of_learning(monkeypatch):
    here = config.load(["env=ant"])
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    there = config.load(["env=ant"])
    assert (here.env["physics"], there.env["physics"]) == ("c", "mjx")
    assert dataclasses.replace(there, env=here.env) == here


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["recipe=wide"], "recipe=wide is for robots; simple_spread has the paper's settings only"),
        (["env=ant", "schedule=wide"], "a robot's recipe has it"),
        (["env=ant", "recipe=wied"], "no recipe is called 'wied'; did you mean 'wide'?"),
        (["env=ant", "algo.exploration_noise=[0.3]"], "must be a number, or a range [low,high]"),
        (["env=ant", "algo.exploration_noise=[0.3,0.1]"], "must not end below its start"),
        (["env=ant", "algo.exploration_noise=[-0.1,0.1]"], "must not be negative"),
        (["env=ant", "algo.reward_scale=0"], "algo.reward_scale=0.0: must be positive"),
        (["env=ant", "algo.actor_average=2"], "algo.actor_average=2.0: must lie between 0 and 1"),
        (["env=ant", "algo.actor_output=relu"], "algo.actor_output='relu': must be one of sigmoid, tanh"),
        (["env=ant", "normalize_least_deviation=0.1"], "goes with normalize_observations=true"),
        (["env=ant", "env.splt=halves"], "'split'"),
    ],
)
def test_bad_settings_are_named(overrides, message):
    with pytest.raises(UserError) as error:
        config.load(overrides)
    assert message in str(error.value)
