"""gymnasium's environments, their actions shared out among agents."""

import dataclasses
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import chex
import numpy as np

from matd3_jax.envs.environment import check_choice
from matd3_jax.envs.host import sharing, sources
from matd3_jax.envs.host.environment import HostState, cores
from matd3_jax.envs.host.made import MadeEnvironment
from matd3_jax.envs.host.pool import quiet
from matd3_jax.envs.host.sharing import Shares
from matd3_jax.envs.host.single_simulation import Facts, SingleSimulation, ask
from matd3_jax.envs.spaces import ActionSpace, Box
from matd3_jax.errors import OptionError, nearest, one_line


class _Single(MadeEnvironment[Facts]):
    """What gymnasium's environments share; see `Gymnasium`."""

    split: Shares
    observation: str

    def _settle(self) -> None:
        """Check the options, and ask the environment what it is."""
        object.__setattr__(self, "split", sharing.as_split(self.split))
        self._check_length()
        facts = self.facts
        self._take_length("has no time limit of its own")
        if self.split != "single" and not isinstance(facts.action.ours, Box):
            raise OptionError(f"split={self.split!r}: {self.name} takes {facts.action.ours}; only a Box can be shared")
        self.shares, self.observed  # noqa: B018  # raise for what is impossible
        self.begin()

    def _wrong(self, found: Any) -> str | None:
        return None if is_gymnasium(found) else "is no gymnasium environment"

    def _ask(self, found: Any) -> Facts:
        return ask(found, self.name)

    def _simulation(self, found: Any) -> SingleSimulation:
        return SingleSimulation(found, self.facts)

    @property
    def threads(self) -> int:
        return cores() if self.facts.model is not None else 1

    # ---- the contract ------------------------------------------------------------------------------------------------

    @cached_property
    def shares(self) -> tuple[tuple[int, ...], ...]:
        """Entries of the action vector that each agent has; of choices there is one agent."""
        return sharing.share(self.split, self.facts.action.ours.size, self.facts.model)

    @cached_property
    def observed(self) -> tuple[tuple[int, ...], ...]:
        """Entries of the observation that each agent sees."""
        check_choice("observation", self.observation, ("all", "own"))
        facts = self.facts
        if self.observation == "all":
            return (tuple(range(facts.size)),) * len(self.shares)
        if facts.model is None or facts.skipped is None or not isinstance(facts.action.ours, Box):
            raise OptionError(
                f"observation=own: the observation of {self.name} does not begin with a MuJoCo robot's positions and "
                "velocities, so that nobody's own are known; take observation=all"
            )
        return sharing.own_entries(self.shares, facts.model, facts.skipped)

    @property
    def agents(self) -> tuple[str, ...]:
        return tuple(f"agent_{i}" for i in range(len(self.shares)))

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        return tuple(map(len, self.observed))

    @property
    def action_spaces(self) -> tuple[ActionSpace, ...]:
        whole = self.facts.action.ours
        return tuple(Box(len(own), -1.0, 1.0) for own in self.shares) if isinstance(whole, Box) else (whole,)

    @property
    def return_weights(self) -> tuple[float, ...]:
        return (1 / len(self.agents),) * len(self.agents)

    @property
    def entries_in_full_observation(self) -> tuple[tuple[int, ...], ...]:
        return self.observed

    @property
    def full_observation_size(self) -> int:
        return self.facts.size

    @property
    def measures(self) -> tuple[str, ...]:
        return ("forward_velocity",) if self.facts.speed else ()

    @property
    def num_rewards(self) -> int:
        return 1

    @property
    def seen_size(self) -> int:
        """The observation, the measures, and a robot's positions, by which it is drawn."""
        return self.facts.size + len(self.measures) + (0 if self.facts.model is None else self.facts.model.nq)

    def observe(self, state: HostState) -> tuple[chex.Array, ...]:
        full = self.full_observation(state)
        whole = range(self.facts.size)
        return tuple(full if own == tuple(whole) else full[np.array(own)] for own in self.observed)

    def full_observation(self, state: HostState) -> chex.Array:
        return state.seen[: self.facts.size]

    def measure(self, state: HostState) -> chex.Array:
        return state.seen[self.facts.size : self.facts.size + len(self.measures)]

    def played(self, action: tuple[chex.Array, ...]) -> chex.Array:
        whole = super().played(action)
        if not isinstance(self.facts.action.ours, Box):
            return whole
        return whole[np.argsort([entry for own in self.shares for entry in own])]

    # ---- drawing -----------------------------------------------------------------------------------------------------

    @property
    def mj_model(self) -> Any:
        """A robot's `mujoco.MjModel`. Raises AttributeError for others."""
        if self.facts.model is None:
            raise AttributeError("no robot")
        return self.facts.model

    @property
    def agent_bodies(self) -> tuple[tuple[int, ...], ...]:
        """The bodies that each agent moves."""
        return sharing.own_bodies(self.shares, self.mj_model)

    def qpos(self, state: HostState) -> chex.Array:
        """Generalized positions [nq] for `mj_model`."""
        return state.seen[-self.mj_model.nq :]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gymnasium(_Single):
    """An environment of gymnasium, its action vector shared out among agents: `env=gymnasium env.id=Ant-v5`.

    Options: `id`, as `gymnasium.make` takes it ("package:Name-v0" imports the package first); `kwargs`, what it is
    made with; `split` and `observation`, see below; `episode_length`, env steps until truncation (None: the
    environment's own time limit); `pickle`, whether checkpoints hold the environments.

    `split` (see `sharing.share`): `single`; of robots that have the joints of ours the names of their partitions
    (`halves`, `2x4`, `2x4d`, `4x2` of the Ant); of others `halves` or `NxM`, N agents with M consecutive entries each;
    or lists of entries, one for each agent. `observation`: `all`, or `own`, of MuJoCo's robots position and velocity of
    the root and of the agent's own joints. Choices (Discrete) are one agent's. All agents get the environment's reward,
    which is reported once; the full observation is the environment's own, flattened.

    `measures` of walking robots: forward_velocity (m/s).

    Raises OptionError for what cannot be made, has other spaces, or cannot be shared so.
    """

    id: str | None = None
    kwargs: Mapping[str, Any] = sources.Kwargs({})
    split: Shares = "single"
    observation: str = "all"
    episode_length: int | None = None  # type: ignore[assignment]
    pickle: bool = False  # type: ignore[assignment]

    def __post_init__(self) -> None:
        object.__setattr__(self, "kwargs", sources.Kwargs(self.kwargs))
        self._settle()

    @property
    def name(self) -> str:
        return f"gymnasium {self.id}"

    def _source(self) -> tuple[Callable[[], Any], Any]:
        import gymnasium
        import mujoco  # noqa: F401  # so that it is quiet from the first model on

        if not isinstance(self.id, str) or not self.id:
            raise OptionError(f"env.id={self.id!r}: must name an environment of gymnasium, for instance env.id=Ant-v5")

        def make() -> Any:
            limit = {} if self.episode_length is None else {"max_episode_steps": self.episode_length}
            return gymnasium.make(str(self.id), disable_env_checker=True, **{**limit, **self.kwargs})

        try:
            with sources.without_greetings(), quiet():
                return make, make()
        except Exception as error:
            raise OptionError(self._unmade(error)) from error

    def _unmade(self, error: Exception) -> str:
        import gymnasium

        if isinstance(error, gymnasium.error.UnregisteredEnv | gymnasium.error.NamespaceNotFound):
            hint = nearest(self.id, gymnasium.registry) if ":" not in str(self.id) else "see its package"
            hint = hint if len(hint) < 200 else "gymnasium.pprint_registry() lists them"
            return f"env.id={self.id}: gymnasium has no such environment; {hint}"
        if isinstance(error, ImportError):
            return f"env.id={self.id}: a package is missing ({one_line(error)})"
        return sources.unmade(self.id, self.kwargs, error)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class GymnasiumObject(_Single):
    """An instance of a gymnasium environment, which is copied, or a function that makes one: see
    `envs.from_gymnasium`, and `Gymnasium` for what follows from it and the other options."""

    source: Any
    split: Shares = "single"
    observation: str = "all"
    episode_length: int | None = None  # type: ignore[assignment]
    pickle: bool = False  # type: ignore[assignment]

    def __post_init__(self) -> None:
        self._settle()

    @property
    def name(self) -> str:
        return sources.called(self.source)

    def _source(self) -> tuple[Callable[[], Any], Any]:
        return sources.maker(self.source, is_gymnasium)


def is_gymnasium(env: Any) -> bool:
    """Whether an object is an environment with gymnasium's API."""
    import gymnasium

    return isinstance(env, gymnasium.Env) or (
        not isinstance(env, type)
        and all(hasattr(env, name) for name in ("reset", "step", "observation_space", "action_space"))
        and not callable(env.action_space)
    )
