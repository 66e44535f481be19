"""Environments on the host that a function makes copies of, and that are asked once what they are."""

import abc
from collections.abc import Callable
from functools import cached_property
from typing import Any, Generic, Protocol, TypeVar

from matd3_jax.envs.environment import check_count
from matd3_jax.envs.host.environment import HostEnvironment, asking
from matd3_jax.envs.host.pool import Simulation
from matd3_jax.errors import OptionError


class Limited(Protocol):
    """What is known of an environment before it is played."""

    @property
    def limit(self) -> int | None:
        """Env steps after which it truncates, where it says so."""


Facts = TypeVar("Facts", bound=Limited)


class MadeEnvironment(HostEnvironment, Generic[Facts]):
    """What the environments of all libraries on the host share."""

    @abc.abstractmethod
    def _source(self) -> tuple[Callable[[], Any], Any]:
        """(a function that makes copies, the first copy)"""

    @abc.abstractmethod
    def _wrong(self, found: Any) -> str | None:
        """What is wrong with an object that the function made, to be said after its type; None: nothing."""

    @abc.abstractmethod
    def _ask(self, found: Any) -> Facts:
        """What a copy is."""

    @abc.abstractmethod
    def _simulation(self, found: Any) -> Simulation:
        """A copy as the pool plays it."""

    def _check_length(self) -> None:
        """Raise OptionError for an `episode_length` that is no number of env steps."""
        if self.episode_length is not None:
            check_count("episode_length", self.episode_length, 1)

    def _take_length(self, why: str) -> None:
        """Take the environment's own limit where no `episode_length` is given.

        Raises OptionError where it has none; `why` is said of it, after its name.
        """
        if self.episode_length is None:
            if self.facts.limit is None:
                raise OptionError(f"{self.name} {why}: give env.episode_length=")
            object.__setattr__(self, "episode_length", self.facts.limit)

    @cached_property
    def _made(self) -> tuple[Callable[[], Any], Facts, list[Any]]:
        """(what makes copies, what they are, the first copy until it is used)"""
        make, first = self._source()
        wrong = self._wrong(first)
        if wrong is not None:
            raise OptionError(f"{self.name} gives a {type(first).__name__}, which {wrong}")
        with asking(self.name):
            return make, self._ask(first), [first]

    @property
    def facts(self) -> Facts:
        """What the copies are."""
        return self._made[1]

    def simulation(self) -> Simulation:
        make, _, first = self._made
        try:
            return self._simulation(first.pop())
        except IndexError:
            return self._simulation(make())
