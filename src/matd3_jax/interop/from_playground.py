"""MuJoCo Playground's tasks as environments here: `env=playground env.id=CheetahRun env.split=halves`."""

import contextlib
import dataclasses
import functools
import importlib.util
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from matd3_jax.envs.environment import LIMIT, Environment, TimeStep, check_choice, check_count
from matd3_jax.envs.host.sources import Kwargs
from matd3_jax.envs.robots.quiet import quiet, quiet_mujoco
from matd3_jax.envs.spaces import Box
from matd3_jax.errors import OptionError, nearest, one_line
from matd3_jax.interop.foreign_states import flat, like, raw
from matd3_jax.interop.playground_layout import owners
from matd3_jax.interop.playground_split import Split, as_split, share_out
from matd3_jax.runtime.terminal import say
from matd3_jax.thread_pool import make_room_for_lapack


class PlaygroundState(NamedTuple):
    """State of one environment."""

    inner: Any
    """Playground's state: `inner.data` is the `mjx.Data`."""
    step: chex.Array
    """int32 scalar: env steps since the reset."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlaygroundTask(Environment):
    """The task that MuJoCo Playground registers as `id`, its actuators shared out among agents.

    All agents share the task's reward. `split` says who moves what: see `playground_split.share_out`. Actions are in
    [-1, 1] for each actuator, as the tasks take them. With `observation="own"` an agent sees what belongs to its own
    actuators (positions and velocities of their joints, its last action) and all that belongs to none, where the layout
    of the observation is known (`playground_layout.LAYOUTS`), and everything where it is not; with "all" everything.
    Where a task has an observation of its own for critics ("privileged_state"), that is the full observation, otherwise
    the task's observation is.

    An episode terminates where the task says so, and with reward 0 when the physics blows up (the reward or an entry of
    the observation is not finite, or exceeds `environment.LIMIT`). It is truncated after `episode_length` env steps;
    None: the task's own. An env step is as many control steps as the task's `action_repeat`.

    `impl` is what simulates: "jax" (MJX), or "warp" (MuJoCo Warp, on an NVIDIA GPU). `kwargs` are changes to the task's
    configuration, nested as it is, for instance {"noise_config": {"level": 0}}.

    Measures: the task's metrics ("reward/upright" is called `reward_upright`).

    Raises OptionError for an unknown id, split or configuration, where Playground is not installed, and where the
    robot's model, which Playground downloads when one is first used, cannot be had.
    """

    id: str | None = None
    split: Split = "halves"
    observation: str = "own"
    impl: str = "jax"
    kwargs: Mapping[str, Any] = Kwargs({})
    episode_length: int | None = None  # type: ignore[assignment,misc]  # a field in place of the property

    def __post_init__(self) -> None:
        check_choice("observation", self.observation, ("own", "all"))
        check_choice("impl", self.impl, ("jax", "warp"))
        object.__setattr__(self, "split", as_split(self.split))
        object.__setattr__(self, "kwargs", Kwargs(self.kwargs))
        length = self._loaded.episode_length if self.episode_length is None else self.episode_length
        check_count("episode_length", length, 1)
        object.__setattr__(self, "episode_length", length)
        self.actuators  # noqa: B018  # refuses what does not fit

    @property
    def _loaded(self) -> "Loaded":
        return _load(self.id, self.impl, self.kwargs)

    @property
    def wrapped(self) -> Any:
        """Playground's environment."""
        return self._loaded.env

    @property
    def actuators(self) -> tuple[tuple[int, ...], ...]:
        """Of each agent the indices of its actuators, in the order of its action."""
        return share_out(self._loaded.actuators, self.split)

    @property
    def agents(self) -> tuple[str, ...]:
        return tuple(f"agent_{i}" for i in range(len(self.actuators)))

    @property
    def seen(self) -> tuple[np.ndarray, ...]:
        """Of each agent the indices of the entries of the task's observation that it sees."""
        loaded = self._loaded
        whose = (None,) * loaded.observation_size if self.observation == "all" else loaded.owners
        if whose is None:
            whose = (None,) * loaded.observation_size
        return tuple(
            np.array([i for i, owner in enumerate(whose) if owner is None or owner in own]) for own in self.actuators
        )

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        return tuple(len(entries) for entries in self.seen)

    @property
    def action_spaces(self) -> tuple[Box, ...]:
        return tuple(Box(len(own), -1.0, 1.0) for own in self.actuators)

    @property
    def return_weights(self) -> tuple[float, ...]:
        return (1 / len(self.agents),) * len(self.agents)

    @property
    def full_observation_size(self) -> int:
        shown = self._loaded.state.obs
        full = shown.get("privileged_state", shown["state"]) if isinstance(shown, Mapping) else shown
        return int(np.prod(full.shape))

    @property
    def entries_in_full_observation(self) -> tuple[tuple[int, ...], ...] | None:
        shown = self._loaded.state.obs
        if isinstance(shown, Mapping) and "privileged_state" in shown:
            return None
        return tuple(tuple(entries.tolist()) for entries in self.seen)

    @property
    def measures(self) -> tuple[str, ...]:
        return tuple(name.replace("/", "_") for name in self._metrics)

    @property
    def costly_reset(self) -> bool:
        """Some tasks let the robot come to rest first: 200 steps of the physics in CheetahRun."""
        return True

    @property
    def mj_model(self) -> Any:
        """`mujoco.MjModel` of the robot, for drawing; shared, not to be changed."""
        return self.wrapped.mj_model

    @property
    def agent_bodies(self) -> tuple[tuple[int, ...], ...]:
        """Of each agent the bodies of `mj_model` that its actuators' joints move."""
        moved = bodies(self.mj_model)
        return tuple(tuple(sorted({moved[i] for i in own if i in moved})) for own in self.actuators)

    def qpos(self, state: PlaygroundState) -> chex.Array:
        """Generalized positions for `mj_model`: [nq], m and rad, free joints with a quaternion (w, x, y, z)."""
        return state.inner.data.qpos

    def reset(self, key: chex.PRNGKey) -> tuple[PlaygroundState, tuple[chex.Array, ...]]:
        with quiet(), jax.default_matmul_precision("highest"):
            inner = self.wrapped.reset(raw(key))
        state = PlaygroundState(like(inner, self._loaded.state), jnp.zeros((), jnp.int32))
        return state, self.observe(state)

    def step(self, key: chex.PRNGKey, state: PlaygroundState, action: tuple[chex.Array, ...]) -> TimeStep:
        """All agents act once; what is random comes from the key in the task's own state, `key` is not used."""
        del key
        order = np.argsort(np.concatenate(self.actuators))
        control = jnp.concatenate(action)[order]
        reward, done = jnp.zeros(()), jnp.zeros((), bool)
        inner = jax.tree.map(lambda leaf: leaf, state.inner)  # tasks write into the dictionaries of the state
        # TF32, a GPU's default for matrix products, is too coarse for physics.
        with quiet(), jax.default_matmul_precision("highest"):
            for _ in range(self._loaded.action_repeat):
                inner = self.wrapped.step(inner, control)
                reward, done = reward + jnp.where(done, 0, inner.reward), done | (inner.done > 0)
        sound = jnp.isfinite(reward) & (jnp.abs(flat(inner.obs)) < LIMIT).all()  # false for NaN too
        obs = jax.tree.map(lambda leaf: jnp.clip(jnp.nan_to_num(leaf), -LIMIT, LIMIT), inner.obs)
        inner = inner.replace(obs=jax.tree.map(lambda a, b: jnp.where(sound, a, b), inner.obs, obs))
        state = PlaygroundState(like(inner, self._loaded.state), state.step + 1)
        return TimeStep(
            state=state,
            observation=self.observe(state),
            reward=jnp.full(len(self.agents), jnp.where(sound, reward, 0), jnp.float32),
            terminated=done | ~sound,
            truncated=state.step >= self.episode_length,
        )

    def observe(self, state: PlaygroundState) -> tuple[chex.Array, ...]:
        shown = state.inner.obs
        whole = flat(shown["state"] if isinstance(shown, Mapping) else shown)
        return tuple(whole[entries] for entries in self.seen)

    def full_observation(self, state: PlaygroundState) -> chex.Array:
        shown = state.inner.obs
        return flat(shown.get("privileged_state", shown["state"]) if isinstance(shown, Mapping) else shown)

    def measure(self, state: PlaygroundState) -> chex.Array:
        metrics = state.inner.metrics
        return jnp.stack([metrics[name].astype(jnp.float32) for name in self._metrics]) if metrics else jnp.zeros(0)

    @property
    def _metrics(self) -> tuple[str, ...]:
        return tuple(name for name, value in sorted(self._loaded.state.metrics.items()) if value.shape == ())


