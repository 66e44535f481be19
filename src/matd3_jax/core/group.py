"""Groups: agents of a team that are alike, and their networks."""

import dataclasses

import chex
import jax
import jax.numpy as jnp

from matd3_jax.core import critics, gru, policies, sharing
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.core.critics import Critic
from matd3_jax.core.networks import StackedMLP, apply
from matd3_jax.core.policies import Policy
from matd3_jax.envs.spaces import ActionSpace


@dataclasses.dataclass(frozen=True)
class Group:
    """Agents of a team with the same observation size, action space and algorithm: one stack of networks, or one for
    all."""

    members: tuple[int, ...]
    observation_size: int
    action_space: ActionSpace
    algorithm: Algorithm

    @property
    def policy(self) -> Policy:
        """How an actor's output becomes an action."""
        return policies.of(self.action_space, self.algorithm)

    @property
    def actor(self) -> StackedMLP:
        """The actor of one member: observations [batch, observation_size] to outputs [batch, action size]."""
        return StackedMLP((), (*self.algorithm.hidden, self.action_space.size))

    def init_actor(self, key: chex.PRNGKey) -> chex.ArrayTree:
        """Draw the actor of one member."""
        read = self.observation_size + self.index_size
        params = self.actor.init(key, jnp.zeros((1, read + self.state_size)))["params"]
        if not self.recurrent:
            return params
        inputs = self.observation_size + self.action_space.size
        return {**params, gru.PARAMS: gru.init(jax.random.fold_in(key, 1), (), inputs, self.state_size)}

    def init_critics(self, key: chex.PRNGKey, inputs: int) -> chex.ArrayTree:
        """Draw the critics of one member, leaves [critics, ...]; inputs: entries of what they read, states apart."""
        params = self.critic.init(key, inputs + self.state_size)
        if not self.recurrent:
            return params
        stack = (self.algorithm.num_critics,)
        return {**params, gru.PARAMS: gru.init(jax.random.fold_in(key, 1), stack, inputs, self.state_size)}

    @property
    def actors(self) -> StackedMLP:
        """The actors of all members, stacked: [members, batch, ...]."""
        return StackedMLP((len(self.members),), (*self.algorithm.hidden, self.action_space.size))

    @property
    def frozen(self) -> bool:
        """Whether the members play a given policy and do not learn."""
        return self.algorithm.frozen

    @property
    def recurrent(self) -> bool:
        """Whether the members' networks have states."""
        return self.algorithm.recurrent

    @property
    def state_size(self) -> int:
        """Entries of the state of one member's actor."""
        return self.algorithm.gru_units if self.recurrent else 0

    @property
    def shared(self) -> bool:
        """Whether the members have one actor, and one set of critics, together. One member alone has its own anyhow;
        frozen ones have what they are given, each for itself."""
        return self.algorithm.share_parameters == "kind" and len(self.members) > 1 and not self.frozen

    @property
    def team_critic(self) -> bool:
        """Whether the members' team has one set of critics for all of it."""
        return self.algorithm.critic == "shared" and not self.frozen

    @property
    def networks(self) -> int:
        """Actors that the members have, and sets of critics: the leading axis of their parameters."""
        return 1 if self.shared else len(self.members)

    @property
    def index_size(self) -> int:
        """Inputs of their networks that say whose turn it is."""
        return len(self.members) if self.shared else 0

    def of_member(self, params: chex.ArrayTree, k: chex.Array | int) -> chex.ArrayTree:
        """The network of member k alone, out of parameters with leading axis [networks]; it reads no index."""
        if not self.shared:
            return jax.tree.map(lambda leaf: leaf[k], params)
        return sharing.network_of(jax.tree.map(lambda leaf: leaf[0], params), k, self.index_size)

    def outputs(self, params: chex.ArrayTree, observations: chex.Array) -> chex.Array:
        """What the members' actors, leading axis [networks], give [members, batch, action size] for observations
        [members, batch, observation_size]."""
        if not self.shared:
            return apply(self.actors, params, observations)

        def one(k: chex.Array, observation: chex.Array) -> chex.Array:
            return apply(self.actor, self.of_member(params, k), observation)

        return jax.vmap(one)(jnp.arange(len(self.members)), observations)

    @property
    def critic(self) -> Critic:
        """The critics of one member."""
        return critics.of(self.algorithm)

    @property
    def target_critic(self) -> Critic:
        """Those of one member that make a target."""
        return critics.of_target(self.algorithm)
