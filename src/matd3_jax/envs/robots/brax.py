"""brax's robots with its fast approximate physics, their joints shared out among agents; made for quick experiments."""

import dataclasses
import functools
from typing import Any, ClassVar, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from matd3_jax.envs.environment import LIMIT, Environment, TimeStep, check_choice, check_count, check_flag
from matd3_jax.envs.robots import brax_models as models
from matd3_jax.envs.robots import names
from matd3_jax.envs.robots.partition.partition import Layout, Partition, Split, as_split, partition
from matd3_jax.envs.spaces import Box


class BraxState(NamedTuple):
    """State of one environment."""

    pipeline: Any
    """brax's physics state; `q` and `qd` in it are the generalized positions and velocities."""
    full_observation: chex.Array
    """brax's, with velocities; kept, as the humanoid's shows the last action's forces, which the physics forgets."""
    measured: chex.Array
    """[len(measures)]."""
    step: chex.Array
    """int32 scalar: env steps since the reset."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BraxRobot(Environment):
    """One of brax's robots; all agents share its reward, which is brax's own, and so are reset and health rule.

    Not gymnasium's physics, and neither its returns. `backend` says how brax simulates: `spring` (maximal coordinates
    held together by springs; quickest), `positional` (position-based dynamics), `generalized` (articulated dynamics).
    `split` says who moves which joints and `depth` what is seen of them: see `partition.partition`. An action is in
    [-1, 1] for each joint (brax scales the humanoid's to its motors).

    The full observation is brax's: generalized positions without those along the floor, and velocities (m, rad, m/s,
    rad/s; hopper's and walker2d's velocities clipped to [-10, 10]). The humanoid's continues with inertia [10] and
    velocity [6] of each of 11 links and the motors' forces [23]. No contact forces. Sizes: ant 27, half_cheetah 17,
    hopper 11, walker2d 17, humanoid 244, swimmer 8. With `velocities` False it lacks those of joints, root and links.

    An episode terminates where brax says so (half_cheetah and swimmer never do) and, with reward 0, when the physics
    blows up: an entry of the state is not finite or exceeds `base.LIMIT`. It is truncated after `episode_length` steps.

    Measures: `forward_velocity` (m/s) and the parts of the reward, `reward_forward`, `reward_survive` (where there is
    one), `reward_ctrl`.

    Raises OptionError for impossible values, and where brax is not installed.
    """

    robot: ClassVar[str]
    """Key of `mjx.graphs.GRAPHS`."""

    backend: str = "spring"
    split: Split = "halves"
    depth: int | None = None
    velocities: bool = True
    episode_length: int = 1000  # type: ignore[misc]  # a field in place of the property

    def __post_init__(self) -> None:
        check_choice("backend", self.backend, models.FACTS[self.robot].backends)
        check_count("episode_length", self.episode_length, 1)
        check_flag("velocities", self.velocities)
        object.__setattr__(self, "split", as_split(self.split))
        models.import_brax()
        self.partition  # noqa: B018  # refuses what does not fit
        models.load(self.robot, self.backend)

    @property
    def partition(self) -> Partition:
        """Who moves and sees what."""
        return _partition(self.robot, self.split, self.depth, self.velocities)

    @property
    def layout(self) -> Layout:
        """Where each quantity stands in the full observation."""
        return models.layout(self.robot, self.velocities)

    @property
    def agents(self) -> tuple[str, ...]:
        return self.partition.agents

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        return tuple(len(indices) for indices in self.partition.observations)

    @property
    def action_spaces(self) -> tuple[Box, ...]:
        return tuple(Box(len(own), -1.0, 1.0) for own in self.partition.actuators)

    @property
    def return_weights(self) -> tuple[float, ...]:
        return (1 / len(self.agents),) * len(self.agents)

    @property
    def entries_in_full_observation(self) -> tuple[tuple[int, ...], ...]:
        return self.partition.observations

    @property
    def full_observation_size(self) -> int:
        return self.layout.size

    @property
    def observation_names(self) -> tuple[tuple[str, ...], ...]:
        return names.share(self.full_observation_names, self.partition.observations)

    @property
    def full_observation_names(self) -> tuple[str, ...]:
        return names.full_observation(self.layout, self.mj_model)

    @property
    def action_names(self) -> tuple[tuple[str, ...], ...]:
        return names.share(names.actuators(self.mj_model), self.partition.actuators)

    @property
    def measures(self) -> tuple[str, ...]:
        return tuple(models.FACTS[self.robot].measures)

    @property
    def mj_model(self) -> Any:
        """`mujoco.MjModel` of the robot, for drawing; shared, not to be changed."""
        return models.mj_model(self.robot)

    @property
    def agent_bodies(self) -> tuple[tuple[int, ...], ...]:
        """Of each agent the bodies of `mj_model` that are its own."""
        return self.partition.bodies

    def qpos(self, state: BraxState) -> chex.Array:
        """Generalized positions for `mj_model`: [nq], m and rad, free joints with a quaternion (w, x, y, z)."""
        return state.pipeline.q

    def reset(self, key: chex.PRNGKey) -> tuple[BraxState, tuple[chex.Array, ...]]:
        with models.calling():
            inner = models.load(self.robot, self.backend).reset(key)
        state = _canonical(
            BraxState(
                pipeline=inner.pipeline_state,
                full_observation=inner.obs,
                measured=jnp.zeros(len(self.measures)),
                step=jnp.zeros((), jnp.int32),
            )
        )
        return state, self.observe(state)

    def step(self, key: chex.PRNGKey, state: BraxState, action: tuple[chex.Array, ...]) -> TimeStep:
        """All agents act once; nothing here is random, `key` is not used."""
        del key
        order = np.argsort(np.concatenate(self.partition.actuators))
        control = jnp.concatenate(action)[order]
        zero = jnp.zeros(())
        before = models.import_brax().State(state.pipeline, state.full_observation, reward=zero, done=zero)
        with models.calling():
            after = models.load(self.robot, self.backend).step(before, control)
        sound = jnp.isfinite(after.reward) & jnp.isfinite(after.obs).all()
        for x in (after.pipeline_state.q, after.pipeline_state.qd):
            sound &= (jnp.abs(x) < LIMIT).all()  # false for NaN too
        measured = [jnp.asarray(after.metrics[name]) for name in models.FACTS[self.robot].measures.values()]
        bounded = jnp.clip(jnp.nan_to_num(after.obs), -LIMIT, LIMIT)
        state = _canonical(
            BraxState(
                pipeline=after.pipeline_state,
                full_observation=jnp.where(sound, after.obs, bounded),
                measured=jnp.where(sound, jnp.stack(measured), 0),
                step=state.step + 1,
            )
        )
        return TimeStep(
            state=state,
            observation=self.observe(state),
            reward=jnp.full(len(self.agents), jnp.where(sound, after.reward, 0)),
            terminated=(after.done > 0) | ~sound,
            truncated=state.step >= self.episode_length,
        )

    def observe(self, state: BraxState) -> tuple[chex.Array, ...]:
        full = self.full_observation(state)
        return tuple(full[np.array(own)] for own in self.partition.observations)

    def full_observation(self, state: BraxState) -> chex.Array:
        if self.velocities:
            return state.full_observation
        return state.full_observation[np.array(models.without_velocities(self.robot))]

    def measure(self, state: BraxState) -> chex.Array:
        return state.measured


@dataclasses.dataclass(frozen=True, kw_only=True)
class BraxAnt(BraxRobot):
    """brax's ant: see `BraxRobot`."""

    robot = "ant"


