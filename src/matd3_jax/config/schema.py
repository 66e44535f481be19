"""The settings of a run, as dataclasses: each field says what it affects, and which values it may have.

Defaults are in the YAML files and nowhere else; what the settings mean is said there, too.
"""

import dataclasses
import enum
from collections.abc import Mapping
from typing import Any

from matd3_jax.bounds import Bounds
from matd3_jax.config.coerce import plain
from matd3_jax.core.algorithm import Algorithm, HyperParams


class Affects(enum.StrEnum):
    """What a setting changes."""

    LEARNING = "learning"
    """A number by which a run learns; runs of one compiled program may differ in it."""
    SHAPES = "shapes"
    """What is computed: a sweep over it is split into programs."""
    SEEDS = "seeds"
    """Which seeds there are, each of which learns by itself."""
    BOOKKEEPING = "bookkeeping"
    """How long a run goes and what it leaves behind; not how it learns."""


_ALWAYS = object()


def setting(
    affects: Affects,
    *,
    before: Any = _ALWAYS,
    splits: bool = False,
    reported: bool = False,
    text: bool = False,
    least: float | None = None,
    most: float | None = None,
    above: float | None = None,
    choices: tuple[str, ...] | None = None,
) -> Any:
    """Declare a field of the settings.

    Args:
        before: what was in effect in runs from before the field was there.
        splits: of bookkeeping: runs of one compiled program must nevertheless agree in it.
        reported: of bookkeeping: the numbers that a run reports of a seed depend on it.
        text: taken from the command line as it is typed, not in Hydra's grammar.
        least, most, above, choices: allowed values (see `Bounds`), of each member of a tuple.
    """
    meta = {"affects": affects, "splits": splits, "reported": reported, "text": text}
    if before is not _ALWAYS:
        meta["before"] = before
    return dataclasses.field(metadata={**meta, "bounds": Bounds(least, most, above, choices)})


LEARNING, SHAPES, SEEDS, BOOKKEEPING = Affects


@dataclasses.dataclass(frozen=True)
class AlgoConfig:
    """One team's algorithm and hyper-parameters; algo/*.yaml says what each means."""

    name: str = setting(SHAPES)
    joint: bool = setting(SHAPES)
    hands_over: bool = setting(SHAPES, before=False)
    handover: str = setting(SHAPES, choices=("join", "distill"), before="join")
    distillation_updates: int = setting(SHAPES, least=1, before=10000)
    critic: str = setting(SHAPES, choices=("central", "own", "shared"))
    share_parameters: str = setting(SHAPES, choices=("none", "kind"), before="none")
    num_critics: int = setting(SHAPES, least=1)
    target_critics: int | None = setting(SHAPES, least=1, before=None)
    actor_critics: str = setting(SHAPES, choices=("first", "all"), before="first")
    policy_delay: int = setting(SHAPES, least=1)
    target_noise: float = setting(LEARNING, least=0)
    target_noise_clip: float = setting(LEARNING, least=0)
    adversarial_step: float = setting(LEARNING, least=0, before=0.0)
    adversarial_step_team: float = setting(LEARNING, least=0, before=0.0)
    actor_lr: float = setting(LEARNING, above=0)
    critic_lr: float = setting(LEARNING, above=0)
    gamma: float = setting(LEARNING, least=0, most=1)
    tau: float = setting(LEARNING, least=0, most=1)
    hidden: tuple[int, ...] = setting(SHAPES, least=1)
    clip: str = setting(SHAPES, choices=("variable", "network", "none"))
    max_grad_norm: float = setting(LEARNING, above=0)
    logit_regularizer: float = setting(LEARNING, least=0)
    exploration_noise: float | tuple[float, float] = setting(LEARNING, least=0)
    sync_targets: bool = setting(SHAPES)
    adam: str = setting(SHAPES, choices=("standard", "epsilon_hat"))
    actor_output: str = setting(SHAPES, choices=("sigmoid", "tanh"), before="sigmoid")
    actor_average: float = setting(SHAPES, least=0, most=1, before=0.0)
    reward_scale: float = setting(SHAPES, above=0, before=1.0)
    actor: str = setting(SHAPES, choices=("mlp", "gru"), before="mlp")
    gru_units: int = setting(SHAPES, least=1, before=64)
    critic_norm: str = setting(SHAPES, choices=("none", "layer"), before="none")
    critic_head: str = setting(SHAPES, choices=("scalar", "categorical", "quantile"), before="scalar")
    critic_atoms: int = setting(SHAPES, least=2, before=51)
    critic_range: tuple[float, float] | None = setting(SHAPES, before=None)
    critic_quantiles: int = setting(SHAPES, least=1, before=25)
    dropped_quantiles: int = setting(SHAPES, least=0, before=2)
    frozen: bool = setting(SHAPES, before=False)
    policy: str | None = setting(SHAPES, before=None, text=True)
    policy_checkpoint: str | None = setting(SHAPES, before=None, text=True)
    policy_seed: int | None = setting(SHAPES, before=None, least=0)

    @property
    def adversarial(self) -> bool:
        """Whether the others' actions are moved against each agent."""
        return self.adversarial_step > 0 or self.adversarial_step_team > 0

    def algorithm(self) -> Algorithm:
        """What fixes the shape of the learner."""
        noise_range = isinstance(self.exploration_noise, tuple)
        derived: dict[str, Any] = {
            "smoothing": self.target_noise > 0, "noise_range": noise_range, "adversarial": self.adversarial
        }  # fmt: skip
        shared = {field.name for field in dataclasses.fields(Algorithm)} - set(derived)
        return Algorithm(**derived, **{name: getattr(self, name) for name in shared})

    def hyper_params(self) -> HyperParams:
        """What may differ between runs of one program."""
        noise = self.exploration_noise
        low, high = noise if isinstance(noise, tuple) else (noise, noise)
        same = {name: getattr(self, name) for name in HYPER_PARAMS if name != "exploration_noise"}
        if not self.adversarial:  # no numbers of the program then
            same |= dict.fromkeys(("adversarial_step", "adversarial_step_team"))
        return HyperParams(**same, exploration_noise=low, exploration_noise_high=high)


