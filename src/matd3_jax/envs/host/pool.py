"""Copies of one environment on the host: who has which, and who steps them."""

import contextlib
import itertools
import os
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, Protocol

import numpy as np

from matd3_jax.errors import HostError


class Outcome(NamedTuple):
    """What a step came to, besides what is seen then."""

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


class Pool:
    """Copies of one environment, made as they are needed, each under the number that states of the program bear.

    A state is only a reference, so it goes forward alone: the copy is where the last step left it. A state at the
    beginning of an episode is more: it can be stepped any number of times, as its seed makes it anew.

    Args:
        make: a new copy.
        threads: that share a batch; more than one helps where stepping releases Python's lock, as MuJoCo does.
        name: of the environment, for errors.
    """

    def __init__(self, make: Callable[[], Simulation], threads: int, name: str):
        self._make, self._threads, self._name = make, threads, name
        self._lock, self._numbers = threading.Lock(), itertools.count()
        self._used: dict[int, Slot] = {}
        self._free: list[Simulation] = []
        # Never in the thread of the compiled program: there, making MuJoCo's data ended the process.
        self._executor = ThreadPoolExecutor(max(threads, os.cpu_count() or 1), thread_name_prefix="environments")

    @property
    def used(self) -> int:
        """How many copies are in the middle of an episode."""
        return len(self._used)

    def give(self, simulation: Simulation) -> None:
        """Add a copy that nobody uses."""
        with self._lock:
            self._free.append(simulation)

    # ---- for the program: rows of int32, a robot or game each -------------------------------------------------------

    def reset(self, seeds: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        """Begin episodes: the copies' numbers [rows], and what is seen in each."""

        def begin(seed: int) -> tuple[int, np.ndarray]:
            number, slot = self._begin(int(seed))
            return number, slot.simulation.seen()

        found = self._each(begin, seeds)
        return np.array([number for number, _ in found]), [seen for _, seen in found]

    def take(self, numbers: np.ndarray, steps: np.ndarray, seeds: np.ndarray) -> list[tuple[int, Slot | None]]:
        """Claim the copies of states for the next step: (number, copy), None for one that is yet to be made.

        Raises HostError where a copy has gone on from the state.
        """
        found: list[tuple[int, Slot | None]] = []
        with self._lock:
            for number, step, seed in zip(numbers.tolist(), steps.tolist(), seeds.tolist(), strict=True):
                slot = self._used.get(number)
                if slot is not None and (slot.step, slot.seed) == (step, seed):
                    slot.step += 1
                    found.append((number, slot))
                elif step == 0:
                    found.append((number, None))
                else:
                    raise HostError(
                        f"{self._name} cannot be put back to an earlier state (env step {step} of an episode): it is "
                        "stepped in Python, and states are references to it"
                    )
        return found

    def step(
        self, taken: Sequence[tuple[int, Slot | None]], seeds: np.ndarray, actions: np.ndarray, limit: int
    ) -> list[tuple[int, Slot, Outcome, np.ndarray]]:
        """Step claimed copies: (number, copy, outcome, what is seen) each. Truncates at `limit` env steps."""

        def one(row: int) -> tuple[int, Slot, Outcome, np.ndarray]:
            number, slot = taken[row]
            if slot is None:
                number, slot = self._begin(int(seeds[row]))
                slot.step = 1
            outcome = self._guarded("step", slot.simulation.step, actions[row])
            if slot.step >= limit:
                outcome = outcome._replace(truncated=True)
            return number, slot, outcome, slot.simulation.seen()

        return self._each(one, range(len(taken)))

    def restart(self, slots: Sequence[Slot], seeds: Sequence[int]) -> list[np.ndarray]:
        """Begin new episodes in copies that have ended one: what is seen in each."""

        def one(pair: tuple[Slot, int]) -> np.ndarray:
            slot, seed = pair
            self._guarded("reset", slot.simulation.reset, seed)
            slot.seed, slot.step = seed, 0
            return slot.simulation.seen()

        return self._each(one, list(zip(slots, seeds, strict=True)))

    def release(self, numbers: Sequence[int]) -> None:
        """Take back copies that have ended an episode."""
        with self._lock:
            self._free += [self._used.pop(number).simulation for number in numbers]

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

    # ---- inside ------------------------------------------------------------------------------------------------------

    def _begin(self, seed: int) -> tuple[int, Slot]:
        slot = Slot(self._copy(), seed)
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

    def _guarded(self, what: str, function: Callable, *arguments: Any) -> Any:
        try:
            with quiet():
                return function(*arguments)
        except Exception as error:
            words = " ".join(str(error).split())
            raise HostError(f"{self._name}: {what} raised {type(error).__name__}: {words}") from error

    def _each(self, function: Callable[[Any], Any], items: Sequence[Any] | np.ndarray) -> list[Any]:
        """`function` of all items, which the threads share."""
        parts = min(self._threads, len(items))
        if not parts:
            return []
        shares = [items[part::parts] for part in range(parts)]
        done = list(self._executor.map(lambda share: [function(item) for item in share], shares))
        return [done[i % parts][i // parts] for i in range(len(items))]


def quiet() -> contextlib.AbstractContextManager:
    """No warnings of MuJoCo, of models that are old and of robots that blow up, where it is in use."""
    if "mujoco" not in sys.modules:
        return contextlib.nullcontext()
    from matd3_jax.envs.robots.quiet import quiet_mujoco

    return quiet_mujoco()
