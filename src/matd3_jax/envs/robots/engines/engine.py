"""The engines that step a robot: C MuJoCo on the host, or MJX in the compiled program. Both keep one interface."""

import functools
from typing import NamedTuple, Protocol

import chex
import jax
import mujoco

from matd3_jax.errors import OptionError, nearest

ENGINES = ("c", "mjx", "mjx_fast")
"""What `physics` may be once "auto" is resolved."""

RENAMED = {"exact": "mjx", "fast": "mjx_fast"}
"""Names of before there was more than one engine; run directories of then hold them."""


class Physical(NamedTuple):
    """What an engine says of a robot."""

    qpos: chex.Array
    """[nq]"""
    qvel: chex.Array
    """[nv]"""
    qacc_warmstart: chex.Array
    """[nv] where the solver of the next step starts."""
    fields: dict[str, chex.Array]
    """Fields of MuJoCo's data by name, as many as were asked for."""


class Engine(Protocol):
    """A robot's model with the program that steps it."""

    @property
    def mj_model(self) -> mujoco.MjModel: ...

    def advance(
        self,
        qpos: chex.Array,
        qvel: chex.Array,
        qacc_warmstart: chex.Array,
        control: chex.Array,
        frame_skip: int,
        fields: tuple[str, ...],
    ) -> Physical:
        """The robot after `frame_skip` simulation steps under constant `control` [nu]; not finite where it blew up.

        Args:
            qpos, qvel, qacc_warmstart: [nq], [nv], [nv].
            fields: of MuJoCo's data, as they are after the last step; `cfrc_ext` is computed if it is among them.
        """

    def place(self, qpos: chex.Array, qvel: chex.Array, fields: tuple[str, ...]) -> Physical:
        """The robot at positions [nq] and velocities [nv] with what follows from these alone: fields that hang on
        forces are 0."""


def resolve(physics: object) -> str:
    """The engine that `physics` names; "auto": "c" where JAX computes on CPUs, "mjx" on accelerators.

    Raises OptionError for another name.
    """
    if physics == "auto":
        return "c" if jax.default_backend() == "cpu" else "mjx"
    if physics in ENGINES:
        return str(physics)
    renamed = RENAMED.get(str(physics))
    hint = f"it is called {renamed!r} now" if renamed else nearest(physics, ("auto", *ENGINES))
    raise OptionError(f"physics={physics!r}: must be one of 'auto', 'c', 'mjx', 'mjx_fast'; {hint}")


@functools.cache
def load(file: str, physics: str) -> Engine:
    """The engine named `physics` (one of `ENGINES`) with one of gymnasium's model files ("ant.xml").

    Importing MJX takes seconds, so it is imported where it is used.
    """
    if physics == "c":
        from matd3_jax.envs.robots.engines import c

        return c.load(file)
    from matd3_jax.envs.robots.engines import mjx

    return mjx.load(file, physics)
