"""Copies of one environment on the host: who has which, and who steps them."""

import contextlib
import itertools
import os
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, Protocol

import numpy as np

from matd3_jax.errors import HostError, described

TERMINATED, TRUNCATED = 1, 2
"""Bits of how an episode ended."""

REMEMBERED = 256
"""Copies that were given back whose last answer is kept."""


class Outcome(NamedTuple):
    """The result of a step, besides what is seen then."""

    reward: np.ndarray
    """[num_agents]"""
    terminated: bool
    truncated: bool


class Simulation(Protocol):
    """One copy of an environment."""

    def reset(self, seed: int) -> None:
        """Begin the episode that `seed` gives."""

    def step(self, action: np.ndarray) -> Outcome:
        """Let all agents act once: `action` is int32, one behind the other, real numbers as their float32 bits."""

    def seen(self) -> np.ndarray:
        """All that is to be seen now: float32 [size]."""

    def memory(self) -> Any:
        """What a copy needs to go on from here: something that can be pickled (`Pool.dump`)."""

    def remember(self, memory: Any) -> None:
        """Go on from where `memory` was taken."""


class Slot:
    """A copy in use."""

    def __init__(self, simulation: Simulation, seed: int, step: int = 0):
        self.simulation, self.seed, self.step = simulation, seed, step
        self.last: Answered | None = None


class Answered(NamedTuple):
    """A question, and what was answered."""

    asked: bytes
    answer: np.ndarray


