"""A hybrid run: the agents of a team learn until `switch_at`, then one agent in their place goes on from there."""

import dataclasses
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from matd3_jax.config import Config
from matd3_jax.config.schema import AlgoConfig
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.running_statistics import Statistics
from matd3_jax.core.update import GroupState
from matd3_jax.envs.wrappers.joint_team import innermost
from matd3_jax.errors import UserError
from matd3_jax.runs.directory import START, RunDirectory
from matd3_jax.runs.metrics_table import MetricsTable, number
from matd3_jax.runtime import files
from matd3_jax.runtime.multihost import Processes
from matd3_jax.training import checkpoint, distillation, handover, saved_replay
from matd3_jax.training.handover import Team
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.state import TrainState

if TYPE_CHECKING:
    from matd3_jax.training.recording import Recorder
    from matd3_jax.training.run import Outcome

FOLDER = "agents"
"""Of the agents' part in the run's directory: a run directory, too."""


def switch_step(training: TrainingSession) -> int:
    """The env step of the switch: the end of the whole logging interval nearest to `switch_at`.

    Raises UserError where that leaves the agents, or the one agent, nothing to learn.
    """
    config, warm_up, interval = training.config, training.trainer.schedule.warmup_steps, training.interval_steps
    wanted = config.total_steps // 2 if config.switch_at is None else config.switch_at
    step = warm_up + max(1, round((wanted - warm_up) / interval)) * interval
    if not warm_up < wanted < config.total_steps or step >= training.total_steps:
        raise UserError(
            f"switch_at={wanted}: learning starts after env step {warm_up:,} and ends at {training.total_steps:,}, and "
            f"the switch, at the end of a logging interval of {interval:,} env steps, must come between"
        )
    return step


def agents_settings(training: TrainingSession, config: Config) -> Config:
    """The settings of the agents' part of a run; config: of a member of the session `training`."""

    def apart(team: AlgoConfig) -> AlgoConfig:
        if not team.hands_over or team.frozen:
            return team
        name = "matd3" if team.num_critics > 1 else "maddpg"
        return dataclasses.replace(team, name=name, joint=False, hands_over=False, handover="join", critic="central")

    return dataclasses.replace(
        config,
        algo=apart(config.algo),
        adversary=None if config.adversary is None else apart(config.adversary),
        switch_at=None,
        total_steps=switch_step(training),
        log_every=training.interval_steps,
        eval_every=training.eval_every,
        checkpoint_every=int(training.checkpoint_every),
        name=FOLDER if config.name is None else f"{config.name}-{FOLDER}",
    )


def first_session(training: TrainingSession, config: Config) -> TrainingSession:
    """The session that begins a run of `config`, a member of `training`: of the agents' part, where it has one."""
    if not config.hands_over:
        return TrainingSession(config, innermost(training.env))
    return TrainingSession(agents_settings(training, config), innermost(training.env))


def begin(
    training: TrainingSession, agents: TrainingSession, saved: Path, tell: Callable[[str], None] = lambda line: None
) -> TrainState:
    """Go on from the checkpoint `saved` of the agents' part: the same actions, the mean of their values, the same
    episodes and transitions, and the optimizers' moments; with `handover=distill` networks that have learned the
    actions and values; `tell` gets a line on how well."""
    small = checkpoint.restore_actors(saved, agents.trainer, agents.share)
    fresh = training.trainer.init(training.keys())
    there, here = agents.layout, training.layout
    teams = {
        i: Team.of(f"switch_at={agents.total_steps}", name, there, agents.env, full=False)
        for i, name in enumerate(here.agents)
        if name not in there.agents
    }
    taught = {i for i in teams if training.config.teams()[here.agents[i]].handover == "distill"}
    pupils = [g for g, group in enumerate(here.groups) if group.members[0] in taught]
    side_by_side = dataclasses.replace(
        here,
        algorithms=tuple(
            handover.widened(algorithm, len(teams[i].agents)) if i in taught else algorithm
            for i, algorithm in enumerate(here.algorithms)
        ),
    )
    groups = []
    for group in here.groups:
        each = []
        for i in group.members:
            if i in teams:
                team = teams[i]
                own = [_taken(small, there, agent) for agent in team.agents]
                each.append(handover.networks(f"switch_at={agents.total_steps}", team, own, there, side_by_side, i))
            else:
                each.append(_taken(small, there, there.agents.index(here.agents[i])))
        found = jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *each)
        groups.append(found)
    order = _Order(there, here, teams)
    statistics = small.statistics
    if statistics is not None:
        statistics = Statistics(*(np.asarray(leaf)[:, order.observation] for leaf in statistics))
    env = small.env
    quantile = env.noise_quantile
    env = env._replace(
        observation=tuple(
            np.concatenate([np.asarray(env.observation[i]) for i in members], axis=-1) for members in order.members
        ),
        episode_return=order.rewards(np.asarray(env.episode_return)),
        noise_quantile=None if quantile is None else np.asarray(quantile)[..., order.first],
    )
    reservoir = fresh.reservoir
    if reservoir is not None:
        # A copy: the state is donated, and one buffer can't be given away twice.
        reservoir = reservoir._replace(since=np.array(small.rollouts))
    state = fresh._replace(
        groups=tuple(fresh.groups[g] if g in pupils else found for g, found in enumerate(groups)),
        env=env,
        key=small.key,
        rollouts=small.rollouts,
        statistics=statistics,
        reservoir=reservoir,
        earlier=small.earlier,
        stopped=small.stopped,
        replay=saved_replay.restore(saved, training.trainer, training.share, int(small.rollouts), order.rows),
    )
    state = jax.device_put(state, training.trainer.shardings)
    for g in pupils:
        name = here.agents[here.groups[g].members[0]]
        teacher = distillation.Teacher(side_by_side.groups[g], groups[g].actor, groups[g].critic)
        updates = training.config.teams()[name].distillation_updates
        state, fit = distillation.distill(training.trainer, state, g, teacher, updates)
        tell(fit.line(name))
    return state


