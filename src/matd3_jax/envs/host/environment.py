"""What all environments on the host share: states that stand for copies in a pool, and the callbacks that move them."""

import abc
import contextlib
import io
import os
from collections.abc import Iterator
from functools import cached_property
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from matd3_jax.envs.environment import Environment, TimeStep
from matd3_jax.envs.host import pickling
from matd3_jax.envs.host.call import bits, call, floats
from matd3_jax.envs.host.pool import TERMINATED, TRUNCATED, Pool, Simulation, quiet
from matd3_jax.envs.spaces import Box
from matd3_jax.errors import OptionError, described, one_line

RUNNING = 0
"""`HostState.end` of an episode that has not ended."""


class HostState(NamedTuple):
    """One environment between two env steps: a reference to the copy on the host, and what is to be seen of it."""

    number: chex.Array
    """int32 scalar: the copy's, in the environment's pool."""
    step: chex.Array
    """int32 scalar: env steps since the reset."""
    seed: chex.Array
    """int32 scalar: that the copy was reset with."""
    end: chex.Array
    """int32 scalar: `RUNNING`, or bits of how the episode ended (`pool.TERMINATED`, `TRUNCATED`), after which nothing
    moves any more."""
    seen: chex.Array
    """float32 [seen_size]: all that is to be seen."""


