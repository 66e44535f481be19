"""The tasks of which there are no recordings under the rules "orig", one step at a time against plain NumPy in float64,
written down from the rules of openai/multiagent-particle-envs 83ba4d1."""

import jax
import numpy as np
import pytest
from particle_cases import NUM_STATES, random_actions, random_states

from matd3_jax.envs import make

OTHER = {"num_good": 3, "num_adversaries": 2, "num_obstacles": 2, "num_food": 1, "num_forests": 3}
TASKS = [("simple", {}), ("simple_reference", {}), ("simple_world_comm", {}), ("simple_world_comm", OTHER)]
DIRECTION = {0: (0, 0), 1: (-1, 0), 2: (1, 0), 3: (0, -1), 4: (0, 1)}


class Bodies:
    """Radii, gains, limits, and who is what."""

    def __init__(self, name, options):
        if name == "simple_world_comm":
            count = {"good": 2, "adversaries": 4, "obstacles": 1, "food": 2, "forests": 2}
            count |= {key.removeprefix("num_"): value for key, value in options.items()}
            self.wolves = list(range(count["adversaries"]))
            self.sheep = [count["adversaries"] + k for k in range(count["good"])]
            self.radius = [0.075] * len(self.wolves) + [0.045] * len(self.sheep)
            self.gain = [3.0] * len(self.wolves) + [4.0] * len(self.sheep)
            self.limit = [1.0] * len(self.wolves) + [1.3] * len(self.sheep)
            kinds = ["obstacle"] * count["obstacles"] + ["food"] * count["food"] + ["forest"] * count["forests"]
            self.solid, self.food, self.forests = (
                [i for i, kind in enumerate(kinds) if kind == which] for which in ("obstacle", "food", "forest")
            )
            self.words, self.collide = 4, True
            self.speakers = [0]
        else:
            n = 1 if name == "simple" else 2
            self.radius, self.gain, self.limit = [0.05] * n, [5.0] * n, [np.inf] * n
            self.solid, self.collide = [], False
            self.words, self.speakers = (0, []) if name == "simple" else (10, [0, 1])


def decode(bodies, actions, i, a):
    """(control [2], message) of agent i. Vectors have the opposite signs of integers."""
    silent = np.zeros(bodies.words)
    if actions == "discrete":
        move, word = a if i in bodies.speakers else (a, None)
        return np.array(DIRECTION[int(move)], float), silent if word is None else np.eye(bodies.words)[word]
    if actions == "soft":
        return np.array([a[1] - a[2], a[3] - a[4]]), a[5:] if i in bodies.speakers else silent
    return a[:2], 0.5 + a[2:] / 2 if i in bodies.speakers else silent  # [-1, 1] stands for [0, 1]


def move(bodies, pos, vel, landmark, control):
    """Velocity first, then the position with the new velocity; forces from the places before."""
    force = [g * u for g, u in zip(bodies.gain, control, strict=True)]
    if bodies.collide:
        for i, p in enumerate(pos):
            others = [(pos[j], bodies.radius[j]) for j in range(len(pos)) if j != i]
            for q, radius in others + [(landmark[k], 0.2) for k in bodies.solid]:
                r = np.linalg.norm(p - q)
                depth = 0.001 * np.logaddexp(0, (bodies.radius[i] + radius - r) / 0.001)
                force[i] = force[i] + 100 * depth * (p - q) / r
    new = []
    for v, f, limit in zip(vel, force, bodies.limit, strict=True):
        v = 0.75 * v + 0.1 * f
        speed = np.linalg.norm(v)
        new.append(v * limit / speed if speed > limit else v)
    return pos + 0.1 * np.array(new), np.array(new)


def near(p, q, reach):
    return np.linalg.norm(p - q) < reach


def distance(p, q):
    return np.linalg.norm(p - q)


def fence(z):
    """Price of a coordinate."""
    z = abs(z)
    return 0 if z < 0.9 else 10 * (z - 0.9) if z < 1 else min(np.exp(2 * z - 2), 10)


def simple(bodies, pos, vel, comm, landmark, goal):
    return [np.concatenate([vel[0], landmark[0] - pos[0]])], [-(distance(pos[0], landmark[0]) ** 2)]