class _Order:
    """What the agents' layout has, in the order of the one agent's."""

    def __init__(self, there: JointLayout, here: JointLayout, teams: dict[int, Team]):
        self.there = there
        self.members = [
            teams[i].agents if i in teams else (there.agents.index(name),) for i, name in enumerate(here.agents)
        ]
        """For each agent here the numbers of those there in whose place it is."""
        flat = [agent for members in self.members for agent in members]
        self.first = [members[0] for members in self.members]
        self.observation = _places(flat, there.observation_starts, there.observation_sizes)
        self.action = _places(flat, there.action_starts, [space.size for space in there.action_spaces])

    def rewards(self, each: np.ndarray) -> np.ndarray:
        """What each agent here gets, [..., agents here], of [..., agents there]: the mean of its members'."""
        return np.stack([each[..., list(members)].mean(axis=-1) for members in self.members], axis=-1)

    def rows(self, rows: np.ndarray) -> np.ndarray:
        """Replay rows [rows, row size here] of rows [rows, row size there]."""
        parts = self.there.row_parts(rows)
        more = [] if parts.more is None else [parts.more[:, None]]
        x, next_x = (np.asarray(part)[:, self.observation] for part in (parts.x, parts.next_x))
        rewards = self.rewards(np.asarray(parts.reward))
        return np.concatenate(
            [x, parts.action[:, self.action], rewards, *more, next_x, parts.discount[:, None]], axis=1, dtype=np.float32
        )


def _places(agents: list[int], starts: Any, sizes: Any) -> list[int]:
    return [starts[agent] + k for agent in agents for k in range(sizes[agent])]


def _taken(state: TrainState, layout: JointLayout, agent: int) -> GroupState:
    """What an agent has of a state, leading axis [seeds]."""
    g, k = layout.place(agent)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:, k], state.groups[g])


# ---- in a run directory ----------------------------------------------------------------------------------------------


def begun(directory: RunDirectory) -> bool:
    """Whether the agents' part of a run is there."""
    return (directory.path / FOLDER / "config.yaml").is_file()


def prepare(directory: RunDirectory, settings: Config, machine: Mapping[str, Any]) -> RunDirectory:
    """The run directory of the agents' part, which is made where it is not there, with what the run begins with."""
    path = directory.path / FOLDER
    start = directory.path / START

    def more(folder: Path) -> None:
        if start.is_file():
            shutil.copy(start, folder / START)

    return RunDirectory(path) if begun(directory) else RunDirectory.create(path, settings, machine, more=more)


def train_agents(
    recorder: "Recorder", training: TrainingSession, directory: RunDirectory, machine: Mapping[str, Any]
) -> tuple[TrainingSession, "Outcome | None"]:
    """Train the agents' part of a run, or train it on: its session, and how it was left; None: it was finished
    already."""
    processes, env, finished = recorder.processes, innermost(training.env), None
    there = begun(directory)
    if processes.first:
        part = prepare(directory, agents_settings(training, training.config), machine)
        finished = part.summary() is not None
    path = directory.path / FOLDER
    if processes.broadcast(finished):
        return TrainingSession(RunDirectory.open(path)[1], env, processes=processes), None
    found = recorder.resume(path, env=env, untouched=not there)
    return found.training, found.outcome


def last_checkpoint(directory: RunDirectory, processes: Processes) -> Path:
    """The last checkpoint of the agents' part of a run. Raises UserError where it is damaged."""
    folder = RunDirectory(directory.path / FOLDER).checkpoints
    return Path(processes.broadcast(str(checkpoint.verify(folder)) if processes.first else None))


def write_table(training: TrainingSession, agents: TrainingSession, directory: RunDirectory) -> None:
    """Begin a run's metrics table with the rows of its agents' part: of one agent in the place of several the means of
    theirs."""
    found = RunDirectory(directory.path / FOLDER).table()
    there, here = agents.layout, training.layout
    places = {name: k for k, name in enumerate(found.header)}

    def sources(column: str) -> list[int]:
        """The places of the columns that the numbers of a column are the mean of."""
        if column in places:
            return [places[column]]
        for one, team in zip(here.agents, here.teams, strict=True):
            members = [name for name, other in zip(there.agents, there.teams, strict=True) if other == team]
            names = [f"{name}{column.removeprefix(one)}" for name in members]
            if column.startswith(f"{one}_") and all(name in places for name in names):
                return [places[name] for name in names]
        return []

    def value(row: list[str], where: list[int]) -> str:
        if len(where) == 1:
            return row[where[0]]
        return number(np.mean([float(row[place]) for place in where])) if where else "nan"

    columns = training.columns
    each = [sources(column) for column in columns]
    rows = [[value(row, where) for where in each] for row in found.rows]
    files.write_text(directory.metrics, MetricsTable(list(columns), rows, 0).text())
