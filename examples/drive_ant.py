"""Drive gymnasium's Ant-v5 in C MuJoCo with exported policies. Needs NumPy and gymnasium[mujoco], not JAX.

    python -m matd3_jax.export run=RUN_DIR format=numpy which=best out=policies
    python examples/drive_ant.py policies [episodes]

The run trained `env=ant` with any `split`. Its robot is Ant-v2's, and two things of today's Ant-v5 are set back to it:
contact margins (MuJoCo 3.5 doubled them) and what is observed (positions, velocities, and the clipped external forces
on all 14 bodies, the world among them). The reward is that of Ant-v2, which pays for being alive on the last step, too.
"""

import importlib.util
import json
import sys
from pathlib import Path

import gymnasium
import numpy as np


def load(folder):
    """(Policies by agent, what policies.json says) of a folder that `format=numpy` wrote."""
    spec = importlib.util.spec_from_file_location("read_policies", Path(folder) / "read_policies.py")
    reader = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(reader)
    facts = json.loads((Path(folder) / "policies.json").read_text(encoding="utf-8"))
    return reader.load(Path(folder) / "policies.npz"), facts


def make():
    """Ant-v5 with the contact margins of Ant-v2."""
    env = gymnasium.make("Ant-v5", disable_env_checker=True)
    env.unwrapped.model.geom_margin /= 2
    return env


def full_observation(data, velocities=True):
    """What Ant-v2 shows: positions without x and y, velocities, external torques and forces within [-1, 1]: [111].

    velocities: False leaves them out, as `env.velocities=false` does: [97].
    """
    qvel = data.qvel if velocities else []
    return np.concatenate([data.qpos[2:], qvel, np.clip(data.cfrc_ext, -1, 1).ravel()])


def control(policies, facts, observation):
    """The robot's controls [8] from what every agent does with its part of the full observation."""
    found = np.zeros(len(facts["robot"]["controls"]))
    for agent in facts["agents"]:
        seen = observation[agent["observation"]["indices_in_full_observation"]]
        found[agent["action"]["indices_of_controls"]] = policies[agent["name"]](seen)
    return found


def episode(env, policies, facts, seed=None, start=None, after_step=None):
    """The undiscounted return of an episode.

    start: (positions [15], velocities [14]) to begin at. after_step: called with MuJoCo's data after each env step.
    """
    env.reset(seed=seed)
    robot, total = env.unwrapped, 0.0
    velocities = facts["environment"].get("velocities", True)
    if start is not None:
        robot.set_state(*start)
    for _ in range(facts["environment"]["episode_length"]):
        action = control(policies, facts, full_observation(robot.data, velocities))
        _, _, terminated, _, info = env.step(action)
        alive = 1.0  # Ant-v5 does not pay on the step on which the robot falls
        total += info["reward_forward"] + alive + info["reward_ctrl"] + info["reward_contact"]
        if terminated:
            break
        if after_step is not None:
            after_step(robot.data)
    return total


def main(folder, episodes=10):
    policies, facts = load(folder)
    if facts["environment"]["name"] != "ant":
        sys.exit(f"{folder} has policies for {facts['environment']['name']}, not for the ant")
    env = make()
    returns = [episode(env, policies, facts, seed=k) for k in range(episodes)]
    error = np.std(returns, ddof=1) / np.sqrt(episodes) if episodes > 1 else float("nan")
    print(f"return of {episodes} episodes: {np.mean(returns):.1f}, standard error {error:.1f}")
    best = facts.get("best_evaluation")
    if best:
        print(f"evaluation while training: {best['mean_return']:.1f}, standard error {best['standard_error']:.1f}")


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    main(sys.argv[1], *map(int, sys.argv[2:]))
