"""Networks of other runs, taken out agent by agent and laid out for a run that begins with them."""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from matd3_jax import envs
from matd3_jax.config import Config
from matd3_jax.config.diff import text
from matd3_jax.config.schema import AlgoConfig
from matd3_jax.core import sharing
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.frozen import Scale
from matd3_jax.core.group import Group
from matd3_jax.core.running_statistics import CLIP, LEAST_VARIANCE, Statistics
from matd3_jax.core.update import GroupState
from matd3_jax.envs.environment import Environment
from matd3_jax.envs.wrappers.joint_team import innermost
from matd3_jax.errors import UserError
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.training import handover, saved_policies
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.state import TrainState

if TYPE_CHECKING:
    from matd3_jax.training.starting import Leaves

NETWORKS = ("actor", "critic", "actor_target", "critic_target")


class Source:
    """A run whose networks are taken.

    Args:
        key: of the setting that names it, for messages.
        checkpoint: "last", "best" or an env step; None: the last.
        seeds: numbers of the seeds that begin with it.
        fixed: number of the one seed that all of them take; None: seed s takes s, counted round where there are fewer.
        env: of the run that begins with it; the other's, too, where that was given one as an object of the same class.
    """

    def __init__(
        self,
        key: str,
        path: str,
        checkpoint: str | None,
        seeds: Sequence[int],
        fixed: int | None,
        env: Environment,
    ):
        self.name = f"{key}={path}"
        try:
            run, self.settings = RunDirectory.open(Path(path))
        except UserError as error:
            raise UserError(f"{self.name}: {error}") from error
        name = self.settings.env["name"]
        own = env if name == type(env).__name__ and name not in envs.names() else None
        self.training = TrainingSession(self.settings, own)
        which = int(checkpoint) if checkpoint is not None and checkpoint.isdigit() else checkpoint
        try:
            saved = saved_policies.load(run, self.training, which)
            whole = saved if not saved.best else saved_policies.load(run, self.training, None)
        except UserError as error:
            raise UserError(f"{self.name}: {error}") from error
        first, last = self.settings.seed, self.settings.seed + self.settings.seeds - 1
        if fixed is not None and not first <= fixed <= last:
            seed_key = "init_seed" if key == "init" else f"{key}_seed"
            raise UserError(f"{seed_key}={fixed}: the seeds of {path} are {first} to {last}")
        self.rows = np.array([(fixed if fixed is not None else s) - first for s in seeds]) % self.settings.seeds
        for row in self.rows:
            if not (saved.finite[row] and whole.finite[row]):
                seed_key = "init_seed" if key == "init" else f"{key}_seed"
                raise UserError(f"{self.name}: seed {first + row} diverged there; choose another with {seed_key}=")
        self.policies, self.state = saved.state, whole.state

    @property
    def layout(self) -> JointLayout:
        return self.training.layout

    def place(self, agent: str) -> tuple[int, int, int]:
        """(number, group, place in it) of an agent there."""
        if agent not in self.layout.agents:
            raise UserError(f"{self.name}: there is no {agent} there, but {', '.join(self.layout.agents)}")
        number = self.layout.agents.index(agent)
        return (number, *self.layout.place(number))

    def networks(self, agents: Sequence[str], shared: bool) -> GroupState:
        """All that is trained on, leading axis [seeds]: the networks of the first of some agents, also out of those
        that it shares there, or with `shared` those that all of them share."""
        _, g, k = self.place(agents[0])
        group, found = self.layout.groups[g], self.state.groups[g]
        if group.frozen:
            raise UserError(f"{self.name}: {agents[0]} did not learn there and has no critics")
        if shared and not (group.shared and [self.layout.agents[i] for i in group.members] == list(agents)):
            raise UserError(f"{self.name}: {', '.join(agents)} have one network together here, and not there")
        if self.policies is not self.state:  # of best evaluations there are actors alone
            best = self.policies.groups[g]
            found = found._replace(actor=best.actor, actor_target=best.actor, actor_average=best.actor_average)
        owner = self.state.groups[self.layout.critic_group(g)]
        critics = {"critic": owner.critic, "critic_target": owner.critic_target}
        actors = {name: getattr(found, name) for name in ("actor", "actor_target", "actor_average")}
        one = self._first if shared else partial(self._own, group, k)
        taken = {name: one(params) for name, params in actors.items()}
        taken |= {name: (self._first if group.team_critic else one)(params) for name, params in critics.items()}
        return _nothing(GroupState)._replace(**taken)

    def actor(self, agent: str) -> tuple[Any, Scale]:
        """What an agent plays when it is evaluated there: parameters, and how it sees observations; leading axis
        [seeds]."""
        number, g, k = self.place(agent)
        group = self.policies.groups[g]
        played = self._own(
            self.layout.groups[g], k, group.actor if group.actor_average is None else group.actor_average
        )
        if group.scale is not None:
            return played, self._own(self.layout.groups[g], k, group.scale)
        size, seeds = self.layout.observation_sizes[number], len(self.rows)
        statistics = self.training.trainer.learner.scale(self.policies)
        if statistics is None:
            ones, most = np.ones((seeds, size), np.float32), np.finfo(np.float32).max
            return played, Scale(0 * ones, ones, np.full(seeds, most, np.float32))
        own = self.part(statistics, agent)
        deviation = np.sqrt(own.variance + np.float32(LEAST_VARIANCE))
        return played, Scale(own.mean, deviation, np.full(seeds, CLIP, np.float32))

    def part(self, statistics: Statistics, agent: str) -> Statistics:
        """The statistics of one agent's observations, leading axis [seeds]."""
        number, *_ = self.place(agent)
        return Statistics(*(self.layout.observation_part(np.asarray(leaf)[self.rows], number) for leaf in statistics))

    def _own(self, group: Group, member: int, tree: Any) -> Any:
        """A member's part [seeds, ...] of what its group has; a network without an index."""
        each = tree if tree is None else sharing.apart(group, tree)
        return jax.tree.map(lambda leaf: np.asarray(leaf)[self.rows, member], each)

    def _first(self, tree: Any) -> Any:
        """The one network [seeds, ...] that several have."""
        return jax.tree.map(lambda leaf: np.asarray(leaf)[self.rows, 0], tree)


