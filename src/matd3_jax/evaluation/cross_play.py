"""Teams of different runs in one environment: how a team acts without its run, and episodes of any two teams."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from matd3_jax.core import acting, rollout, sharing
from matd3_jax.core.acting import PolicyParams
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.core.running_statistics import Statistics
from matd3_jax.envs.environment import Environment
from matd3_jax.envs.wrappers.joint_team import JointTeam
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.state import TrainState

TEAMS = ("agents", "adversaries")
"""The two sides, in the order of every axis [teams]."""
SIDE_BY_SIDE = {"cpu": 2**12, "other": 2**16}
"""Environments that a device steps at a time, unless one pair alone plays more episodes: bounds the memory."""


@dataclasses.dataclass(frozen=True)
class Side:
    """How a team of a run acts, but for the numbers: static, and equal for runs whose networks have the same shapes."""

    team: str
    env: Environment
    """The environment without anybody's joining, or with this team joined into one agent."""
    layout: JointLayout
    """Of this team's agents alone, in the order of `env`."""

    @property
    def members(self) -> tuple[int, ...]:
        """Indices of this team's agents in `env`."""
        return _members(self.env, self.team)

    def act(
        self,
        policy: PolicyParams,
        state: Any,
        observation: tuple[chex.Array, ...],
        key: chex.PRNGKey | None,
        recurrent: chex.Array | None,
    ) -> tuple[list[chex.Array], chex.Array | None]:
        """What the team's agents do in the environment without joining, one array [envs, ...] each; and the states of
        their actors after it, where there are any.

        Args:
            policy: of one seed.
            state, observation: of that environment, everybody's; leading axis [envs].
            key: of the noise; None: deterministic actions.
            recurrent: the states before, [envs, state_size].
        """
        if not isinstance(self.env, JointTeam):
            actions, recurrent = acting.decide(
                self.layout, policy, [observation[i] for i in self.members], key, recurrent
            )
            return list(actions), recurrent
        (agent,) = self.members
        seen = jax.vmap(self.env.join)(state, observation)[agent]
        everybody: list = [None] * len(self.env.agents)
        (everybody[agent],), recurrent = acting.decide(self.layout, policy, [seen], key, recurrent)
        parts = jax.vmap(self.env.split)(tuple(everybody))
        return [parts[i] for i in self.env.members], recurrent


class Team(NamedTuple):
    """A team of a run with the policies of all its seeds."""

    side: Side
    policy: PolicyParams
    """Leading axis [seeds]; actors and statistics of this team's agents only."""


def team_of(training: TrainingSession, env: Environment, state: TrainState, team: str) -> Team:
    """One of the two teams that a run trained.

    Args:
        env: the run's environment without joining.
        state: what was trained, leading axis [seeds].
    """
    whole = training.layout
    who = _members(training.env, team)
    algorithm = whole.algorithms[who[0]]
    own = Side(
        team=team,
        env=JointTeam(env, (team,)) if algorithm.joint else env,
        layout=JointLayout(
            agents=tuple(whole.agents[i] for i in who),
            teams=(team,) * len(who),
            observation_sizes=tuple(whole.observation_sizes[i] for i in who),
            action_spaces=tuple(whole.action_spaces[i] for i in who),
            # Acting knows of no critics: algorithms that differ in these only share their programs.
            algorithms=(_acting(algorithm),) * len(who),
        ),
    )
    # Through the host: the seeds may lie on different devices, copies behind the last of them.
    seeds = training.config.seeds
    policy = jax.tree.map(lambda leaf: np.asarray(leaf)[:seeds], training.trainer.policy(state, average=True))
    actors: list[Any] = []
    hyper, scales = [], []
    for group in own.layout.groups:
        found = [whole.place(who[i]) for i in group.members]
        g, rows = found[0][0], [row for _, row in found]
        each = sharing.apart(whole.groups[g], policy.actors[g])
        actors.append(jax.tree.map(lambda leaf, rows=rows: np.asarray(leaf)[:, rows], each))
        hyper.append(policy.hyper[g])
        scale = policy.scales[g] if policy.scales else None
        scales.append(jax.tree.map(lambda leaf, rows=rows: leaf[:, rows], scale))
    statistics = policy.statistics
    if statistics is not None:
        parts = [[whole.observation_part(leaf, i) for i in who] for leaf in statistics]
        statistics = Statistics(*(np.concatenate(part, axis=-1) for part in parts))
    return Team(own, PolicyParams(tuple(actors), tuple(hyper), statistics, tuple(scales) if policy.scales else ()))


