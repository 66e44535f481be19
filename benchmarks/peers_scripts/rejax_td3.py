"""rejax's TD3 on brax's hopper, its `train` compiled and mapped over seeds as its documentation shows.

Case: {"seeds": n, "num_envs": n, "batch_size": n, "capacity": transitions in the replay, "steps": env steps of each
seed in a block}. Networks are 64-64 (rejax has no other), with ReLU; one update for each env step; policy delay 2.
"""

import jax
import serve
from rejax import TD3


def prepare(case: dict) -> serve.Block:
    """Its replay filled to `fill_buffer` and compiled; a block is one call of `train`, all seeds counted."""
    unit = 2 * case["num_envs"]  # of its training iteration
    steps = max(1, round(case["steps"] / unit)) * unit
    algorithm = TD3.create(
        env="brax/hopper",
        env_params={"backend": "spring"},
        num_envs=case["num_envs"],
        num_epochs=case["num_envs"],
        policy_delay=2,
        batch_size=case["batch_size"],
        buffer_size=case["capacity"],
        fill_buffer=2048,
        actor_kwargs={"activation": "relu"},
        critic_kwargs={"activation": "relu"},
        total_timesteps=steps,
        eval_freq=steps,
        skip_initial_evaluation=True,
    ).replace(eval_callback=lambda algorithm, state, key: ())
    keys = jax.random.split(jax.random.PRNGKey(0), case["seeds"])

    def advance(state):
        return algorithm.train(train_state=state)[0]

    # One seed is not mapped over: that would turn its conditionals into both branches.
    one = case["seeds"] == 1
    train = jax.jit(advance if one else jax.vmap(advance), donate_argnums=0)
    state = jax.jit(algorithm.init_state if one else jax.vmap(algorithm.init_state))(keys[0] if one else keys)
    kept = [state]

    def block() -> int:
        kept.append(jax.block_until_ready(train(kept.pop())))
        return case["seeds"] * steps

    while int(kept[0].global_step.min()) <= 2048:
        block()
    return block


if __name__ == "__main__":
    serve.serve(prepare, ("rejax", "brax", "gymnax", "jax"))
