"""What all robots share: the engine, the split among agents, resets, the time limit, and broken states."""

import abc
import dataclasses
from functools import cached_property
from typing import ClassVar, NamedTuple

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from matd3_jax.envs.environment import LIMIT, Environment, TimeStep, check_count, check_flag
from matd3_jax.envs.robots import names
from matd3_jax.envs.robots.engines import engine
from matd3_jax.envs.robots.engines.engine import Engine, Physical
from matd3_jax.envs.robots.partition.partition import Layout, Partition, Split, as_split, describe, partition
from matd3_jax.envs.spaces import Box

TERMS = ("forward", "survive", "ctrl", "contact")
"""Parts of the rewards."""


class RobotState(NamedTuple):
    """One robot between two env steps."""

    qpos: chex.Array
    """[nq] generalized positions: m, unit quaternion (w, x, y, z), rad."""
    qvel: chex.Array
    """[nv] generalized velocities."""
    qacc_warmstart: chex.Array
    """[nv] where the solver starts."""
    sensed: tuple[chex.Array, ...]
    """What the observation needs beyond positions and velocities."""
    progress: chex.Array
    """m along x: what the forward reward is the speed of."""
    terms: chex.Array
    """[4] parts of the last reward (`TERMS`)."""
    step: chex.Array
    """int32 scalar: env steps since the reset."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Robot(Environment):
    """A robot of gymnasium's, its joints shared out among agents that all get the same reward.

    Options: `physics`, the engine (`engine.resolve`): "c" (C MuJoCo on the host), "mjx" (MJX, within float32's rounding
    of C), "mjx_fast" (MJX with brax's settings), or "auto", which the instance resolves; `split` and `depth`
    (`partition.partition`), `episode_length` in env steps. Actions are controls in the model's range. A state that
    blows up (an entry not finite or beyond `base.LIMIT`) terminates the episode with reward 0.

    `velocities`: whether velocities are observed: those of joints and root (qvel), and of bodies (cvel, the humanoid
    alone). Without them the full observation lacks these entries and is as much shorter. What else is observed stays:
    positions, inertias, forces of actuators (the humanoid's motors: the last action times constants), and external
    forces, the contacts'. Rewards, terminations and physics are the same.

    `measures`, means over env steps: forward_velocity (m/s), and the parts of the reward (reward_forward,
    reward_survive, reward_ctrl, reward_contact).

    Raises OptionError for impossible options.
    """

    physics: str = "auto"
    split: Split = "single"
    depth: int | None = None
    velocities: bool = True
    episode_length: int = 1000  # type: ignore[misc]  # a field in place of the property

    robot: ClassVar[str]
    """Name in `graphs.GRAPHS`."""
    file: ClassVar[str]
    """gymnasium's model file."""
    frame_skip: ClassVar[int]
    """Simulation steps of one env step."""
    forward_weight: ClassVar[float] = 1.0
    reads: ClassVar[tuple[str, ...]] = ()
    """Fields of MuJoCo's data that `sense` and `progress` need."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "physics", engine.resolve(self.physics))
        check_count("episode_length", self.episode_length, 1)
        check_flag("velocities", self.velocities)
        object.__setattr__(self, "split", as_split(self.split))
        self.partition  # noqa: B018  # raises for impossible splits

    # ---- what a robot's own class says -------------------------------------------------------------------------------

    @property
    @abc.abstractmethod
    def layout(self) -> Layout:
        """Where each quantity stands in the full observation."""

    @abc.abstractmethod
    def noise(self, key: chex.PRNGKey) -> tuple[chex.Array, chex.Array]:
        """What a reset adds to the model's initial positions and velocities: [nq], [nv]."""

    @abc.abstractmethod
    def healthy(self, qpos: chex.Array, qvel: chex.Array) -> chex.Array:
        """Boolean scalar: the episode continues."""

    @abc.abstractmethod
    def rewards(self, speed: chex.Array, control: chex.Array, sensed: tuple, healthy: chex.Array) -> tuple:
        """The parts of the reward (`TERMS`), of the speed along x (m/s) and the controls [nu]."""

    def sense(self, physical: Physical) -> tuple[chex.Array, ...]:
        """`RobotState.sensed` after an env step."""
        return ()

    def start(self, qpos: chex.Array, qvel: chex.Array) -> tuple[tuple[chex.Array, ...], chex.Array]:
        """`RobotState.sensed` and `progress` at a reset."""
        return (), qpos[0]

    def progress(self, physical: Physical) -> chex.Array:
        """`RobotState.progress` after an env step."""
        return physical.qpos[0]

    # ---- the contract ------------------------------------------------------------------------------------------------

    @property
    def agents(self) -> tuple[str, ...]:
        return self.partition.agents

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        return tuple(map(len, self.partition.observations))

    @property
    def action_spaces(self) -> tuple[Box, ...]:
        low, high = self.mj_model.actuator_ctrlrange[0]
        return tuple(Box(len(own), float(low), float(high)) for own in self.partition.actuators)

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
        return ("forward_velocity", *(f"reward_{term}" for term in TERMS))

    def reset(self, key: chex.PRNGKey) -> tuple[RobotState, tuple[chex.Array, ...]]:
        qpos_noise, qvel_noise = self.noise(key)
        state = self.state(jnp.asarray(self.mj_model.qpos0, jnp.float32) + qpos_noise, qvel_noise)
        return state, self.observe(state)

    def state(self, qpos: chex.Array, qvel: chex.Array) -> RobotState:
        """The start of an episode at positions [nq] and velocities [nv]; quaternions are normalized."""
        if self.mj_model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
            qpos = qpos.at[3:7].divide(jnp.linalg.norm(qpos[3:7]))
        sensed, progress = self.start(qpos, qvel)
        return RobotState(
            qpos, qvel, jnp.zeros_like(qvel), sensed, progress, jnp.zeros(len(TERMS), qpos.dtype), jnp.int32(0)
        )

    def step(self, key: chex.PRNGKey, state: RobotState, action: tuple[chex.Array, ...]) -> TimeStep:
        """All agents act once; nothing here is random, `key` is not used."""
        del key
        control = self.control(action)
        physical = self._engine.advance(
            state.qpos, state.qvel, state.qacc_warmstart, control, self.frame_skip, self.reads
        )
        qpos, qvel = physical.qpos, physical.qvel
        sound = (jnp.abs(qpos) < LIMIT).all() & (jnp.abs(qvel) < LIMIT).all()  # false for NaN, too
        healthy = sound & self.healthy(qpos, qvel)
        sensed, progress = self.sense(physical), self.progress(physical)
        speed = (progress - state.progress) / (self.frame_skip * self.mj_model.opt.timestep)
        terms = jnp.where(sound, jnp.stack(self.rewards(speed, control, sensed, healthy)), 0)
        after = RobotState(qpos, qvel, physical.qacc_warmstart, sensed, progress, terms, state.step + 1)
        return TimeStep(
            state=after,
            observation=self.observe(after),
            reward=jnp.full(len(self.agents), terms.sum()),
            terminated=~healthy,
            truncated=after.step >= self.episode_length,
        )

    def observe(self, state: RobotState) -> tuple[chex.Array, ...]:
        full = self.full_observation(state)
        return tuple(full[np.array(entries)] for entries in self.partition.observations)

    def full_observation(self, state: RobotState) -> chex.Array:
        """What gymnasium shows a single agent, velocities only if they are to be seen: [full_observation_size]; kept
        within `base.LIMIT`, 0 for NaN."""
        return jnp.clip(jnp.nan_to_num(self.raw_observation(state), posinf=LIMIT, neginf=-LIMIT), -LIMIT, LIMIT)

    def raw_observation(self, state: RobotState) -> chex.Array:
        hidden = self.layout.qpos.count(None)
        qvel = (state.qvel,) if self.velocities else ()
        return jnp.concatenate([state.qpos[hidden:], *qvel, *(part.ravel() for part in state.sensed)])

    def measure(self, state: RobotState) -> chex.Array:
        return jnp.concatenate([state.terms[:1] / self.forward_weight, state.terms])

    # ---- agents and their joints -------------------------------------------------------------------------------------

    def control(self, action: tuple[chex.Array, ...]) -> chex.Array:
        """The robot's controls [nu] from one action per agent."""
        order = np.argsort([actuator for own in self.partition.actuators for actuator in own])
        return jnp.concatenate(action)[order]

    @cached_property
    def partition(self) -> Partition:
        """Who moves and sees what."""
        return partition(self.robot, describe(self.mj_model), self.layout, self.split, self.depth)

    # ---- drawing -----------------------------------------------------------------------------------------------------

    @property
    def mj_model(self) -> mujoco.MjModel:
        """The robot's model in C MuJoCo."""
        return self._engine.mj_model

    @property
    def agent_bodies(self) -> tuple[tuple[int, ...], ...]:
        """The bodies that each agent moves."""
        return self.partition.bodies

    def qpos(self, state: RobotState) -> chex.Array:
        """Generalized positions [nq] for `mj_model`."""
        return state.qpos

    @property
    def _engine(self) -> Engine:
        return engine.load(self.file, self.physics)


def uniform(key: chex.PRNGKey, size: int, scale: float) -> chex.Array:
    """[size] numbers uniform on [-scale, scale]."""
    return jax.random.uniform(key, (size,), minval=-scale, maxval=scale)
