"""Many copies of an environment with one agent here as gymnasium's `VectorEnv`."""

import secrets
from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from matd3_jax.envs.environment import Environment
from matd3_jax.envs.wrappers.joint_team import JointTeam
from matd3_jax.errors import UserError
from matd3_jax.interop.gymnasium_spaces import action_space, as_ours, observation_space
from matd3_jax.interop.to_pettingzoo import resolve


class VectorEnvironment(gymnasium.vector.VectorEnv):
    """`num_envs` copies of `env`, which has one agent, stepped by one compiled program through gymnasium's interface.

    `terminations` and `truncations` are the environment's own. What happens to an episode that has ended is said by
    `metadata["autoreset_mode"]`, as gymnasium defines it: NEXT_STEP (the next step is the reset, with reward 0 and the
    action unused), SAME_STEP (the observation is already the next episode's, and the last one's is in
    `infos["final_obs"]`, an object array [num_envs], marked by `infos["_final_obs"]`), DISABLED (the caller resets with
    `options={"reset_mask": mask}`).

    Copy i of `reset(seed=S)` is that of S + i; several seeds may be given, too. Without a seed a copy's episodes go on
    in the sequence that they are in. Made by `vector_env`.

    Raises UserError where `env` has several agents, or `num_envs` is no positive number.
    """

    def __init__(
        self, env: Environment, num_envs: int = 1, autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP
    ):
        if len(env.agents) != 1:
            raise UserError(
                f"{type(env).__name__} has {len(env.agents)} agents, and gymnasium's environments have one: take a "
                "robot with split='single', or joint=True for all agents as one"
            )
        if not isinstance(num_envs, int) or num_envs < 1:
            raise UserError(f"num_envs={num_envs!r}: must be a whole number of at least 1")
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError as error:
            modes = ", ".join(repr(mode.value) for mode in AutoresetMode)
            raise UserError(f"autoreset_mode={autoreset_mode!r}: must be one of {modes}") from error
        self.env, self.num_envs = env, num_envs
        self.metadata = {"autoreset_mode": self.autoreset_mode}
        self.single_observation_space = observation_space(env.observation_sizes[0])
        self.single_action_space = action_space(env.action_spaces[0])
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._keys: Any = None
        """[num_envs] from which each copy's further random numbers come."""
        self._states: Any = None
        self._observations: np.ndarray = np.zeros((num_envs, env.observation_sizes[0]), np.float32)
        self._over = np.zeros(num_envs, bool)
        self._resets, self._steps = jax.jit(self._reset_where), jax.jit(jax.vmap(self._step_one))

    def reset(  # type: ignore[override]
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """(observations [num_envs, size], infos) of new episodes, of all copies or those of `options["reset_mask"]`.

        Raises UserError for a mask or seeds that do not fit, and for a mask before the first reset.
        """
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise UserError(f"reset_mask must be {self.num_envs} booleans, of which one is true")
        if self._keys is None and not mask.all():
            raise UserError("reset_mask: call reset without it first")
        self._seed(seed, mask)
        self._start(mask)
        return self._observations.copy(), {}

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """(observations [num_envs, size], rewards, terminations, truncations [num_envs], infos).

        Raises UserError before the first reset, for actions of another shape, and, without autoreset, where an episode
        is over.
        """
        if self._states is None:
            raise UserError("step: call reset first")
        taken = as_ours(self.env.action_spaces[0], actions)
        if taken.shape != self.action_space.shape:
            raise UserError(
                f"step: actions have the shape {list(taken.shape)}; must be {list(self.action_space.shape or ())}"
            )
        over = self._over
        if self.autoreset_mode == AutoresetMode.DISABLED and over.any():
            raise UserError(f"step: copies {np.flatnonzero(over).tolist()} have ended; reset them (reset_mask)")
        self._keys, self._states, *shown = self._steps(self._keys, self._states, taken)
        observations, rewards, terminations, truncations = map(np.array, jax.device_get(shown))
        self._observations = observations
        infos: dict[str, Any] = {}
        if self.autoreset_mode == AutoresetMode.NEXT_STEP and over.any():
            rewards[over], terminations[over], truncations[over] = 0, False, False
            self._start(over)
        self._over = terminations | truncations
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self._over.any():
            last = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(self._over):
                last[i] = observations[i].copy()
            infos = {"final_obs": last, "_final_obs": self._over.copy()}
            infos |= {"final_info": {}, "_final_info": self._over.copy()}
            self._start(self._over.copy())
        return self._observations.copy(), rewards, terminations, truncations, infos

    def _seed(self, seed: int | Sequence[int | None] | None, mask: np.ndarray) -> None:
        given = [seed] * self.num_envs if seed is None else seed
        if isinstance(given, int | np.integer):
            given = [int(given) + i for i in range(self.num_envs)]
        if len(given) != self.num_envs:
            raise UserError(f"reset: {len(given)} seeds for {self.num_envs} environments")
        fresh = [secrets.randbits(31) if one is None else one for one in given]
        keys = jax.vmap(jax.random.key)(np.array(fresh, np.uint32))
        new = mask & (np.array([one is not None for one in given]) | (self._keys is None))
        self._keys = keys if self._keys is None else jnp.where(jnp.asarray(new), keys, self._keys)

    def _start(self, mask: np.ndarray) -> None:
        """Reset the copies of `mask`."""
        states = self._states
        if states is None:
            shapes = jax.eval_shape(jax.vmap(self.env.reset), self._keys)[0]
            states = jax.tree.map(lambda shape: jnp.zeros(shape.shape, shape.dtype), shapes)
        self._keys, self._states, observations = self._resets(self._keys, states, self._observations, mask)
        self._observations = np.array(observations, np.float32)
        self._over = self._over & ~mask

    def _reset_where(self, keys: Any, states: Any, observations: Any, mask: Any) -> Any:
        def one(key: Any, state: Any, observation: Any, chosen: Any) -> Any:
            next_key, now = jax.random.split(key)
            new_state, (new_observation,) = self.env.reset(now)
            new, old = (next_key, new_state, new_observation), (key, state, observation)
            return jax.tree.map(lambda a, b: jnp.where(chosen, a, b), new, old)

        return jax.vmap(one)(keys, states, observations, mask)

    def _step_one(self, key: Any, state: Any, action: Any) -> Any:
        key, now = jax.random.split(key)
        ts = self.env.step(now, state, (action,))
        return key, ts.state, ts.observation[0], ts.reward[0], ts.terminated, ts.truncated


def vector_env(
    env: str | Environment,
    num_envs: int = 1,
    autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    joint: bool = False,
    **options: Any,
) -> VectorEnvironment:
    """Make a gymnasium `VectorEnv` of an environment with one agent: see `VectorEnvironment`.

    Args:
        env: its name, as `env=` takes it, or an instance.
        joint: see all its agents as one (`JointTeam`).
        options: of the environment that `env` names.

    Raises UserError as `VectorEnvironment` does, OptionError for an unknown name or option, or agents that cannot be
    joined.

    Example:
        >>> copies = vector_env("simple_spread", num_envs=3, joint=True, actions="continuous")
        >>> observations, infos = copies.reset(seed=0)
        >>> observations.shape, copies.single_action_space.shape
        ((3, 54), (6,))
    """
    found = resolve(env, options)
    if joint:
        found = JointTeam(found, tuple(dict.fromkeys(found.teams)))
    return VectorEnvironment(found, num_envs, autoreset_mode)