class Loaded(NamedTuple):
    """A task, and what has been found out about it."""

    env: Any
    """Playground's environment."""
    state: Any
    """Shapes and types of its state."""
    actuators: tuple[str, ...]
    owners: tuple[int | None, ...] | None
    """See `playground_layout.owners`."""
    observation_size: int
    episode_length: int
    """In env steps."""
    action_repeat: int


def import_registry() -> Any:
    """The module mujoco_playground.registry. Raises OptionError where it is missing."""
    try:
        with quiet(), quiet_mujoco():
            from mujoco_playground import registry
    except ImportError as error:
        raise OptionError(
            f"env=playground needs the extra 'playground': pip install 'matd3_jax[playground]' ({error})"
        ) from error
    return registry


def bodies(mj_model: Any) -> dict[int, int]:
    """Of each actuator that moves a joint, the body that the joint moves."""
    import mujoco

    moves_joint = mj_model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    joints = mj_model.actuator_trnid[:, 0]
    return {i: int(mj_model.jnt_bodyid[joints[i]]) for i in range(mj_model.nu) if moves_joint[i]}


@functools.cache
def _load(id: str | None, impl: str, kwargs: Kwargs) -> Loaded:
    """Make a task, its arrays outside whatever is being traced: they outlive it."""
    if impl == "jax":
        make_room_for_lapack("env=playground")
    registry = import_registry()
    if id is None:
        raise OptionError("env=playground needs an id, the name of a task, for instance env.id=CheetahRun")
    if id not in registry.ALL_ENVS:
        raise OptionError(f"env.id={id}: Playground has no such task; {nearest(id, registry.ALL_ENVS)}")
    downloads = id not in registry.dm_control_suite.ALL_ENVS
    if downloads and not _menagerie().exists():
        say(f"MuJoCo Playground downloads the robots' models (mujoco_menagerie), once, into {_menagerie()}")
    changes = {"impl": impl} | dict(_flattened(kwargs))
    try:
        with quiet(), quiet_mujoco(), contextlib.redirect_stderr(io.StringIO()), jax.ensure_compile_time_eval():
            env = registry.load(id, config_overrides=changes)
        with quiet(), jax.default_matmul_precision("highest"):
            state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    except Exception as error:  # whatever the task's own code raises
        words = f"{type(error).__name__}: {one_line(error)[:300]}"
        if downloads and not _menagerie().exists():
            raise OptionError(
                f"env.id={id} needs the robots' models, which Playground could not download ({words}): git clone "
                f"https://github.com/google-deepmind/mujoco_menagerie {_menagerie()}"
            ) from error
        raise OptionError(f"env.id={id}: Playground cannot make it with {changes}: {words}") from error
    shown = state.obs["state"] if isinstance(state.obs, Mapping) and "state" in state.obs else state.obs
    if isinstance(shown, Mapping):
        raise OptionError(f"env.id={id}: its observation has no 'state' but {', '.join(shown)}: pictures are not taken")
    config = registry.get_default_config(id)
    for key, value in changes.items():
        config.update_from_flattened_dict({key: value})
    size, repeat = int(np.prod(shown.shape)), int(config.get("action_repeat", 1))
    names = tuple(env.mj_model.actuator(i).name or f"actuator_{i}" for i in range(env.action_size))
    whose = owners(id, env.mj_model, size)
    return Loaded(env, state, names, whose, size, max(1, int(config.episode_length) // repeat), repeat)


def _menagerie() -> Path:
    """Where Playground keeps the robots' models that it downloads."""
    found = importlib.util.find_spec("mujoco_playground")
    assert found is not None and found.origin is not None
    return Path(found.origin).parent / "external_deps" / "mujoco_menagerie"


def _flattened(changes: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys, as Playground takes changes."""
    for key, value in changes.items():
        if isinstance(value, Mapping):
            yield from _flattened(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value
