"""A run from its settings: its programs, its plan, and its rows of the metrics table."""

import contextlib
import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import jax
import numpy as np

from matd3_jax import envs
from matd3_jax.config import Config
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import HyperParams
from matd3_jax.core.q_bias import Values
from matd3_jax.core.rollout import Evaluation
from matd3_jax.envs.environment import Environment
from matd3_jax.errors import UserError
from matd3_jax.runs import overestimation
from matd3_jax.runs.missing import Expected
from matd3_jax.runtime import devices
from matd3_jax.runtime.multihost import SINGLE_PROCESS, Processes
from matd3_jax.training import memory, rows, starting, teams
from matd3_jax.training.best import BestPolicies
from matd3_jax.training.clock import Clock
from matd3_jax.training.evaluator import Evaluator
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.program import Program
from matd3_jax.training.rows import Row
from matd3_jax.training.schedule import Schedule
from matd3_jax.training.state import Metrics, TrainState, networks_finite

EVALUATION_SPACING = 4
"""Env steps of training, at least, for each env step of an evaluation, by default. Evaluations cost no updates: they
take some 3 % of a robot's training with the fast recipe, less with others."""


class TrainingSession:
    """Programs and plan of one run, or of several that share a program (a batch of a sweep).

    Args:
        config: checked settings.
        env: the environment; default: the one that `config.env` names.
        members: settings of the runs side by side, which may differ in `HyperParams`, `seed` and `seeds` only; default
            `config` alone. Wherever an axis [seeds] is, the seeds of the first come first.
        processes: which train them together, each its share of the seeds on its own devices. States have the seeds of
            this process alone; rows of the metrics table those of all processes in the first of them.

    Raises UserError where the environment does not take its options, a team has no agents, or a process no seed.
    """

    def __init__(
        self,
        config: Config,
        env: Environment | None = None,
        members: Sequence[Config] | None = None,
        processes: Processes = SINGLE_PROCESS,
    ):
        self.config, self.processes = config, processes
        self.members = (config,) if members is None else tuple(members)
        numbers = np.concatenate([np.arange(m.seed, m.seed + m.seeds) for m in self.members])
        self.clock = Clock()
        self.share = processes.share(len(numbers))
        """Which of the seeds are trained in this process."""
        self.seeds = numbers[self.share.seeds]
        """[seeds] the number that each seed's key is made from."""
        self.env, algorithms = teams.joined(config, _made(config) if env is None else env)
        sequences = (config.sequence_length, config.burn_in) if config.recurrent else (1, 0)
        self.layout = JointLayout.of(self.env, algorithms, config.n_step, *sequences)
        schedule = Schedule.of(config)
        self._each = [member for member in self.members for _ in range(member.seeds)]
        hyper = {team: self._hyper(team) for team in config.teams()}
        seeds, normalize = len(self.seeds), config.normalize_observations
        local = jax.local_devices()
        least = config.normalize_least_deviation
        options: dict[str, Any] = {"normalize_observations": normalize, "least_deviation": least}
        options["earlier_statistics"] = config.init is not None
        options["stop_seeds"] = config.on_divergence == "stop_seed"
        trainer = TrainLoop(self.env, self.layout, schedule, hyper, seeds, local, **options)
        # Whole intervals of equal length, so that one compiled program does for all; as many as come closest to
        # log_every.
        iterations = max(1, math.ceil((config.total_steps - trainer.schedule.warmup_steps) / trainer.iteration_steps))
        wanted = max(1, round((config.log_every or config.total_steps / 100) / trainer.iteration_steps))
        self.num_intervals = math.ceil(iterations / wanted)
        self.iterations_per_interval = math.ceil(iterations / self.num_intervals)
        self.total_steps = (
            trainer.schedule.warmup_steps + self.num_intervals * self.iterations_per_interval * trainer.iteration_steps
        )
        """Env steps of each seed: the first whole interval at or after the wanted number."""
        # Rows that would never be written are not allocated: the same result in less memory.
        capacity = min(config.replay_capacity, self.total_steps)
        schedule = dataclasses.replace(schedule, replay_capacity=capacity)
        kept = config.diagnostics.q_bias_rollouts if config.diagnostics.q_bias else 0
        self.trainer = TrainLoop(self.env, self.layout, schedule, hyper, seeds, local, q_bias_pairs=kept, **options)
        self.evaluator = Evaluator(self.trainer)
        learning = [self.layout.teams[i] for i in self.layout.learners]
        judged = "agents" if "agents" in learning else learning[0]
        self.best = BestPolicies(seeds, self.team_weights(judged))
        """Of this process's seeds, by the return of the team "agents" (frozen: of the adversaries)."""
        self.networks_finite = np.ones(self.share.total, bool)
        """[seeds of all processes, in the first of them] whether each seed's networks were finite in the last row."""

    def _hyper(self, team: str) -> HyperParams:
        """The team's hyper-parameters, leaves [seeds]."""
        each = [config.teams()[team].hyper_params() for config in self._each[self.share.seeds]]
        return jax.tree.map(lambda *leaves: np.array(leaves, np.float32), *each)

    def change_hyper(self, each: Sequence[Config]) -> None:
        """Go on with other hyper-parameters, in the same compiled programs.

        Args:
            each: settings [seeds of all processes], which differ from those before in `HyperParams` only.
        """
        self._each = list(each)
        self.trainer.hyper = self.trainer.per_group({team: self._hyper(team) for team in self.config.teams()})
        self.interval = self.interval._replace(hyper=self.trainer.hyper)

    # ---- memory ------------------------------------------------------------------------------------------------------

    def check_memory(self, recorded: bool = False) -> None:
        """Raise UserError, with the arithmetic, unless everything that training takes fits into the memory that is
        free. recorded: checkpoints are written, too."""
        parts = memory.parts(self.trainer, len(self.seeds), self.config.eval_episodes if self.eval_every else 0)
        if not (recorded and self.trainer.on_cpu):
            del parts["checkpoint"]  # an accelerator's are made in the host's memory
        parts["replay"] = parts["replay"]._replace(what=memory.of_replay(self.trainer, self.processes))
        otherwise = ", or fewer seeds" if len(self.seeds) > 1 else ""
        memory.check(list(parts.values()), devices.free_memory(self.processes.local), otherwise)

    # ---- running -----------------------------------------------------------------------------------------------------

    def keys(self) -> jax.Array:
        """One key a seed; a seed's key does not depend on the other seeds."""
        return jax.vmap(jax.random.key)(self.seeds)

    def start(self, given: Mapping[str, np.ndarray] | None = None) -> tuple[TrainState, Row]:
        """The state after the warm-up, and what the untrained policies got there (of all processes in the first).

        Args:
            given: what the seeds of all processes begin with from other runs, as `starting.gather` gives it; None:
                it is read there, where the settings want any.
        """
        self.check_memory()
        if given is None:
            given = starting.gather(self)
        state = starting.put(self.trainer, self.trainer.init(self.keys()), given, self.share)
        state, episodes = self.trainer.warm_up(state)
        row = self.row(state, Metrics(episodes, None))  # type: ignore[arg-type]
        state, columns = self._evaluated(state, due=True)
        return state, self._gathered(state, row | columns)

    @cached_property
    def interval(self) -> Program:
        """The program of one interval: compiled once."""
        return self.trainer.interval(self.iterations_per_interval)

    def advance(self, state: TrainState) -> tuple[TrainState, Row]:
        """One interval, and an evaluation where one is due; the row has the seeds of all processes in the first of
        them. The state given in is donated."""
        before = self.step(state)
        with self.clock.train():
            state, metrics = jax.block_until_ready(self.interval(state))
        row = self.row(state, metrics)
        state, columns = self._evaluated(state, self._due(before, self.step(state)))
        return state, self._gathered(state, row | columns)

    def _gathered(self, state: TrainState, row: Row) -> Row:
        """The row with the seeds of all processes in the first of them; notes whose networks are finite."""
        finite = self.finite(state)
        row = self.processes.gather({**row, "finite": finite})
        self.networks_finite = row.pop("finite")
        return row

    def finite(self, state: TrainState) -> np.ndarray:
        """Whether the networks of each seed of this process, and their optimizers, have finite numbers only."""
        return np.asarray(networks_finite(state))[: len(self.seeds)]

    def step(self, state: TrainState) -> int:
        """Env steps of each seed so far."""
        return self.trainer.env_steps(int(state.rollouts))

    @property
    def interval_steps(self) -> int:
        """Env steps of each seed in a logging interval."""
        return self.iterations_per_interval * self.trainer.iteration_steps

    def row(self, state: TrainState, metrics: Metrics) -> Row:
        """The interval's row of the metrics table for each seed."""
        step, updates = self.step(state), self.trainer.updates(int(state.rollouts))
        row = rows.of_interval(self.layout, self.seeds, step, updates, metrics, self.team_weights)
        if state.stopped is None:
            return row
        return rows.without_learning(row, np.asarray(state.stopped)[: len(self.seeds)])

    @property
    def columns(self) -> list[str]:
        """The names of the metrics table's columns, in their order."""
        names = [*rows.columns(self.layout), *self.evaluation_columns(None)]
        judged = overestimation.columns(self.layout.learning_agents, None, 0) if self.config.diagnostics.q_bias else {}
        return names + list(judged)

    def expected_table(self, config: Config) -> Expected:
        """What the metrics table of a member should have."""
        return Expected(self.columns, config.seed_numbers, self.trainer.schedule.warmup_steps, self.interval_steps)

    def team_weights(self, team: str) -> np.ndarray:
        """Weights [agents] of the agents' returns in the number reported for a team (`Environment.return_weights`)."""
        member = np.array([t == team for t in self.layout.teams])
        return np.where(member, self.env.return_weights, 0.0)

    @property
    def checkpoint_every(self) -> float:
        """Env steps between checkpoints; 0: none on the way."""
        every = self.config.checkpoint_every
        return self.total_steps / 5 if every is None else every

    # ---- evaluation --------------------------------------------------------------------------------------------------

    @property
    def eval_every(self) -> int:
        """Env steps between evaluations; 0: never."""
        every = self.config.eval_every
        if every is not None:
            return every
        played = self.config.eval_episodes * self.env.episode_length
        return max(self.config.total_steps // 20, EVALUATION_SPACING * played)

    def _due(self, before: int, step: int) -> bool:
        """Whether an evaluation ends the interval from env step `before` to `step`."""
        every = self.eval_every
        return every > 0 and (step // every > before // every or step >= self.total_steps)

    def evaluations_after(self, step: int) -> int:
        """How many evaluations are to come after the interval that ended at env step `step`."""
        interval = self.interval_steps
        ends = range(step, self.total_steps + interval, interval)
        return sum(map(self._due, ends[:-1], ends[1:]))

    def evaluate(self, state: TrainState, episodes: int, deterministic: bool, seed: int = 0) -> Evaluation:
        """Whole episodes in float64, leading axis [seeds]; every seed of the run plays from the same start states,
        which `seed` gives."""
        # Apart from the training's keys, which are split from key(seed).
        key = jax.random.fold_in(jax.random.key(seed), 2**31 - 1)
        keys = jax.vmap(lambda _: key)(self.seeds)
        found = self.evaluator.evaluate(state, keys, episodes, deterministic)
        return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), found)

    def _evaluated(self, state: TrainState, due: bool) -> tuple[TrainState, Row]:
        """The state as `q_bias` leaves it, and all columns of evaluations: nan where none is due."""
        jax.block_until_ready(state)  # what is still computed is no evaluation
        with self.clock.evaluate() if due and self.eval_every else contextlib.nullcontext():
            row = self.evaluation_columns(state if due else None)
            state, columns = self.q_bias(state, due)
        return state, row | columns

    def evaluation_columns(self, state: TrainState | None) -> Row:
        """What an evaluation adds to a row: means over `eval_episodes` deterministic episodes, from the same start
        states every time; nan where `state` is None. No columns without evaluations."""
        if not self.eval_every:
            return {}
        if state is None:
            sizes = (self.layout.num_agents, 1, len(self.env.measures))
            returns, length, measures = (np.full((len(self.seeds), size), np.nan) for size in sizes)
        else:
            found = self.evaluate(state, self.config.eval_episodes, deterministic=True)
            self.best.note(self.step(state), state, found.episode_return)
            returns, length, measures = (leaf.mean(axis=1).reshape(len(self.seeds), -1) for leaf in found)
        columns = {
            f"eval_return_{team}": returns @ self.team_weights(team) for team in dict.fromkeys(self.layout.teams)
        }
        columns["eval_episode_length"] = length[:, 0]
        columns |= {f"eval_{name}": measures[:, k] for k, name in enumerate(self.env.measures)}
        columns |= {f"{agent}_eval_return": returns[:, i] for i, agent in enumerate(self.layout.agents)}
        return columns

    def q_bias(self, state: TrainState, due: bool) -> tuple[TrainState, Row]:
        """The state with its reservoir restarted, and what an evaluation says of the critics (see
        `overestimation.columns`); the same state and nan where none is due, or there was no rollout since the last.
        No columns with diagnostics.q_bias off."""
        if state.reservoir is None:
            return state, {}
        found = None
        if due and int(state.rollouts) > int(state.reservoir.since):
            found = self.evaluator.measure_q_bias(state, self.config.diagnostics.q_bias_steps)
            state = self.evaluator.restart_reservoir(state)
        if found is not None:
            found = Values(*(leaf[..., np.array(self.layout.learners)] for leaf in found))
        return state, overestimation.columns(self.layout.learning_agents, found, len(self.seeds))


def _made(config: Config) -> Environment:
    """The environment that the settings name. Raises UserError where a run was given one as an object."""
    name = config.env["name"]
    if name not in envs.names():
        raise UserError(
            f"no environment is called {name!r}: one that was given as an object takes Python, "
            f"matd3_jax.resume(RUN_DIR, env={name}(...))"
        )
    return envs.make(**config.env)
