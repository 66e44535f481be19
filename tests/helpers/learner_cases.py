"""Teams, algorithms and schedules for test_learner, and the way between stacked states and the reference's agents."""

import dataclasses
import functools
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
import optax
import reference

from matd3_jax import config
from matd3_jax.core import n_step, replay, update
from matd3_jax.core.agents import JointLayout
from matd3_jax.envs import Box, Simplex, make
from matd3_jax.envs.wrappers.joint_team import JointTeam

BATCH = 7


@dataclasses.dataclass(frozen=True)
class Case:
    """One configuration of `update.update`; algorithms by name, `changes` of theirs by field."""

    env: str
    algo: str
    adversary: str | None = None
    options: Mapping = dataclasses.field(default_factory=dict)
    changes: Mapping = dataclasses.field(default_factory=dict)
    shared: bool = False
    sequential: bool = False
    random_order: bool = False
    still: tuple[str, ...] = ()
    """Teams whose actors and targets do not move in this update."""
    one_by_one: bool = True
    """How a group is computed: agent after agent, or all in one batch."""
    n_step: int = 1

    @property
    def teams(self):
        """AlgoConfig of each team."""
        return load(self.algo, self.adversary)

    def layout(self) -> JointLayout:
        return dataclasses.replace(self._spec(), n_step=self.n_step)

    def _spec(self) -> JointLayout:
        if self.env == "interleaved":
            return interleaved(self.algorithms(("agents",))["agents"])
        env = make(self.env, **self.options)
        for team in dict.fromkeys(env.teams):
            if self.teams[team].joint:
                env = JointTeam(env, team)
        return JointLayout.of(env, self.algorithms(env.teams))

    def algorithms(self, teams):
        small = {"hidden": (6,), **self.changes}
        return {team: dataclasses.replace(self.teams[team].algorithm(), **small) for team in teams}

    def hyper(self, layout):
        """Per group; the numbers differ from each other and between groups, so that none can stand in for another."""
        base = [self.teams[layout.teams[group.members[0]]].hyper_params() for group in layout.groups]
        return [
            h._replace(
                actor_lr=h.actor_lr * (1 + g),
                critic_lr=h.critic_lr * (0.7 + g),
                gamma=h.gamma - 0.1 * g,
                tau=0.2 + 0.1 * g,  # large, so that the order of agents shows
                target_noise=0.9 + 0.1 * g,  # often clipped, and often out of a Box
                target_noise_clip=0.95 - 0.05 * g,
                logit_regularizer=0.02 * (1 + g),
                max_grad_norm=0.15 + 0.05 * g,  # some variables are clipped and some are not
                **({} if h.adversarial_step is None else ADVERSARIAL),
            )
            for g, h in enumerate(base)
        ]


@functools.cache
def load(algo, adversary):
    return config.load([f"algo={algo}", *([f"adversary={adversary}"] if adversary else [])]).teams()


def interleaved(algorithm) -> JointLayout:
    """Agents of two kinds in the order A, B, A, C, B: groups that are no neighbors."""
    one, two = Simplex((3,)), Box(2, -1.0, 3.0)
    return JointLayout(
        agents=("a0", "b0", "a1", "c0", "b1"),
        teams=("agents",) * 5,
        observation_sizes=(4, 3, 4, 4, 3),
        action_spaces=(one, two, one, Simplex((2, 2)), two),
        algorithms=(algorithm,) * 5,
    )


DISTRIBUTION: Mapping = {"critic_head": "categorical", "critic_atoms": 7, "critic_range": (-2.0, 1.5)}
"""So narrow that some returns are moved beyond both ends."""

QUANTILES: Mapping = {"critic_head": "quantile", "critic_quantiles": 5, "dropped_quantiles": 2}

SUBSET: Mapping = {"num_critics": 4, "target_critics": 2, "actor_critics": "all"}

ADVERSARIAL: Mapping = {"adversarial_step": 0.6, "adversarial_step_team": 0.25}
"""So long that some actions are moved out of a Box."""

