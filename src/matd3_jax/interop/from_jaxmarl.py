"""Environments of JaxMARL as environments here: `env=jaxmarl env.id=MPE_simple_spread_v3`, or any instance of one."""

import abc
import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from matd3_jax.envs.environment import Environment, TimeStep, check_count
from matd3_jax.envs.host.sources import Kwargs
from matd3_jax.envs.robots.quiet import quiet, quiet_mujoco
from matd3_jax.envs.spaces import ActionSpace
from matd3_jax.errors import OptionError, nearest, one_line
from matd3_jax.interop.foreign_states import flat, like, raw
from matd3_jax.interop.import_jaxmarl import import_jaxmarl
from matd3_jax.interop.jaxmarl_facts import Facts, facts
from matd3_jax.thread_pool import make_room_for_lapack

MABRAX = ("ant_4x2", "halfcheetah_6x1", "hopper_3x1", "humanoid_9|8", "walker2d_2x3")
"""Ids of JaxMARL's environments in brax, which reset by themselves unless `auto_reset=False`."""


class JaxMARLState(NamedTuple):
    """State of one environment."""

    inner: Any
    """JaxMARL's state."""
    observation: tuple[chex.Array, ...]
    """One float array [observation size of agent i] per agent; kept, as not all of JaxMARL's environments can tell it
    from their state."""
    world: chex.Array
    """[world size]: the global state that comes with the observations, or empty."""
    step: chex.Array
    """int32 scalar: env steps since the reset."""


class _JaxMARLEnvironment(Environment):
    """See `FromJaxMARL`."""

    @property
    @abc.abstractmethod
    def wrapped(self) -> Any:
        """JaxMARL's environment."""

    @property
    def _facts(self) -> Facts:
        return facts(self.wrapped)

    @property
    def agents(self) -> tuple[str, ...]:
        return self._facts.agents

    @property
    def teams(self) -> tuple[str, ...]:
        return self._facts.teams

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        return self._facts.observation_sizes

    @property
    def action_spaces(self) -> tuple[ActionSpace, ...]:
        return tuple(action.space for action in self._facts.actions)

    @property
    def return_weights(self) -> tuple[float, ...]:
        return tuple(1 / self.teams.count(team) for team in self.teams)

    @property
    def full_observation_size(self) -> int:
        return self._facts.full_observation_size

    def reset(self, key: chex.PRNGKey) -> tuple[JaxMARLState, tuple[chex.Array, ...]]:
        with quiet():
            observations, inner = self.wrapped.reset(raw(key))
        state = self._state(observations, inner, jnp.zeros((), jnp.int32))
        return state, state.observation

    def step(self, key: chex.PRNGKey, state: JaxMARLState, action: tuple[chex.Array, ...]) -> TimeStep:
        """All agents act once, by the environment's own `step_env`, which does not reset."""
        known = self._facts
        taken = {agent: one.to_jaxmarl(a) for agent, one, a in zip(known.agents, known.actions, action, strict=True)}
        # TF32, a GPU's default for matrix products, is too coarse for physics.
        with quiet(), jax.default_matmul_precision("highest"):
            observations, inner, rewards, dones, infos = self.wrapped.step_env(raw(key), state.inner, taken)
            done, step = dones["__all__"].astype(bool), state.step + 1
            late = step >= self.episode_length
            if known.truncation is not None:
                terminated = done & ~(jnp.asarray(infos[known.truncation]) > 0)
            elif known.unlimited is not None:
                ended = known.unlimited.step_env(raw(key), state.inner, taken)[3]
                terminated = ended["__all__"].astype(bool)
            else:
                terminated = done & ~late
        return TimeStep(
            state=(after := self._state(observations, inner, step)),
            observation=after.observation,
            reward=jnp.stack([jnp.asarray(rewards[agent], jnp.float32).reshape(()) for agent in known.agents]),
            terminated=terminated,
            truncated=(done & ~terminated) | late,
        )

    def observe(self, state: JaxMARLState) -> tuple[chex.Array, ...]:
        return state.observation

    def full_observation(self, state: JaxMARLState) -> chex.Array:
        """The global state that the environment has (`get_world_state`, "world_state" among its observations, MABrax's
        robot's observation), or else all observations: [full_observation_size]."""
        world = self._facts.world
        if world is not None:
            with quiet():
                return flat(world(state.inner))
        return state.world if state.world.size else jnp.concatenate(state.observation)

    def _state(self, observations: Mapping[str, chex.Array], inner: Any, step: chex.Array) -> JaxMARLState:
        seen = tuple(flat(observations[agent]) for agent in self.agents)
        kept = "world_state" in observations and self._facts.world is None
        world = flat(observations["world_state"]) if kept else jnp.zeros(0)
        return JaxMARLState(like(inner, self._facts.state), seen, world, step)