def play(
    env: Environment, teams: Sequence[Team], pairs: np.ndarray, episodes: int, deterministic: bool, seed: int = 0
) -> np.ndarray:
    """Mean undiscounted returns [pairs, agents] of whole episodes between seeds of two teams, in float64.

    Every pair plays from the same start states and with the same randomness of the environment, those of
    `TrainingSession.evaluate` with that `seed`; sampled policies draw their noise each team by itself.

    Args:
        env: what both play in, without joining.
        teams: one for each of `TEAMS`.
        pairs: [pairs, teams] indices of the seeds in their runs.
        deterministic: no noise at all; otherwise the policies act as they do in training.
    """
    key = jax.random.fold_in(jax.random.key(seed), 2**31 - 1)
    devices = jax.devices()[: len(pairs)]
    batch = side_by_side(len(pairs), episodes)
    program = _program(env, tuple(team.side for team in teams), tuple(devices), episodes, deterministic)
    policies = jax.device_put(tuple(team.policy for team in teams))
    found = []
    for start in range(0, len(pairs), batch):
        # Batches of one size, the last filled up with copies of its last pair: one program.
        chosen = pairs[np.minimum(np.arange(start, start + batch), len(pairs) - 1)]
        returns = np.asarray(program(policies, jnp.asarray(chosen), key), np.float64)
        found.append(returns.mean(axis=1)[: len(pairs) - start])
    return np.concatenate(found)


def side_by_side(pairs: int, episodes: int) -> int:
    """How many of the pairs are played at a time, a multiple of the devices that play."""
    devices = jax.devices()[:pairs]
    width = SIDE_BY_SIDE["cpu" if devices[0].platform == "cpu" else "other"]
    return min(-(-pairs // len(devices)), max(1, width // episodes)) * len(devices)


@functools.cache
def _program(env: Environment, sides: tuple[Side, ...], devices: tuple, episodes: int, deterministic: bool) -> Any:
    """(policies of both teams, pairs [pairs, teams], key) -> returns [pairs, episodes, agents]."""

    def one(policies, pair, key):
        own = [jax.tree.map(lambda leaf, k=k: leaf[k], policy) for policy, k in zip(policies, pair, strict=True)]

        def choose(key, state, observation, recurrent):
            actions: list = [None] * len(env.agents)
            after = []
            for t, (side, policy) in enumerate(zip(sides, own, strict=True)):
                noise = None if deterministic else jax.random.fold_in(key, t)
                chosen, kept = side.act(policy, state, observation, noise, recurrent[t])
                after.append(kept)
                for i, action in zip(_members(env, side.team), chosen, strict=True):
                    actions[i] = action
            return tuple(actions), tuple(after)

        fresh = tuple(acting.fresh_state(side.layout, episodes) for side in sides)
        return rollout.play(env, choose, key, episodes, fresh).episode_return

    each = jax.vmap(one, in_axes=(None, 0, None))
    mesh = Mesh(np.array(devices), ("pairs",))
    specs = (P(), P("pairs"), P())
    return jax.jit(jax.shard_map(each, mesh=mesh, in_specs=specs, out_specs=P("pairs"), check_vma=False))


def _acting(algorithm: Algorithm) -> Algorithm:
    """What acting knows of an algorithm."""
    return Algorithm(
        "actor",
        hidden=algorithm.hidden,
        actor_output=algorithm.actor_output,
        noise_range=algorithm.noise_range,
        frozen=algorithm.frozen,
        actor=algorithm.actor,
        gru_units=algorithm.gru_units,
    )


def _members(env: Environment, team: str) -> tuple[int, ...]:
    return tuple(i for i, other in enumerate(env.teams) if other == team)