class Pool:
    """Copies of one environment, made as they are needed, each under the number that states of the program bear.

    A state is only a reference, so it goes forward alone: the copy is where the last step left it. Two exceptions make
    calls from a compiled program safe. A state at the beginning of an episode can be stepped any number of times, as
    its seed makes it again: a program may have one reset for several episodes with the same key. And what was asked
    last of a copy is answered again without a step.

    Questions and answers are rows of int32, real numbers in them as their float32 bits. All methods can be called from
    several threads.

    Args:
        make: a new copy.
        threads: that share a batch; more than one helps where stepping releases Python's lock, as MuJoCo does.
        limit: env steps after which an episode is truncated.
        name: of the environment, for errors.
    """

    def __init__(self, make: Callable[[], Simulation], threads: int, limit: int, name: str):
        self._make, self._threads, self._limit, self._name = make, threads, limit, name
        self._lock, self._numbers = threading.Lock(), itertools.count()
        self._used: dict[int, Slot] = {}
        self._free: list[Simulation] = []
        self._ended: OrderedDict[int, Answered] = OrderedDict()
        # Never in the thread of the compiled program: there, making MuJoCo's data ended the process.
        self._executor = ThreadPoolExecutor(max(threads, os.cpu_count() or 1), thread_name_prefix="environments")

    @property
    def used(self) -> int:
        """How many copies are in the middle of an episode."""
        return len(self._used)

    def reset(self, seeds: np.ndarray) -> np.ndarray:
        """Begin episodes: rows (number of the copy, seen)."""

        def begin(seed: int) -> np.ndarray:
            number, slot = self._begin(int(seed))
            return np.concatenate([np.array([number], np.int32), self._seen(slot)])

        return np.stack(self._each(begin, seeds))

    def step(self, rows: np.ndarray, reset_seeds: np.ndarray | None = None) -> list[np.ndarray]:
        """Step copies: rows (number of the copy, `TERMINATED` and `TRUNCATED`, rewards, seen).

        Args:
            rows: (number, env steps so far, seed, actions).
            reset_seeds: begin new episodes with these in the copies whose episodes end, and append what is seen then,
                of others zeros. None: such copies are given back.

        Raises HostError where a copy has gone on from the state that a row stands for.
        """
        seeds = np.full(len(rows), -1) if reset_seeds is None else reset_seeds
        claimed = self._claim(rows, seeds)

        def one(row: int) -> np.ndarray:
            found = claimed[row]
            if isinstance(found, Answered):
                return found.answer
            number, slot = (int(rows[row, 0]), found) if found is not None else self._begin(int(rows[row, 2]), step=1)
            answer = self._advance(number, slot, rows[row, 3:], int(seeds[row]))
            slot.last = Answered(_question(rows[row], seeds[row]), answer)
            if reset_seeds is None and answer[1]:
                self._give_back(number, slot)
            return answer

        return self._each(one, range(len(rows)))

    # ---- for checkpoints ---------------------------------------------------------------------------------------------

    def dump(self, numbers: np.ndarray) -> Any:
        """What the copies of these numbers need to go on, to be pickled."""
        slots = [self._used[number] for number in numbers.tolist()]
        return [(slot.simulation.memory(), slot.seed, slot.step) for slot in slots]

    def load(self, dumped: Any) -> np.ndarray:
        """Make copies that go on from what `dump` gave: their numbers."""
        numbers = []
        for memory, seed, step in dumped:
            simulation = self._copy()
            simulation.remember(memory)
            numbers.append(self._use(Slot(simulation, seed, step)))
        return np.array(numbers, np.int32)

    def release(self, numbers: Sequence[int]) -> None:
        """Take back copies in the middle of episodes."""
        with self._lock:
            self._free += [self._used.pop(number).simulation for number in numbers]

    # ---- inside ------------------------------------------------------------------------------------------------------

    def _claim(self, rows: np.ndarray, reset_seeds: np.ndarray) -> list[Slot | Answered | None]:
        """The copy that each row moves, None for one that is yet to be made, or what was answered before."""
        found: list[Slot | Answered | None] = []
        with self._lock:
            for row, reset_seed in zip(rows, reset_seeds, strict=True):
                number, step, seed = row[:3].tolist()
                slot = self._used.get(number)
                if slot is not None and (slot.step, slot.seed) == (step, seed):
                    slot.step, slot.last = step + 1, None
                    found.append(slot)
                    continue
                last = self._ended.get(number) if slot is None else slot.last
                if step == 0:
                    found.append(None)
                elif last is not None and last.asked == _question(row, reset_seed):
                    found.append(last)
                else:
                    raise HostError(
                        f"{self._name} cannot be put back to an earlier state (env step {step} of an episode): it is "
                        "stepped in Python, and states are references to it"
                    )
        return found

    def _advance(self, number: int, slot: Slot, action: np.ndarray, reset_seed: int) -> np.ndarray:
        """Step a claimed copy, and reset it where that ends its episode and a seed is given."""
        outcome = self._guarded("step", slot.simulation.step, action)
        end = TERMINATED * outcome.terminated | TRUNCATED * (outcome.truncated or slot.step >= self._limit)
        head = np.array([number, end], np.int32)
        reward, seen = np.asarray(outcome.reward, np.float32).view(np.int32), self._seen(slot)
        if reset_seed < 0:
            return np.concatenate([head, reward, seen])
        fresh = np.zeros_like(seen)
        if end:
            self._guarded("reset", slot.simulation.reset, reset_seed)
            slot.seed, slot.step = reset_seed, 0
            fresh = self._seen(slot)
        return np.concatenate([head, reward, seen, fresh])

    def _seen(self, slot: Slot) -> np.ndarray:
        return np.ascontiguousarray(self._guarded("observing", slot.simulation.seen), np.float32).view(np.int32)

    def _begin(self, seed: int, step: int = 0) -> tuple[int, Slot]:
        """Reset a copy that nobody uses. step: that it is claimed for, 1 of the first."""
        slot = Slot(self._copy(), seed, step)
        self._guarded("reset", slot.simulation.reset, seed)
        return self._use(slot), slot

    def _copy(self) -> Simulation:
        with self._lock:
            if self._free:
                return self._free.pop()
        return self._guarded("making another copy", self._make)

    def _use(self, slot: Slot) -> int:
        with self._lock:
            number = next(self._numbers)
            self._used[number] = slot
        return number

    def _give_back(self, number: int, slot: Slot) -> None:
        with self._lock:
            if slot.last is not None:
                self._ended[number] = slot.last
            while len(self._ended) > REMEMBERED:
                self._ended.popitem(last=False)
            del self._used[number]
            self._free.append(slot.simulation)

    def _guarded(self, what: str, function: Callable, *arguments: Any) -> Any:
        try:
            with quiet():
                return function(*arguments)
        except Exception as error:
            raise HostError(f"{self._name}: {what} raised {described(error)}") from error

    def _each(self, function: Callable[[Any], Any], items: Sequence[Any] | np.ndarray) -> list[Any]:
        """`function` of all items, which the threads share."""
        parts = min(self._threads, len(items))
        if not parts:
            return []
        shares = [items[part::parts] for part in range(parts)]
        done = list(self._executor.map(lambda share: [function(item) for item in share], shares))
        return [done[i % parts][i // parts] for i in range(len(items))]


def _question(row: np.ndarray, reset_seed: np.ndarray) -> bytes:
    return row.tobytes() + reset_seed.tobytes()


def quiet() -> contextlib.AbstractContextManager:
    """No warnings of MuJoCo, of models that are old and of robots that blow up, where it is in use."""
    if "mujoco" not in sys.modules:
        return contextlib.nullcontext()
    from matd3_jax.envs.robots.quiet import quiet_mujoco

    return quiet_mujoco()