def simple_reference(bodies, pos, vel, comm, landmark, goal):
    """Each agent sees the color of where the other one should go. All get the sum of both rewards."""
    color = 0.25 + 0.5 * np.eye(3)
    seen = [np.concatenate([vel[i], *(landmark - pos[i]), color[goal[i]], comm[1 - i]]) for i in (0, 1)]
    total = -sum(distance(pos[1 - i], landmark[goal[i]]) ** 2 for i in (0, 1))
    return seen, [total, total]


def simple_world_comm(bodies, pos, vel, comm, landmark, goal):
    homes = [{f for f in bodies.forests if near(p, landmark[f], bodies.radius[i] + 0.3)} for i, p in enumerate(pos)]
    seen = []
    for i, p in enumerate(pos):
        places, speeds = [], []
        for j in range(len(pos)):
            if j == i:
                continue
            sight = i == 0 or homes[i] & homes[j] or not (homes[i] or homes[j])
            places.append(pos[j] - p if sight else np.zeros(2))
            if j in bodies.sheep:
                speeds.append(vel[j] if sight else np.zeros(2))
        inside = [np.array([1.0 if f in homes[i] else -1.0]) for f in bodies.forests]
        tail = [*speeds, *inside, comm[0]] if i in bodies.wolves else [*inside, *speeds]
        seen.append(np.concatenate([vel[i], p, *(landmark - p), *places, *tail]))
    caught = {s: sum(near(pos[s], pos[w], 0.12) for w in bodies.wolves) for s in bodies.sheep}
    reward = [
        5 * sum(caught.values()) - 0.1 * min(distance(pos[w], pos[s]) for s in bodies.sheep) for w in bodies.wolves
    ]
    for s in bodies.sheep:
        eaten = sum(near(pos[s], landmark[f], 0.075) for f in bodies.food)
        hunger = min(distance(pos[s], landmark[f]) for f in bodies.food)
        # The original rewards distance from food: the sign is its own.
        reward.append(-5 * caught[s] - 2 * (fence(pos[s][0]) + fence(pos[s][1])) + 2 * eaten + 0.05 * hunger)
    return seen, reward


RULES = {"simple": simple, "simple_reference": simple_reference, "simple_world_comm": simple_world_comm}


@pytest.mark.slow
@pytest.mark.parametrize("actions", ["soft", "discrete", "continuous"])
@pytest.mark.parametrize("task", TASKS, ids=lambda task: task[0] + "-other" * bool(task[1]))
def test_steps(task, actions, observe_and_step):
    name, options = task
    env, bodies, rules = make(name, actions=actions, **options), Bodies(name, options), RULES[name]
    rng = np.random.default_rng(TASKS.index(task))
    state, action = random_states(env, rng), random_actions(env, rng)
    with jax.enable_x64(True):
        seen, ts = jax.tree.map(np.asarray, observe_and_step(env)(state, action))
    hidden = []
    for k in range(NUM_STATES):
        pos, vel, landmark = state.pos[k], state.vel[k], state.landmark[k]
        goal = None if state.goal is None else state.goal[k]
        decoded = [decode(bodies, actions, i, a[k]) for i, a in enumerate(action)]
        now, _ = rules(bodies, pos, vel, None if state.comm is None else state.comm[k], landmark, goal)
        pos, vel = move(bodies, pos, vel, landmark, [u for u, _ in decoded])
        comm = np.array([word for _, word in decoded])
        later, reward = rules(bodies, pos, vel, comm, landmark, goal)
        np.testing.assert_allclose(ts.state.pos[k], pos, rtol=0, atol=1e-10)
        np.testing.assert_allclose(ts.state.vel[k], vel, rtol=0, atol=1e-10)
        if env.dim_c:
            np.testing.assert_allclose(ts.state.comm[k], comm, rtol=0, atol=1e-10)
        np.testing.assert_allclose(ts.reward[k], reward, rtol=0, atol=1e-10)
        for got, want in ((seen, now), (ts.observation, later)):
            for g, w in zip(got, want, strict=True):
                np.testing.assert_allclose(g[k], w, rtol=0, atol=1e-10)
        if name == "simple_world_comm":  # place of the last prey as the one before it in the list sees it
            first = 4 + 2 * landmark.shape[0] + 2 * (len(pos) - 2)
            hidden.append(not now[1][first : first + 2].any())
    if hidden:
        assert 0.15 < np.mean(hidden) < 0.85  # both were put to the test