@dataclasses.dataclass(frozen=True)
class FromJaxMARL(_JaxMARLEnvironment):
    """`source`, an instance of JaxMARL's `MultiAgentEnv` (or of what has its methods), as an environment here.

    Steps are those of `step_env`, without JaxMARL's automatic reset. An episode ends for all agents at once, when the
    environment says so of "__all__": an agent that is done earlier stays until then. Observations become vectors of
    float32. Actions are Discrete, MultiDiscrete, or Box; a Box whose entries have different bounds is Box(n, -1, 1)
    here and is scaled. Masks of available actions are not passed on. The full observation is the environment's global
    state where there is one. Agents that it calls adversaries are in the team "adversaries". A team's return is the
    mean of its agents', as JaxMARL's `LogWrapper` gives them.

    JaxMARL has one `done` for termination and time limit. Here `truncated` is what its time limit alone ended. That is
    known by "truncation" or "truncated" in its infos, where they are there (MABrax); else the same environment without
    its `max_steps` is asked whether it would have ended, too (MPE's never would; JaxNav, SMAX, Overcooked); else
    whatever ends at `episode_length` or after is truncated.

    `episode_length`: env steps after which episodes are truncated; None: the environment's own time limit (MPE's
    `max_steps=25` are 26 steps, as it counts from 0).

    Raises OptionError where `source` does not have these methods or spaces, resets by itself (MABrax: make it with
    auto_reset=False), or has no time limit and is given none.
    """

    source: Any
    episode_length: int | None = None  # type: ignore[assignment,misc]  # a field in place of the property

    def __post_init__(self) -> None:
        object.__setattr__(self, "episode_length", _limit(self.source, self.episode_length))

    @property
    def wrapped(self) -> Any:
        return self.source


@dataclasses.dataclass(frozen=True, kw_only=True)
class JaxMARLTask(_JaxMARLEnvironment):
    """The environment that JaxMARL registers as `id`, made with the options `kwargs`: see `FromJaxMARL`.

    Raises OptionError for an unknown id, for options that it does not take, and where JaxMARL is not installed.
    """

    id: str | None = None
    kwargs: Mapping[str, Any] = Kwargs({})
    episode_length: int | None = None  # type: ignore[assignment,misc]  # a field in place of the property

    def __post_init__(self) -> None:
        object.__setattr__(self, "kwargs", Kwargs(self.kwargs))
        object.__setattr__(self, "episode_length", _limit(self.wrapped, self.episode_length))

    @property
    def wrapped(self) -> Any:
        return _make(self.id, self.kwargs)


@functools.cache
def _make(id: str | None, kwargs: Kwargs) -> Any:
    """The environment, its arrays made outside whatever is being traced: they outlive it."""
    if kwargs.get("backend") in ("generalized", "mjx"):  # of brax's robots
        make_room_for_lapack(f"env.kwargs.backend={kwargs['backend']}")
    jaxmarl = import_jaxmarl("env=jaxmarl")
    if id is None:
        raise OptionError("env=jaxmarl needs an id as jaxmarl.make takes it, for instance env.id=MPE_simple_spread_v3")
    known = list(jaxmarl.registered_envs)
    if id not in known:
        raise OptionError(f"env.id={id}: JaxMARL has no such environment; {nearest(id, known)}")
    given = {"auto_reset": False, **kwargs} if id in MABRAX else dict(kwargs)
    try:
        with quiet(), quiet_mujoco(), jax.ensure_compile_time_eval():
            return jaxmarl.make(id, **given)
    except Exception as error:  # whatever its constructor raises for options that it does not take
        raise OptionError(f"env.id={id}: JaxMARL cannot make it with kwargs={given}: {one_line(error)}") from error


def _limit(env: Any, given: int | None) -> int:
    """The time limit in env steps. Raises OptionError where there is none, or `given` is beyond the environment's."""
    own = facts(env).time_limit
    if given is None:
        if own is None:
            raise OptionError(f"{type(env).__name__} has no time limit: give episode_length, in env steps")
        return own
    check_count("episode_length", given, 1)
    if own is not None and given > own:
        raise OptionError(
            f"episode_length={given}: {type(env).__name__} ends episodes after {own} env steps by itself; its own "
            "option for that is max_steps or episode_length (kwargs)"
        )
    return given