@dataclasses.dataclass(frozen=True, kw_only=True)
class BraxHalfCheetah(BraxRobot):
    """brax's half-cheetah: see `BraxRobot`."""

    robot = "half_cheetah"
    split: Split = "2x3"


@dataclasses.dataclass(frozen=True, kw_only=True)
class BraxHopper(BraxRobot):
    """brax's hopper: see `BraxRobot`."""

    robot = "hopper"
    split: Split = "3x1"


@dataclasses.dataclass(frozen=True, kw_only=True)
class BraxWalker2d(BraxRobot):
    """brax's walker2d: see `BraxRobot`."""

    robot = "walker2d"
    split: Split = "2x3"


@dataclasses.dataclass(frozen=True, kw_only=True)
class BraxHumanoid(BraxRobot):
    """brax's humanoid: see `BraxRobot`."""

    robot = "humanoid"
    split: Split = "9|8"


@dataclasses.dataclass(frozen=True, kw_only=True)
class BraxSwimmer(BraxRobot):
    """brax's swimmer: see `BraxRobot`."""

    robot = "swimmer"
    backend: str = "generalized"
    split: Split = "2x1"


@functools.lru_cache(maxsize=None, typed=True)  # typed: depth True is refused though 1 is known
def _partition(robot: str, split: Split, depth: int | None, velocities: bool) -> Partition:
    return partition(robot, models.tree(robot), models.layout(robot, velocities), split, depth)


def _canonical(state: BraxState) -> BraxState:
    """`state` without weakly typed arrays: with them, the second step would be compiled again."""
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, jnp.asarray(x).dtype), state)
