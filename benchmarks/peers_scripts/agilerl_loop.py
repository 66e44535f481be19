"""AgileRL's MATD3 or MADDPG on mpe2's simple_spread: act, step, add to the replay, sample and learn, through its public
API and in the order of its multi-agent tutorial, without the evolution of hyper-parameters.

Case: {"algorithm": "MATD3" or "MADDPG", "num_envs": n, "threads": of torch, "hidden": [...], "batch_size": n,
"capacity": transitions in the replay, "learn_every": env steps, "episode_length": n}. One environment is stepped in the
process (`PzDummyVecEnv`, what AgileRL makes of a bare environment), several in a process each
(`AsyncPettingZooVecEnv`). Exploration is AgileRL's default.
"""

import serve
import torch
from agilerl.algorithms import MADDPG, MATD3
from agilerl.components.data import MultiAgentTransition
from agilerl.components.replay_buffer import ReplayBuffer
from agilerl.modules.custom_components import GumbelSoftmax
from agilerl.modules.dummy import DummyEvolvable
from agilerl.vector import AsyncPettingZooVecEnv, PzDummyVecEnv
from mpe2 import simple_spread_v3
from pettingzoo import ParallelEnv
from torch import nn


class OwnNames(ParallelEnv):
    """Agents named so that AgileRL gives each its own networks: of names alike but for their number (agent_0, agent_1)
    it makes one group with one set of networks."""

    metadata = {"name": "simple_spread_v3"}

    def __init__(self, episode_length: int):
        self.env = simple_spread_v3.parallel_env(N=3, max_cycles=episode_length, continuous_actions=False)
        self.inner = {f"{letter}_0": name for letter, name in zip("abc", self.env.possible_agents, strict=True)}
        self.outer = {name: own for own, name in self.inner.items()}
        self.possible_agents, self.render_mode = list(self.inner), None

    @property
    def agents(self):
        return [self.outer[name] for name in self.env.agents]

    def observation_space(self, agent):
        return self.env.observation_space(self.inner[agent])

    def action_space(self, agent):
        return self.env.action_space(self.inner[agent])

    def reset(self, seed=None, options=None):
        return tuple(map(self._named, self.env.reset(seed=seed, options=options)))

    def step(self, actions):
        return tuple(map(self._named, self.env.step({self.inner[own]: action for own, action in actions.items()})))

    def _named(self, by_agent):
        return {self.outer[name]: value for name, value in by_agent.items()}


class Critic(nn.Module):
    """The value of all observations and actions."""

    def __init__(self, inputs: int, hidden: list[int]):
        super().__init__()
        self.layers = mlp(inputs, hidden, 1)

    def forward(self, observations, actions):
        return self.layers(torch.cat([*observations.values(), actions], dim=1))


def mlp(inputs: int, hidden: list[int], outputs: int, *last: nn.Module) -> nn.Sequential:
    sizes = [inputs, *hidden]
    pairs = zip(sizes[:-1], sizes[1:], strict=True)
    layers = [layer for a, b in pairs for layer in (nn.Linear(a, b), nn.ReLU())]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs), *last)


def make_agent(case: dict, env) -> MATD3 | MADDPG:
    """With networks of the wanted widths, for which AgileRL takes any module wrapped in `DummyEvolvable`."""
    agents = env.possible_agents
    observations = [env.single_observation_space(agent) for agent in agents]
    actions = [env.single_action_space(agent) for agent in agents]
    o, a = observations[0].shape[0], int(actions[0].n)

    def actors():
        kwargs = {"inputs": o, "hidden": case["hidden"], "outputs": a}
        make = lambda inputs, hidden, outputs: mlp(inputs, hidden, outputs, GumbelSoftmax())  # noqa: E731
        return [DummyEvolvable("cpu", module_fn=make, module_kwargs=kwargs) for _ in agents]

    def critics():
        kwargs = {"inputs": len(agents) * (o + a), "hidden": case["hidden"]}
        return [DummyEvolvable("cpu", module_fn=Critic, module_kwargs=kwargs) for _ in agents]

    twin = case["algorithm"] == "MATD3"
    return (MATD3 if twin else MADDPG)(
        observations,
        actions,
        agent_ids=agents,
        vect_noise_dim=case["num_envs"],
        batch_size=case["batch_size"],
        learn_step=case["learn_every"],
        actor_networks=actors(),
        critic_networks=[critics(), critics()] if twin else critics(),
        **({"policy_freq": 2} if twin else {}),
    )


def prepare(case: dict) -> serve.Block:
    """Enough in the replay for a minibatch; a block is as many env steps as there are between two updates, with the
    update."""
    num_envs = case["num_envs"]
    makers = [lambda: OwnNames(case["episode_length"])] * num_envs
    env = PzDummyVecEnv(makers[0]()) if num_envs == 1 else AsyncPettingZooVecEnv(makers)
    agent = make_agent(case, env)
    agent.set_training_mode(True)
    memory = ReplayBuffer(case["capacity"])
    seen = list(env.reset())

    def play() -> None:
        observation, info = seen
        action, raw_action = agent.get_action(obs=observation, infos=info)
        next_observation, reward, terminated, truncated, info = env.step(action)
        transition = MultiAgentTransition(
            obs=observation, action=raw_action, reward=reward, next_obs=next_observation, done=terminated
        ).to_tensordict()
        transition.batch_size = [num_envs]
        memory.add(transition)
        seen[:] = next_observation, info
        ended = [i for i in range(num_envs) if all(terminated[a][i] or truncated[a][i] for a in env.possible_agents)]
        agent.reset_action_noise(ended)

    def block() -> int:
        torch.set_num_threads(case["threads"])
        for _ in range(case["learn_every"] // num_envs):
            play()
        agent.learn(memory.sample(case["batch_size"]))
        return case["learn_every"]

    torch.set_num_threads(case["threads"])
    while len(memory) < case["batch_size"]:
        play()
    return block


if __name__ == "__main__":
    serve.serve(prepare, ("agilerl", "torch", "mpe2"))
