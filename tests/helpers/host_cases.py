"""Small environments with PettingZoo's and gymnasium's interfaces, whose rules are known exactly."""

import gymnasium
import numpy as np
from gymnasium import spaces


class Guess:
    """Two players see a number each and are paid for saying twice that number; ten env steps, numbers anew each time.

    What player i sees: (its number in [0, 2], env step / 10). It says a number in [0, 4].
    """

    possible_agents = ("a", "b")
    max_cycles = 10

    def __init__(self, fail_at: int = 0, names: tuple[str, ...] = ("a", "b")):
        self.possible_agents, self.fail_at = tuple(names), fail_at

    def observation_space(self, agent):
        return spaces.Box(-2, 2, (2,), np.float32)

    def action_space(self, agent):
        return spaces.Box(np.float32([0.0]), np.float32([4.0]))

    def seen(self):
        return {agent: np.array([self.x[i], self.t / 10], np.float32) for i, agent in enumerate(self.possible_agents)}

    def reset(self, seed=None, options=None):
        self.random, self.t = np.random.default_rng(seed), 0
        self.agents, self.x = list(self.possible_agents), self.random.uniform(0, 2, 2)
        return self.seen(), {agent: {} for agent in self.agents}

    def step(self, actions):
        self.t += 1
        if self.t == self.fail_at:
            raise ZeroDivisionError("it was to fail")
        players = self.agents
        reward = {agent: -abs(float(actions[agent][0]) - 2 * self.x[i]) for i, agent in enumerate(players)}
        self.x = self.random.uniform(0, 2, 2)
        over = self.t >= self.max_cycles
        self.agents = [] if over else self.agents
        return self.seen(), reward, dict.fromkeys(players, False), dict.fromkeys(players, over), {}


def parallel_env(**kwargs):
    """What `env.id=host_cases` makes."""
    return Guess(**kwargs)


class Leaving:
    """Three agents that leave one after another, each with the reward 1 in every env step that it plays.

    Args:
        leave: for each agent the env step after which it is gone, and whether it is truncated then.
    """

    possible_agents = ("first", "second", "third")
    max_cycles = 8

    def __init__(self, leave=((2, False), (3, False), (5, False)), keep=False):
        self.leave, self.keep = dict(zip(self.possible_agents, leave, strict=True)), keep
        self.given: list[dict] = []

    def observation_space(self, agent):
        return spaces.Box(0, 9, (1,), np.float32)

    def action_space(self, agent):
        return spaces.Discrete(3, start=5)

    def seen(self, agents):
        return {agent: np.array([self.t + 1], np.float32) for agent in agents}

    def reset(self, seed=None, options=None):
        self.t, self.agents = 0, list(self.possible_agents)
        return self.seen(self.agents), {agent: {} for agent in self.agents}

    def step(self, actions):
        assert self.agents and set(actions) == set(self.agents)
        self.t += 1
        self.given.append(dict(actions))
        players = list(self.agents)
        gone = {agent: self.t >= self.leave[agent][0] for agent in players}
        truncated = {agent: gone[agent] and self.leave[agent][1] for agent in players}
        terminated = {agent: gone[agent] and not self.leave[agent][1] for agent in players}
        if not self.keep or all(gone.values()):
            self.agents = [agent for agent in players if not gone[agent]]
        return self.seen(players), dict.fromkeys(players, 1.0), terminated, truncated, {}


class Anything:
    """One agent with any spaces; remembers the actions, sees draws from its space."""

    possible_agents = ("one",)
    max_cycles = 3

    def __init__(self, observations, actions):
        self.observations, self.actions = observations, actions
        self.given, self.shown = [], []

    def observation_space(self, agent):
        return self.observations

    def action_space(self, agent):
        return self.actions

    def show(self):
        self.shown.append(self.observations.sample())
        return {"one": self.shown[-1]}

    def reset(self, seed=None, options=None):
        self.observations.seed(seed)
        self.agents = ["one"]
        return self.show(), {"one": {}}

    def step(self, actions):
        assert self.actions.contains(actions["one"]), actions
        self.given.append(actions["one"])
        return self.show(), {"one": 0.0}, {"one": False}, {"one": False}, {}


class Corridor(gymnasium.Env):
    """Walk right to the end of a corridor of 4 places: terminated with 1; a choice of 2, one place seen."""

    observation_space, action_space = spaces.Discrete(5), spaces.Discrete(2)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 0
        return self.place, {}

    def step(self, action):
        self.place = max(0, self.place + (1 if action else -1))
        return self.place, float(self.place == 4), self.place == 4, False, {}
