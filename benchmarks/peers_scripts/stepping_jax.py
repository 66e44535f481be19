"""Stepping alone of environments in JAX, ours and JaxMARL's in the same loop: random actions, one program with
`jax.vmap` over environments in `jax.lax.scan`, every episode that ends followed by another (JaxMARL's `step`, and ours
under JaxMARL's calling convention, `matd3_jax.interop.jaxmarl`).

Case: {"suite": "ours" or "jaxmarl", "env": name, "options": {...}, "num_envs": n, "steps": of each environment in a
block}.
"""

import jax
import jax.numpy as jnp
import serve


def prepare(case: dict) -> serve.Block:
    """Compiled; a block is one call of the program, all environments counted."""
    env = make(case)
    num_envs, steps = case["num_envs"], case["steps"]

    def step(carry, _):
        key, state = carry
        key, action_key, step_key = jax.random.split(key, 3)
        agent_keys = jax.random.split(action_key, len(env.agents))
        actions = {agent: env.action_space(agent).sample(k) for agent, k in zip(env.agents, agent_keys, strict=True)}
        observation, state, rewards, _, _ = env.step(step_key, state, actions)
        # Every number seen goes into the result, so that none of the work can be left out.
        seen = sum(jnp.sum(leaf) for leaf in jax.tree.leaves((observation, rewards)))
        return (key, state), seen

    @jax.jit
    def play(keys, states):
        carry, seen = jax.lax.scan(lambda c, _: jax.vmap(step, (0, None))(c, None), (keys, states), length=steps)
        return carry, seen.sum(axis=0)

    reset_keys, keys = (jax.random.split(k, num_envs) for k in jax.random.split(jax.random.PRNGKey(0)))
    _, states = jax.jit(jax.vmap(env.reset))(reset_keys)
    kept = [(keys, states)]

    def block() -> int:
        carry, _ = jax.block_until_ready(play(*kept.pop()))
        kept.append(carry)
        return num_envs * steps

    return block


def make(case: dict):
    """The environment, under JaxMARL's calling convention."""
    if case["suite"] == "jaxmarl":
        import jaxmarl

        return jaxmarl.make(case["env"], **case["options"])
    from matd3_jax import envs
    from matd3_jax.interop.jaxmarl import JaxMARL
    from matd3_jax.runtime import devices

    devices.prepare()  # with the settings of XLA that our commands run with
    return JaxMARL(envs.make(case["env"], **case["options"]))


if __name__ == "__main__":
    serve.serve(prepare, ("matd3_jax", "jaxmarl", "jax", "mujoco-mjx"))
