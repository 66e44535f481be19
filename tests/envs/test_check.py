"""What breaks the contract of an environment is named in one line, before anything is compiled."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

import matd3_jax
from matd3_jax import envs
from matd3_jax.envs import Box, Discrete, Environment, MultiDiscrete, Simplex, TimeStep
from matd3_jax.errors import UserError


@dataclasses.dataclass(frozen=True)
class Meet(Environment):
    """Two agents on a line."""

    episode_length: int = 20
    agents = ("left", "right")
    observation_sizes = (2, 2)
    action_spaces = (Box(1, -1.0, 1.0), Box(1, -1.0, 1.0))

    def reset(self, key):
        state = (jax.random.uniform(key, (2,), minval=-1.0), jnp.int32(0))
        return state, self.observe(state)

    def observe(self, state):
        return state[0], state[0][::-1]

    def step(self, key, state, action):
        state = (state[0] + 0.1 * jnp.concatenate(action), state[1] + 1)
        return TimeStep(state, self.observe(state), jnp.zeros(2), jnp.bool_(False), state[1] >= 20)


def altered(**attributes):
    """Meet with other class attributes."""
    return dataclasses.dataclass(frozen=True)(type("Meet", (Meet,), attributes))()


def stepping(**fields):
    """Meet whose step gives other fields; a function of the right one gives the wrong one."""

    def step(self, key, state, action):
        right = Meet.step(self, key, state, action)
        return right._replace(**{name: f(getattr(right, name)) for name, f in fields.items()})

    return altered(step=step)


def resetting(f):
    return altered(reset=lambda self, key: f(*Meet.reset(self, key)))


BROKEN = {
    # What is declared.
    "no agents": (altered(agents=()), "agents is ()"),
    "names twice": (altered(agents=("a", "a")), "names must differ"),
    "teams": (altered(teams=("agents",)), "teams has 1 entries; must be a tuple with one for each of the 2 agents"),
    "team": (altered(teams=("agents", "goalkeepers")), "the team of 'right' is 'goalkeepers'"),
    "sizes": (altered(observation_sizes=[2, 2]), "observation_sizes has a list"),
    "size": (altered(observation_sizes=(2, 0)), "the observation size of 'right' is 0"),
    "unbounded": (altered(action_spaces=(Box(1, -1.0, 1.0), Box(1))), "'right' is Box(size=1, low=-inf, high=inf)"),
    "half bounded": (altered(action_spaces=(Box(1, 0.0), Box(1, -1.0, 1.0))), "must be finite"),
    "nan": (altered(action_spaces=(Box(1, float("nan"), 1.0),) * 2), "must be finite"),
    "upside down": (altered(action_spaces=(Box(1, 1.0, -1.0),) * 2), "low must be below high"),
    "no room": (altered(action_spaces=(Box(1, 1.0, 1.0),) * 2), "low must be below high"),
    "bounds by entry": (altered(action_spaces=(Box(2, (-1.0, 0.0), (1.0, 1.0)),) * 2), "the same for all entries"),
    "empty box": (altered(action_spaces=(Box(0, -1.0, 1.0),) * 2), "at least 1"),
    "one choice": (altered(action_spaces=(Discrete(1),) * 2), "at least 2"),
    "no choices": (altered(action_spaces=(Simplex(()),) * 2), "sizes must be a tuple"),
    "a number": (altered(action_spaces=(2, 2)), "must be a matd3_jax.envs Box"),
    "length": (Meet(2.5), "episode_length is 2.5"),
    "weights": (altered(return_weights=(1.0,)), "return_weights has 1 entries"),
    "unhashable": (altered(__hash__=None), "not hashable"),
    # What reset and step give.
    "reset": (resetting(lambda state, seen: (state, *seen)), "must return (state, observations)"),
    "three observations": (
        resetting(lambda state, seen: (state, (*seen, seen[0]))),
        "the observations of reset are a tuple of 3",
    ),
    "list": (resetting(lambda state, seen: (state, list(seen))), "must be a tuple of 2 arrays"),
    "dictionary": (
        resetting(lambda state, seen: (state, {"left": seen[0]})),
        "the observations of reset are a dictionary with the keys 'left'; must be a tuple of 2 arrays",
    ),
    "3 entries": (
        resetting(lambda state, seen: (state, (seen[0], jnp.zeros(3)))),
        "the observation of 'right' in reset is float32[3]; must be a float array [2] (observation_sizes says 2)",
    ),
    "integers": (
        resetting(lambda state, seen: (state, (seen[0], jnp.zeros(2, jnp.int32)))),
        "the observation of 'right' in reset is int32[2]",
    ),
    "later observation": (
        stepping(observation=lambda seen: (seen[0], seen[1][:1])),
        "the observation of 'right' in step is float32[1]",
    ),
    "reward of a tuple": (stepping(reward=lambda r: (r[0], r[1])), "the reward of step is a tuple of 2 (float32[]"),
    "one reward": (stepping(reward=lambda r: r.sum()), "float32[]; must be a float array [2] (one number for each"),
    "a done for each": (stepping(terminated=lambda t: jnp.stack([t, t])), "terminated of step is bool[2]"),
    "float done": (stepping(truncated=lambda t: t.astype(jnp.float32)), "truncated of step is float32[]"),
    "state's shape": (stepping(state=lambda s: (s[0][:1], s[1])), "the state's [0] as float32[1]; reset as float32[2]"),
    "state's type": (stepping(state=lambda s: (s[0], s[1] * 1.0)), "the state's [1] as float32[]; reset as int32[]"),
    "state's structure": (stepping(state=lambda s: [*s]), "another structure than reset"),
    "plain tuple": (altered(step=lambda self, key, state, action: Meet.reset(self, key)), "must return TimeStep("),
    "branches": (
        altered(step=lambda self, key, state, action: 1 / 0 if state[1] > 3 else None),
        "step cannot be traced by JAX: TracerBoolConversionError",
    ),
    "measures": (altered(measures=("speed",), measure=lambda self, state: jnp.zeros(2)), "measure is float32[2]"),
    "full": (altered(full_observation_size=3), "full_observation is float32[4]; must be a float array [3]"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_broken_is_named_in_one_line(name):
    env, words = BROKEN[name]
    with pytest.raises(UserError) as error:
        envs.check(env)
    assert words in str(error.value) and "\n" not in str(error.value)
    assert str(error.value).startswith("Meet: ")


def test_training_checks_the_users_environment_first():
    for name in ("unbounded", "one reward", "3 entries"):
        env, words = BROKEN[name]
        with pytest.raises(UserError, match="Meet: ") as error:
            matd3_jax.train(env=env, total_steps=1000, learning_starts=100, batch_size=16)
        assert words in str(error.value)
    with pytest.raises(UserError, match="is no environment"):
        matd3_jax.train(env=Meet)  # the class


@pytest.mark.parametrize(
    "name", [name for name in envs.names() if "brax" not in name and "id" not in envs.options(name)]
)
def test_ours_keep_the_contract(name):
    envs.check(envs.make(name))


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_ours_keep_it_with_other_actions(actions):
    for name in ("simple_reference", "simple_world_comm"):
        envs.check(envs.make(name, actions=actions))


def test_hard_choices_are_traced_as_whole_numbers():
    """As the rollout passes them: int32, a scalar or a vector."""
    seen = {}

    def step(self, key, state, action):
        seen["actions"] = [(a.shape, a.dtype) for a in action]
        return Meet.step(self, key, state, (jnp.zeros(1), jnp.zeros(1)))

    envs.check(altered(action_spaces=(Discrete(3), MultiDiscrete((2, 2))), step=step))
    assert seen["actions"] == [((), jnp.int32), ((2,), jnp.int32)]