CASES = {
    # The six of the family, each as its configuration file says.
    "matd3": Case("simple_spread", "matd3", changes={"hidden": (6, 5)}),
    "maddpg": Case("simple_speaker_listener", "maddpg"),
    "iltd3": Case("simple_crypto", "iltd3", still=("adversaries",)),
    "iddpg": Case("simple_push", "iddpg", shared=True),
    "td3": Case("simple_spread", "td3"),
    "ddpg": Case("simple_speaker_listener", "ddpg"),
    # Agents that move and speak: a movement and a word each, soft and hard.
    "speaking": Case("simple_reference", "matd3", one_by_one=False),
    "speaking-hard": Case(
        "simple_world_comm",
        "iltd3",
        "maddpg",
        options={"actions": "discrete", "num_adversaries": 2, "num_good": 1, "num_food": 1, "num_forests": 0},
    ),
    # Teams of different algorithms.
    "matd3-maddpg": Case("simple_tag", "matd3", "maddpg", still=("agents",)),
    "matd3-iltd3": Case("simple_adversary", "matd3", "iltd3", sequential=True),
    "td3-maddpg": Case("simple_adversary", "td3", "maddpg"),
    # Schedules, minibatches, and groups computed in one batch.
    "matd3-iddpg-batched": Case("simple_tag", "iddpg", "matd3", one_by_one=False, shared=True),
    "matd3-still": Case("simple_spread", "matd3", shared=True, still=("agents",), one_by_one=False),
    "matd3-shared-sequential": Case("simple_spread", "matd3", shared=True, sequential=True),
    "interleaved": Case("interleaved", "matd3", sequential=True, changes={"smoothing": True}),
    "interleaved-shared": Case("interleaved", "matd3", shared=True, one_by_one=False, changes={"smoothing": True}),
    # Actors one after another in random order, against the policies as they are by then.
    "random-order": Case("simple_tag", "matd3", "maddpg", random_order=True, n_step=2),
    "random-order-interleaved": Case("interleaved", "matd3", random_order=True, changes={"smoothing": True}),
    "random-order-box": Case(
        "point_reach", "m3matd3", changes={"actor_output": "tanh"}, shared=True, random_order=True
    ),
    "random-order-own": Case(
        "simple_adversary", "iltd3", "maddpg", random_order=True, still=("adversaries",), one_by_one=False
    ),
    # Returns of several steps, discounted by each team's own gamma.
    "n-step": Case("simple_tag", "matd3", "maddpg", n_step=3),
    "n-step-own": Case("simple_crypto", "iltd3", shared=True, one_by_one=False, n_step=4),
    "n-step-joint": Case("simple_adversary", "td3", "maddpg", sequential=True, n_step=2),
    # Action spaces, numbers of critics, clipping, Adam.
    "box": Case(
        "point_reach", "matd3", changes={"smoothing": True, "num_critics": 3, "clip": "network", "hidden": (6, 4)}
    ),
    "box-own": Case("point_reach", "iltd3", changes={"smoothing": True, "adam": "epsilon_hat"}),
    # Options of recipes for robots.
    "tanh": Case(
        "point_reach", "matd3", changes={"actor_output": "tanh", "smoothing": True, "actor_average": 0.3}, shared=True
    ),
    "tanh-own": Case("point_reach", "iltd3", changes={"actor_output": "tanh", "reward_scale": 0.1}, still=("agents",)),
    "scaled": Case("simple_tag", "matd3", changes={"reward_scale": 3.0, "actor_average": 0.1}, n_step=2),
    # Critics.
    "layer-norm": Case("simple_spread", "matd3", changes={"critic_norm": "layer", "hidden": (6, 5)}),
    "layer-norm-own": Case(
        "point_reach", "iltd3", changes={"critic_norm": "layer", "clip": "network", "smoothing": True}, shared=True
    ),
    "categorical": Case("simple_spread", "matd3", changes=DISTRIBUTION, one_by_one=False),
    "categorical-3-steps": Case(
        "simple_tag", "matd3", "maddpg", changes=DISTRIBUTION | {"reward_scale": 0.5}, n_step=3
    ),
    "categorical-layer-norm": Case(
        "point_reach", "matd3", changes=DISTRIBUTION | {"critic_norm": "layer", "clip": "none"}, sequential=True
    ),
    "quantile": Case("simple_spread", "matd3", changes=QUANTILES, one_by_one=False),
    "quantile-subset": Case("simple_tag", "matd3", "iltd3", changes=QUANTILES | SUBSET, n_step=2),
    "quantile-m3matd3": Case("point_reach", "m3matd3", changes=QUANTILES | {"actor_critics": "all"}, shared=True),
    "subset": Case("simple_spread", "matd3", changes=SUBSET | {"actor_critics": "first"}),
    "subset-shared": Case("interleaved", "matd3", changes=SUBSET | {"critic_norm": "layer"}, shared=True),
    "subset-m3matd3": Case("simple_push", "m3matd3", changes=SUBSET, one_by_one=False, random_order=True),
    # Others' actions moved against each agent.
    "m3ddpg": Case("simple_tag", "m3ddpg", changes={"hidden": (6, 5)}),
    "m3matd3": Case("simple_adversary", "m3matd3", "m3ddpg", n_step=2),
    "m3matd3-box": Case("point_reach", "m3matd3", changes={"smoothing": True, "actor_output": "tanh"}, shared=True),
    "m3matd3-interleaved": Case("interleaved", "m3matd3", one_by_one=False),
    "m3matd3-categorical": Case("simple_push", "m3matd3", "maddpg", changes=DISTRIBUTION, shared=True, sequential=True),
    "m3ddpg-discrete": Case(
        "simple_crypto", "m3ddpg", "td3", options={"actions": "discrete"}, changes={"critic_norm": "layer"}
    ),
    "discrete": Case(
        "simple_spread", "maddpg", options={"actions": "discrete"}, changes={"clip": "none", "adam": "epsilon_hat"}
    ),
    "multi-discrete": Case(
        "simple_crypto", "td3", "matd3", options={"actions": "discrete"}, changes={"clip": "network"}
    ),
}