class HostEnvironment(Environment):
    """An environment of another library, stepped in Python on the host.

    A reset seeds a copy with a number that its key gives, so that an episode follows from the key and the actions as
    far as the environment keeps to its seed. An action that is not finite counts as the middle of its range. After its
    end an episode stands still, with reward 0.

    States are references: see `pool.Pool`. Options that all have: `episode_length`, env steps until truncation (None:
    what the environment says itself), and `pickle`, whether checkpoints hold the copies.
    """

    # ---- what a library's own class says -----------------------------------------------------------------------------

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """What errors call it."""

    @property
    @abc.abstractmethod
    def seen_size(self) -> int:
        """Entries of what is seen of a state."""

    @property
    @abc.abstractmethod
    def num_rewards(self) -> int:
        """Rewards that a step gives: one for each agent, or one for all."""

    @abc.abstractmethod
    def simulation(self) -> Simulation:
        """A new copy."""

    @property
    @abc.abstractmethod
    def pickle(self) -> bool: ...

    @property
    def threads(self) -> int:
        """That share a batch of copies."""
        return 1

    # ---- the contract ------------------------------------------------------------------------------------------------

    @property
    def on_host(self) -> bool:
        return True

    def reset(self, key: chex.PRNGKey) -> tuple[HostState, tuple[chex.Array, ...]]:
        row = call(self._reset, 1 + self.seen_size, _seed(key)[None])
        state = HostState(row[0], jnp.int32(0), _seed(key), jnp.int32(RUNNING), floats(row[1:]))
        return state, self.observe(state)

    def step(self, key: chex.PRNGKey, state: HostState, action: tuple[chex.Array, ...]) -> TimeStep:
        """All agents act once; the copy draws its own random numbers, `key` is not used."""
        del key
        row = call(self._step, 2 + self.num_rewards + self.seen_size, self._row(state, action))
        return self._after(state, row)

    def step_or_reset(
        self, key: chex.PRNGKey, reset_key: chex.PRNGKey, state: HostState, action: tuple[chex.Array, ...]
    ) -> tuple[TimeStep, HostState, tuple[chex.Array, ...]]:
        """One callback for both: a copy is reset where its episode ended, and nowhere else."""
        del key
        seed, size = _seed(reset_key), 2 + self.num_rewards + self.seen_size
        row = call(self._step_or_reset, size + self.seen_size, jnp.concatenate([seed[None], self._row(state, action)]))
        after = self._after(state, row[:size])
        fresh = HostState(after.state.number, jnp.int32(0), seed, jnp.int32(RUNNING), floats(row[size:]))
        ended = after.state.end != RUNNING
        going = jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, after.state)
        return after, going, self.observe(going)

    def _row(self, state: HostState, action: tuple[chex.Array, ...]) -> chex.Array:
        return jnp.concatenate([jnp.stack([state.end, state.number, state.step, state.seed]), self.played(action)])

    def played(self, action: tuple[chex.Array, ...]) -> chex.Array:
        """All actions as the simulation takes them: int32, those of boxes as bits."""
        return jnp.concatenate(
            [
                bits(part) if isinstance(space, Box) else jnp.asarray(part, jnp.int32).reshape(-1)
                for space, part in zip(self.action_spaces, action, strict=True)
            ]
        )

    def _after(self, state: HostState, row: chex.Array) -> TimeStep:
        still = state.end != RUNNING
        rewards, seen = jnp.split(floats(row[2:]), [self.num_rewards])
        end = jnp.where(still, state.end, row[1])
        after = HostState(
            row[0], jnp.where(still, state.step, state.step + 1), state.seed, end, jnp.where(still, state.seen, seen)
        )
        reward = jnp.broadcast_to(jnp.where(still, 0, rewards), len(self.agents))
        return TimeStep(
            after, self.observe(after), reward, (end & TERMINATED).astype(bool), (end & TRUNCATED).astype(bool)
        )

    # ---- on the host -------------------------------------------------------------------------------------------------

    @cached_property
    def pool(self) -> Pool:
        """The copies of this environment."""
        return Pool(self.simulation, self.threads, self.episode_length, self.name)

    def _reset(self, rows: np.ndarray) -> np.ndarray:
        return self.pool.reset(rows[:, 0])

    def _step(self, rows: np.ndarray) -> np.ndarray:
        return self._stepped(rows, None)

    def _step_or_reset(self, rows: np.ndarray) -> np.ndarray:
        return self._stepped(rows[:, 1:], rows[:, 0])

    def _stepped(self, rows: np.ndarray, reset_seeds: np.ndarray | None) -> np.ndarray:
        """`Pool.step` of the episodes that have not ended, of others zeros.

        rows: (end, number, step, seed, actions).
        """
        going = np.flatnonzero(rows[:, 0] == RUNNING)
        size = 2 + self.num_rewards + self.seen_size * (1 if reset_seeds is None else 2)
        answer = np.zeros((len(rows), size), np.int32)
        answer[:, 0] = rows[:, 1]
        if len(going):
            seeds = None if reset_seeds is None else reset_seeds[going]
            answer[going] = self.pool.step(rows[going, 1:], seeds)
        return answer

    # ---- checkpoints -------------------------------------------------------------------------------------------------

    def dump(self, numbers: np.ndarray) -> bytes:
        """The copies of these numbers, pickled: what `load` goes on from. Raises OptionError where they cannot be."""
        stream = io.BytesIO()
        try:
            pickling.Pickler(stream).dump(self.pool.dump(numbers))
        except Exception as error:
            raise OptionError(
                f"env.pickle=true: {self.name} cannot be pickled ({one_line(error)}); leave it false"
            ) from error
        return stream.getvalue()

    def load(self, dumped: bytes) -> np.ndarray:
        """Numbers of new copies that go on from what `dump` gave. Unpickling runs what the bytes say: trust them."""
        return self.pool.load(pickling.loads(dumped))

    def begin(self) -> None:
        """Make the pool, before several devices ask for it at the same time.

        Raises OptionError where the copies are to be pickled, and one in the middle of an episode cannot be.
        """
        pool = self.pool
        if not self.pickle:
            return
        used = pool.reset(np.zeros(1, np.int32))[:, 0].tolist()
        try:
            used += self.load(self.dump(np.array(used))).tolist()
        finally:
            pool.release(used)


@contextlib.contextmanager
def asking(name: str) -> Iterator[None]:
    """Where an environment is tried for the first time: OptionError for whatever its own code raises."""
    try:
        with quiet():
            yield
    except OptionError:
        raise
    except Exception as error:
        raise OptionError(f"{name} cannot be played: {described(error)}") from error


def cores() -> int:
    """How many threads can run at a time."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _seed(key: chex.PRNGKey) -> chex.Array:
    """A seed that any library takes, of a key: int32, not negative."""
    return (jax.random.bits(key, (), jnp.uint32) >> 1).astype(jnp.int32)