@dataclasses.dataclass(frozen=True)
class DiagnosticsConfig:
    """What a run measures of itself besides its returns; config.yaml says what each means."""

    q_bias: bool = setting(BOOKKEEPING, before=False)
    q_bias_rollouts: int = setting(BOOKKEEPING, least=1, before=200)
    q_bias_steps: int = setting(BOOKKEEPING, least=1, before=100)


LOGGERS = ("csv", "tensorboard", "wandb", "mlflow")
"""Where the rows of the metrics table can go; csv, the table itself, is always among them."""


@dataclasses.dataclass(frozen=True)
class WandbConfig:
    """Where a run is on Weights & Biases; config.yaml says what each means."""

    project: str | None = setting(BOOKKEEPING, before=None)
    entity: str | None = setting(BOOKKEEPING, before=None)
    mode: str | None = setting(BOOKKEEPING, before=None, choices=("online", "offline", "disabled"))


@dataclasses.dataclass(frozen=True)
class MlflowConfig:
    """Where a run is in MLflow; config.yaml says what each means."""

    tracking_uri: str | None = setting(BOOKKEEPING, before=None)
    experiment: str | None = setting(BOOKKEEPING, before=None)


@dataclasses.dataclass(frozen=True)
class Config:
    """All settings of a run; config.yaml says what each means."""

    recipe: str = setting(SHAPES, before="paper")
    env: Mapping[str, Any] = setting(SHAPES)
    """Name and options of the environment, for `envs.make`."""
    algo: AlgoConfig = setting(SHAPES)
    adversary: AlgoConfig | None = setting(SHAPES)
    """The opponents' algorithm; None: the same as `algo`."""
    total_steps: int = setting(BOOKKEEPING, splits=True, reported=True, least=1)
    seeds: int = setting(SEEDS, least=1)
    seed: int = setting(SEEDS, least=0, most=2**31 - 1)
    num_envs: int = setting(SHAPES, least=1)
    rollout_length: int = setting(SHAPES, least=1)
    updates_per_collect: int = setting(SHAPES, least=1)
    batch_size: int = setting(SHAPES, least=1)
    shared_minibatch: bool = setting(SHAPES)
    update_order: str = setting(SHAPES, choices=("simultaneous", "sequential", "random_sequential"))
    n_step: int = setting(SHAPES, least=1, before=1)
    sequence_length: int = setting(SHAPES, least=1, before=16)
    burn_in: int = setting(SHAPES, least=0, before=8)
    normalize_observations: bool = setting(SHAPES, before=False)
    normalize_least_deviation: float = setting(SHAPES, least=0, before=0.0)
    replay_capacity: int = setting(SHAPES, least=1)
    learning_starts: int = setting(SHAPES, least=1)
    warmup: str = setting(SHAPES, choices=("policy", "random"))
    switch_at: int | None = setting(SHAPES, least=1, before=None)
    init: str | None = setting(SHAPES, before=None, text=True)
    init_checkpoint: str | None = setting(SHAPES, before=None, text=True)
    init_seed: int | None = setting(SHAPES, before=None, least=0)
    name: str | None = setting(BOOKKEEPING, text=True)
    out: str = setting(BOOKKEEPING, text=True)
    log_every: int | None = setting(BOOKKEEPING, splits=True, least=1)
    eval_every: int | None = setting(BOOKKEEPING, splits=True, reported=True, least=0, before=0)
    eval_episodes: int = setting(BOOKKEEPING, splits=True, reported=True, least=1, before=10)
    diagnostics: DiagnosticsConfig = setting(BOOKKEEPING, splits=True, reported=True)
    checkpoint_every: int | None = setting(BOOKKEEPING, least=0)
    checkpoint_minutes: float = setting(BOOKKEEPING, least=0, before=10.0)
    keep_checkpoints: int = setting(BOOKKEEPING, least=1)
    logger: tuple[str, ...] = setting(BOOKKEEPING, before=("csv",), choices=LOGGERS)
    logger_seeds: str = setting(BOOKKEEPING, before="runs", choices=("runs", "bands"))
    wandb: WandbConfig = setting(BOOKKEEPING)
    mlflow: MlflowConfig = setting(BOOKKEEPING)
    video_every: int = setting(BOOKKEEPING, least=0, before=0)
    on_divergence: str = setting(BOOKKEEPING, splits=True, choices=("continue", "stop_seed", "stop"), before="continue")

    def teams(self) -> dict[str, AlgoConfig]:
        """The algorithm of each team."""
        return {"agents": self.algo, "adversaries": self.adversary or self.algo}

    @property
    def recurrent(self) -> bool:
        """Whether networks of a team that learns have states."""
        return any(team.actor == "gru" and not team.frozen for team in self.teams().values())

    @property
    def hands_over(self) -> bool:
        """Whether the agents of a team learn first, and one agent in their place from `switch_at` on."""
        return any(team.hands_over and not team.frozen for team in self.teams().values())

    @property
    def seed_numbers(self) -> range:
        """The numbers of the seeds."""
        return range(self.seed, self.seed + self.seeds)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as `from_dict` takes them."""
        return plain(dataclasses.asdict(self))


# ---- what follows from the fields ------------------------------------------------------------------------------------


def keys(cls: type, *affects: Affects, **metadata: Any) -> tuple[str, ...]:
    """The names of the fields that affect one of these, whose metadata have these values; in their order."""
    fields = [field for field in dataclasses.fields(cls) if not affects or field.metadata["affects"] in affects]
    return tuple(f.name for f in fields if all(f.metadata[key] == value for key, value in metadata.items()))


def _before(cls: type) -> dict[str, Any]:
    return {f.name: f.metadata["before"] for f in dataclasses.fields(cls) if "before" in f.metadata}


HYPER_PARAMS = keys(AlgoConfig, LEARNING)
"""Settings of an algorithm that may differ between runs of one program."""

TEXTS = (
    *keys(Config, text=True),
    *(f"{team}.{name}" for team in ("algo", "adversary") for name in keys(AlgoConfig, text=True)),
)
"""Settings that are taken as they are typed."""

OF_FROZEN = ("frozen", "policy", "policy_checkpoint", "policy_seed")
"""Settings of a team that does not learn; its others are those of the run that its policy is of."""

RECORDS = keys(Config, BOOKKEEPING)
"""Settings that say how long a run goes and what it leaves behind; they do not change how it learns."""

UNREPORTED = keys(Config, SEEDS, BOOKKEEPING, reported=False)
"""Settings that the numbers which a run reports of one seed do not depend on (but for the seed's own)."""

UNSHARED = keys(Config, SEEDS, BOOKKEEPING, splits=False)
"""Settings in which runs of one compiled program may differ, besides `HYPER_PARAMS`."""

ADDED_LATER = {
    **_before(Config),
    "diagnostics": _before(DiagnosticsConfig),
    "wandb": _before(WandbConfig),
    "mlflow": _before(MlflowConfig),
    "algo": _before(AlgoConfig),
    "adversary": _before(AlgoConfig),
}
"""Keys that runs from before them lack, with the values that those runs had in effect; a group may lack some, too."""

_ROBOTS = ("ant", "half_cheetah", "hopper", "walker2d", "humanoid", "swimmer")

OPTIONS_ADDED_LATER: dict[str, dict[str, Any]] = {
    "simple_speaker_listener": {"speaking_steps": None},
    **{f"{engine}{robot}": {"velocities": True} for robot in _ROBOTS for engine in ("", "brax_")},
}
"""Options of environments that runs from before them lack, with the values that those runs had in effect."""

RENAMED = {
    "normalise_observations": "normalize_observations",
    "normalise_least_deviation": "normalize_least_deviation",
    "logit_regulariser": "logit_regularizer",
}
"""Keys that runs from before have under other names."""
