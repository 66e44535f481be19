"""`python -m experiments.recipe`: what each part of the fast recipe does for the Ant: parts changed one at a time.

The Ant in two halves, MATD3, 300,000 env steps. Every setting is the base with one thing changed, and is compared with
the base by the mean of its evaluations in the last third.
"""

from collections.abc import Sequence

from experiments import study
from experiments.one_at_a_time import OneAtATime, no_difference
from experiments.squashing import COMMON
from matd3_jax.cli import command

BASE = "base"
CHANGES: dict[str, list[str]] = {
    BASE: [],
    "noise range 0.05 to 0.4": ["algo.exploration_noise=[0.05,0.4]"],
    "8 updates of 128": ["updates_per_collect=8", "batch_size=128"],
    "2 updates of 512": ["updates_per_collect=2", "batch_size=512"],
    "1 update of 1024": ["updates_per_collect=1", "batch_size=1024"],
    "n-step 5": ["n_step=5"],
    "averaged actor": ["algo.actor_average=0.001"],
    "outputs penalized by 0.01": ["algo.logit_regularizer=0.01"],
    "outputs penalized by 0.1": ["algo.logit_regularizer=0.1"],
    "outputs penalized by 1": ["algo.logit_regularizer=1"],
    "delay 1": ["algo.policy_delay=1"],
    "normalized, deviation at least 0.1": ["normalize_observations=true", "normalize_least_deviation=0.1"],
    "rewards scaled by 0.1": ["algo.reward_scale=0.1"],
    "n-step 1": ["n_step=1"],
    "a minibatch for each agent": ["shared_minibatch=false"],
    "sigmoid": ["algo.actor_output=sigmoid"],
    "noise 0.1": ["algo.exploration_noise=0.1"],
}
"""What differs from the base: tanh actors, learning rates 0.001, noise 0.2, n-step 3, delay 2, 4 updates of 256
transitions that the agents share after 16 env steps."""

KEYS = {
    "actor_output": "algo.actor_output",
    "actor_average": "algo.actor_average",
    "logit_regularizer": "algo.logit_regularizer",
    "exploration_noise": "algo.exploration_noise",
    "updates_per_collect": "updates_per_collect",
    "batch_size": "batch_size",
    "n_step": "n_step",
    "policy_delay": "algo.policy_delay",
    "shared_minibatch": "shared_minibatch",
    "normalize_observations": "normalize_observations",
    "reward_scale": "algo.reward_scale",
}
SCALES = {
    "paper": ["seeds=4", "total_steps=300000", "log_every=10000"],
    "small": ["seeds=2", "total_steps=60000", "log_every=5000"],
}


PARTS = OneAtATime(
    base=BASE,
    changes=CHANGES,
    common=lambda scale: [*COMMON, *SCALES[scale], "algo.actor_output=tanh"],
    keys=KEYS,
    claim=no_difference(100.0),
    title="Ant, two halves, MATD3, 300,000 env steps: one part changed at a time",
)
settings, claims, draw, details = PARTS.settings, PARTS.claims, PARTS.draw, PARTS.details


STUDY = study.of_evaluations(
    name="recipe",
    title="Parts of the fast recipe",
    help=str(__doc__),
    protocol="Ours, not the paper's: the base has tanh actors, learning rates of 0.001, noise 0.2, n-step 3, delay 2, "
    "and 4 updates of 256 transitions, which the agents share, after every 16 env steps; four seeds, 300,000 env "
    "steps; five deterministic episodes every 50,000.",
    settings=settings,
    keys=KEYS,
    claims=claims,
    draw=draw,
    details=details,
    figure="parts.png",
)


def main(argv: Sequence[str]) -> int:
    return study.main(STUDY, argv)


if __name__ == "__main__":
    command.run(main)