def random_state(layout, rng):
    """Groups whose every number is random: biases, moments, and targets that differ from the online networks."""
    shapes = jax.eval_shape(lambda key: update.init(layout, key), jax.random.key(0))

    def fill(path, leaf):
        name = jax.tree_util.keystr(path)
        if name.endswith(".count"):
            return np.full(leaf.shape, 3, leaf.dtype)
        if ".nu" in name:
            return np.exp(rng.uniform(np.log(1e-13), np.log(1e-3), leaf.shape))  # down to where epsilon matters
        vector = any(word in name for word in ("bias", "gain", "shift"))
        scale = 0.01 if ".mu" in name else 0.3 if vector else 1 / np.sqrt(leaf.shape[-2])
        return rng.normal(1.0 if "gain" in name and ".mu" not in name else 0.0, scale, leaf.shape)

    return jax.tree_util.tree_map_with_path(fill, shapes)


def random_rows(layout, rng, batches, batch=BATCH):
    """Replay rows [batches, batch, row_size], every other transition terminates; with n_step > 1 [batches, batch,
    n_step, row_size] in the order of play, half of them the last of an episode, and half of those terminate."""
    if layout.n_step == 1:
        rows = rng.normal(size=(batches, batch, layout.row_size))
        rows[..., -1] = np.arange(batch) % 2
        return rows
    rows = rng.normal(size=(batches, batch, layout.n_step, layout.row_size))
    more = rng.integers(0, 2, rows.shape[:-1])
    rows[..., -2 - layout.observation_size] = more
    rows[..., -1] = np.maximum(more, rng.integers(0, 2, rows.shape[:-1]))
    return rows


def drawn(layout, rows, hyper):
    """What `n_step.draw` gives for such rows, put into a replay as those of batches * batch environments."""
    if layout.n_step == 1:
        return rows
    batches, batch, n, size = rows.shape
    num_envs = batches * batch
    ring = jnp.moveaxis(rows, 2, 0).reshape(1, n * num_envs, size)
    written = replay.Written(n * num_envs, n * num_envs, 1)
    gamma = jnp.array([hyper[layout.place(i)[0]].gamma for i in range(layout.num_agents)])
    return n_step.draw(layout, ring, 0, jnp.arange(num_envs).reshape(batches, batch), written, num_envs, gamma)


def layers(params, *place):
    """[(kernel, bias, ...)] of the network at `place` of a stack."""
    names = ("kernel", "bias", "gain", "shift")
    count = sum(name.startswith("kernel") for name in params)
    return [
        tuple(np.array(params[f"{name}_{n}"][place]) for name in names if f"{name}_{n}" in params) for n in range(count)
    ]


def adam(state: optax.ScaleByAdamState, member, *critic):
    place = (member, *critic)
    return reference.Adam(layers(state.mu, *place), layers(state.nu, *place), int(state.count[member]))


def agents_of(layout, state, hyper):
    """The reference's agents, in the order of `layout.agents`, of the states of all groups."""
    agents = {}
    for group, s, h in zip(layout.groups, state, hyper, strict=True):
        for k, i in enumerate(group.members):
            critics = range(group.algorithm.num_critics)
            agents[i] = reference.Agent(
                space=layout.action_spaces[i],
                observation_size=layout.observation_sizes[i],
                algorithm=layout.algorithms[i],
                hyper=h,
                actor=layers(s.actor, k),
                actor_target=layers(s.actor_target, k),
                critics=[layers(s.critic, k, c) for c in critics],
                critic_targets=[layers(s.critic_target, k, c) for c in critics],
                actor_adam=adam(s.actor_optimizer, k),
                critic_adams=[adam(s.critic_optimizer, k, c) for c in critics],
                average=None if s.actor_average is None else layers(s.actor_average, k),
                team=layout.teams[i],
            )
    return [agents[i] for i in range(layout.num_agents)]


def numbers(
    agent, names=("actor", "actor_target", "critics", "critic_targets", "actor_adam", "critic_adams", "average")
):
    """All arrays of an agent as {path: array}."""
    tree = {name: getattr(agent, name) for name in names}
    for name in ("actor_adam", "critic_adams"):
        if name in tree:
            tree[name] = jax.tree.map(dataclasses.asdict, tree[name], is_leaf=lambda a: isinstance(a, reference.Adam))
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}
