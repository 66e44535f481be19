"""Stepping alone of mpe2's simple_spread and gymnasium's Ant, one environment: random actions, drawn beforehand, and
every episode that ends followed by another. Case: {"suite": "mpe2" or "gymnasium", "steps": of a block}."""

import itertools

import serve


def prepare(case: dict) -> serve.Block:
    """A block continues where the last one stopped."""
    return {"mpe2": particles, "gymnasium": ant}[case["suite"]](case["steps"])


def particles(steps: int) -> serve.Block:
    """mpe2's parallel API; discrete actions and 25 steps an episode are its defaults, given all the same."""
    from mpe2 import simple_spread_v3

    env = simple_spread_v3.parallel_env(N=3, max_cycles=25, continuous_actions=False)
    env.reset(seed=0)
    actions = itertools.cycle([{agent: env.action_space(agent).sample() for agent in env.agents} for _ in range(1000)])

    def block() -> int:
        for action in itertools.islice(actions, steps):
            env.step(action)
            if not env.agents:
                env.reset()
        return steps

    return block


def ant(steps: int) -> serve.Block:
    """gymnasium's Ant-v5 with MuJoCo, as `gymnasium.make` makes it (1,000 steps an episode)."""
    import gymnasium

    env = gymnasium.make("Ant-v5", disable_env_checker=True)
    env.reset(seed=0)
    actions = itertools.cycle([env.action_space.sample() for _ in range(1000)])

    def block() -> int:
        for action in itertools.islice(actions, steps):
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return steps

    return block


if __name__ == "__main__":
    serve.serve(prepare, ("mpe2", "gymnasium", "mujoco"))