def of(settings: Config, training: TrainingSession) -> "Leaves":
    """What the seeds of one run begin with.

    Args:
        training: of settings with the same programs.
    """
    seeds = settings.seed_numbers
    layout, template = training.layout, training.trainer.abstract_state()
    env = innermost(training.env)
    init = None
    if settings.init is not None:
        init = Source("init", settings.init, settings.init_checkpoint, seeds, settings.init_seed, env)
        _check_normalization(settings, init)
    groups = []
    for g, group in enumerate(layout.groups):
        algo = settings.teams()[layout.teams[group.members[0]]]
        names = [layout.agents[i] for i in group.members]
        wanted = template.groups[g]
        if group.frozen:
            groups.append(_frozen(settings, algo, layout, group.members, wanted, seeds, env))
        elif init is not None:
            for name, number in zip(names, group.members, strict=True):
                if not _hands_over(init, name):
                    _check_actions(init, layout, number)
            groups.append(_begun(init, layout, group, names, wanted))
        else:
            groups.append(_nothing(GroupState))
    start = _nothing(TrainState)._replace(groups=tuple(groups))
    if init is not None and settings.normalize_observations:
        parts = [
            _statistics(init, name, size) for name, size in zip(layout.agents, layout.observation_sizes, strict=True)
        ]
        joint = Statistics(*(np.concatenate(leaves, axis=-1) for leaves in zip(*parts, strict=True)))
        rollouts = int(init.state.rollouts) + np.zeros(len(seeds), np.float32)
        if init.state.earlier is not None:
            rollouts += np.asarray(init.state.earlier)[init.rows]
        there, here = init.training.trainer.schedule.rollout_steps, training.trainer.schedule.rollout_steps
        start = start._replace(statistics=joint, earlier=(rollouts * (there / here)).astype(np.float32))
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_flatten_with_path(start)[0]}


