"""The family as data: MATD3, MADDPG, M3DDPG, IL-TD3, IDDPG, TD3 and DDPG are points of one space."""

import dataclasses
from typing import Literal, NamedTuple

import chex


@dataclasses.dataclass(frozen=True)
class Algorithm:
    """What fixes the shape of a learner: static, hashable, one for each team."""

    name: str = "matd3"
    joint: bool = False
    """One agent acts in the whole team's place (TD3, DDPG)."""
    critic: Literal["central", "own", "shared"] = "central"
    """"central": the critics see the joint observation and all actions; "own": the agent's own parts only; "shared":
    as central, and the whole team has one set of them, which learns from the mean of its rewards (HARL's MATD3)."""
    share_parameters: Literal["none", "kind"] = "none"
    """"kind": agents of a team with the same observation size and action space have one actor and one set of critics
    together, whose first layers know whose turn it is (see `sharing`)."""
    num_critics: int = 2
    """The target takes the minimum over that many target critics; the actor climbs the first."""
    target_critics: int | None = None
    """Number of critics that make a target, drawn at random for every agent and update (REDQ); None: all do."""
    actor_critics: Literal["first", "all"] = "first"
    """The actor climbs the first critic's value, or the mean of all critics' (REDQ, TQC)."""
    actor: Literal["mlp", "gru"] = "mlp"
    """"gru": actors and critics have states that sum up what came before in the episode (see `gru`)."""
    gru_units: int = 64
    """Size of these states."""
    critic_norm: Literal["none", "layer"] = "none"
    """"layer": layer normalization before each ReLU of the critics."""
    critic_head: Literal["scalar", "categorical", "quantile"] = "scalar"
    """What a critic gives: a number, a distribution over atoms (C51), or quantiles (TQC)."""
    critic_atoms: int = 51
    """Atoms of the categorical head."""
    critic_range: tuple[float, float] | None = None
    """Returns at the first and last atom, in units of the scaled rewards; needed by the categorical head."""
    critic_quantiles: int = 25
    """Of the quantile head."""
    dropped_quantiles: int = 2
    """Quantiles that the target leaves out for each of its critics: the largest of all critics' together (TQC)."""
    policy_delay: int = 2
    """Actor and targets move with every policy_delay-th update (d in the paper)."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden ReLU layers of actor and critics."""
    clip: Literal["variable", "network", "none"] = "variable"
    """Gradient clipping by the norm of each variable on its own, of each network, or not at all."""
    adam: Literal["standard", "epsilon_hat"] = "standard"
    """"epsilon_hat": epsilon outside the bias correction, as TensorFlow 1 has it."""
    actor_output: Literal["sigmoid", "tanh"] = "sigmoid"
    """How a Box action follows from an actor's output u: low + (high - low) sigmoid(u), or center + half range tanh(u),
    which is the sigmoid of 2u: twice the slope."""
    reward_scale: float = 1.0
    """Of the rewards that the critics learn from; reported returns and Q-bias stay in the environment's units."""
    actor_average: float = 0.0
    """Share of the online actor that an averaged actor takes on whenever the actor moves: the policy that deterministic
    evaluations play. 0: there is none, evaluations play the online actor."""
    noise_range: bool = False
    """The exploration noise of each environment and agent is drawn from a range at the start of every episode."""
    smoothing: bool = False
    """Add clipped Gaussian noise to the targets' actions (target policy smoothing)."""
    adversarial: bool = False
    """Targets and actor losses take the others' actions as they would hurt the agent most, one gradient step away
    (M3DDPG)."""
    frozen: bool = False
    """The team plays a given policy, deterministically, and does not learn: it has no critics and no targets."""
    sync_targets: bool = True
    """Targets start as copies of the online networks; False: as independent draws, as in the authors' program."""

    @property
    def recurrent(self) -> bool:
        """Whether actors and critics have states."""
        return self.actor == "gru"

    @property
    def central(self) -> bool:
        """Whether the critics see the joint observation and all actions."""
        return self.critic != "own"

    @property
    def critics_in_target(self) -> int:
        """Number of critics that make a target."""
        return self.target_critics or self.num_critics

    @property
    def critics_climbed(self) -> int:
        """Number of critics, from the first on, whose mean value the actor climbs."""
        return 1 if self.actor_critics == "first" else self.num_critics


class HyperParams(NamedTuple):
    """What may differ between runs of one compiled program: one number each, or one per run along a leading axis."""

    actor_lr: chex.Array | float
    critic_lr: chex.Array | float
    gamma: chex.Array | float
    """Discount of one env step."""
    tau: chex.Array | float
    """Share of the online networks that a target takes on at each of its updates."""
    target_noise: chex.Array | float
    """Standard deviation of the smoothing noise; for Box actions in units of the half range."""
    target_noise_clip: chex.Array | float
    """Bound of the smoothing noise, in the same units."""
    exploration_noise: chex.Array | float
    """Standard deviation of the noise added to Box actions while collecting, in units of the half range; with
    `Algorithm.noise_range` the lower end of the range."""
    logit_regularizer: chex.Array | float
    """Weight of the mean squared actor output (logits, or the number before the squashing) in the actor loss."""
    max_grad_norm: chex.Array | float
    exploration_noise_high: chex.Array | float = 0.0
    """The upper end; read with `Algorithm.noise_range` only."""
    adversarial_step: chex.Array | float | None = None
    """Length of the step of other teams' actions against the agent, of Box actions in half ranges; None unless
    `Algorithm.adversarial`."""
    adversarial_step_team: chex.Array | float | None = None
    """The same of agents of its own team."""
