"""`python -m experiments.ablation`: what the Ant loses without each part of the fast recipe.

The Ant in two halves, MATD3, recipe=fast, 300,000 env steps: each part left out in turn, with what stands in its place
without the recipe. Every setting is compared with the whole recipe by the mean of its evaluations in the last third.
"""

from collections.abc import Sequence

from experiments import study
from experiments.one_at_a_time import OneAtATime, needed
from matd3_jax.cli import command

BASE = "the whole recipe"
CHANGES: dict[str, list[str]] = {
    BASE: [],
    "one noise of 0.2": ["algo.exploration_noise=0.2"],
    "n-step 1": ["n_step=1"],
    "no averaged actor": ["algo.actor_average=0"],
    "sigmoid actors": ["algo.actor_output=sigmoid"],
    "a minibatch for each agent": ["shared_minibatch=false"],
    "delay 1": ["algo.policy_delay=1"],
    "4 updates of 256": ["updates_per_collect=4", "batch_size=256"],
}

KEYS = {
    "exploration_noise": "algo.exploration_noise",
    "n_step": "n_step",
    "actor_average": "algo.actor_average",
    "actor_output": "algo.actor_output",
    "shared_minibatch": "shared_minibatch",
    "policy_delay": "algo.policy_delay",
    "updates_per_collect": "updates_per_collect",
    "batch_size": "batch_size",
}
COMMON = ["env=ant", "algo=matd3", "recipe=fast"]
SCALES = {
    "paper": ["seeds=6", "total_steps=300000", "eval_every=25000", "eval_episodes=5", "log_every=5000"],
    "small": ["seeds=2", "total_steps=60000", "eval_every=10000", "eval_episodes=3", "log_every=5000"],
}

PARTS = OneAtATime(
    base=BASE,
    changes=CHANGES,
    common=lambda scale: [*COMMON, *SCALES[scale]],
    keys=KEYS,
    claim=needed,
    title="Ant, two halves, MATD3, recipe=fast: each part left out in turn",
)
settings, claims, draw, details = PARTS.settings, PARTS.claims, PARTS.draw, PARTS.details

STUDY = study.of_evaluations(
    name="ablation",
    title="The fast recipe without each of its parts",
    help=str(__doc__),
    protocol="Ours, not the paper's: recipe=fast on the Ant in two halves, six seeds, 300,000 env steps; five "
    "deterministic episodes every 25,000.",
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