def _begun(init: Source, layout: JointLayout, group: Group, names: Sequence[str], wanted: GroupState) -> GroupState:
    """The networks of a group that begins with those of another run."""
    members, team = [], {}
    for name in names[: group.networks]:
        if _hands_over(init, name):
            found = _handed_over(init, layout, layout.agents.index(name))
        else:
            found = init.networks(names if group.shared else [name], group.shared)
        if wanted.actor_average is None:
            found = found._replace(actor_average=None)
        elif found.actor_average is None:
            found = found._replace(actor_average=found.actor)
        if wanted.critic is None:  # the team's first group has them
            found = found._replace(critic=None, critic_target=None)
        for part in NETWORKS:
            _check_shapes(init.name, part, name, getattr(found, part), getattr(wanted, part))
        members.append(found)
    if group.team_critic:
        _, g, _ = init.place(names[0])
        if not init.layout.groups[g].team_critic:
            raise UserError(f"{init.name}: the team of {names[0]} has one set of critics here, and not there")
        of_team = members[0]
        members = [found._replace(critic=None, critic_target=None) for found in members]
        team = {part: _stacked([getattr(of_team, part)]) for part in ("critic", "critic_target")}
    return _stacked(members)._replace(**team)


def _hands_over(source: Source, name: str) -> bool:
    """Whether an agent is one in the place of a team whose agents learned there."""
    return name not in source.layout.agents and name in source.layout.teams


def _handed_over(source: Source, layout: JointLayout, agent: int) -> GroupState:
    """The networks of the agents of a team as those of one agent in their place."""
    team = handover.Team.of(source.name, layout.agents[agent], source.layout, source.training.env)
    each = [source.networks([source.layout.agents[i]], shared=False) for i in team.agents]
    return handover.networks(source.name, team, each, source.layout, layout, agent)


def _statistics(source: Source, name: str, size: int) -> Statistics:
    """The statistics of what an agent sees, `size` entries."""
    there = source.state.statistics
    assert there is not None
    if not _hands_over(source, name):
        return source.part(there, name)
    team = handover.Team.of(source.name, name, source.layout, source.training.env)
    return handover.statistics(
        source.name, team, [source.part(there, source.layout.agents[i]) for i in team.agents], size
    )


def _frozen(
    settings: Config, algo: AlgoConfig, layout: JointLayout, members: Sequence[int], wanted: GroupState,
    seeds: Sequence[int], env: Environment,
) -> GroupState:  # fmt: skip
    """The policies of a frozen group."""
    key = "algo.policy" if algo is settings.algo else "adversary.policy"
    source = Source(key, str(algo.policy), algo.policy_checkpoint, seeds, algo.policy_seed, env)
    found = []
    for number in members:
        name = layout.agents[number]
        _check_actions(source, layout, number)
        actor, scale = source.actor(name)
        _check_shapes(source.name, "actor", name, actor, wanted.actor)
        found.append(_nothing(GroupState)._replace(actor=actor, scale=scale))
    return _stacked(found)


def _check_actions(source: Source, layout: JointLayout, agent: int) -> None:
    """Raise UserError where an agent acts or sees otherwise than there."""
    name = layout.agents[agent]
    number, *_ = source.place(name)
    there, here = source.layout.action_spaces[number], layout.action_spaces[agent]
    if there != here:
        raise UserError(f"{source.name}: {name} acts in {there} there, in {here} here")
    seen, shown = source.layout.observation_sizes[number], layout.observation_sizes[agent]
    if seen != shown:
        raise UserError(
            f"{source.name}: the actor of {name} does not fit: its layer 0 reads {seen} numbers there, {shown} here"
        )


def _check_shapes(name: str, part: str, agent: str, there: Any, here: Any) -> None:
    """Raise UserError for the first layer of a network that has another shape there than here.

    Args:
        there: parameters, leading axis [seeds].
        here: shapes, leading axes [seeds, members].
    """
    found, wanted = ({path: leaf.shape for path, leaf in _paths(tree)} for tree in (there, here))
    for path in dict.fromkeys([*wanted, *found]):
        a = list(found[path][1:]) if path in found else "none"
        b = list(wanted[path][2:]) if path in wanted else "none"
        if a != b:
            raise UserError(
                f"{name}: the {part.replace('_', ' ')} of {agent} does not fit: {path} is {a} there, {b} here"
            )


def _check_normalization(settings: Config, source: Source) -> None:
    for key in ("normalize_observations", "normalize_least_deviation"):
        here, there = getattr(settings, key), getattr(source.settings, key)
        if here != there:
            was, now = text(there), text(here)
            raise UserError(f"{source.name}: its networks were trained with {key}={was}; {key}={now} here")


def _paths(tree: Any) -> Iterator[tuple[str, Any]]:
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        yield ".".join(str(getattr(key, "key", key)) for key in path), leaf


def _stacked(members: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *members)


def _nothing(cls: Any) -> Any:
    return cls(*(None for _ in cls._fields))
