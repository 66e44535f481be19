"""Policies that matd3_jax exported, with NumPy alone: load("policies.npz")["agent_0"](observation) is the action."""

import json

import numpy as np


def load(path):
    """The policies by agent; a policy's `facts` say what its observations and actions are."""
    facts = json.loads(str((data := np.load(path))["facts"]))
    return {a["name"]: Policy(a, {k: data[f"{i}/{k}"] for k in a["arrays"]}) for i, a in enumerate(facts["agents"])}


class Policy:
    def __init__(self, facts, arrays):
        self.facts, self.net, self.arrays = facts, facts["network"], arrays

    def probabilities(self, observation):  # of choices; of real numbers: the network's outputs
        x = np.clip((np.float32(observation) - self.arrays["mean"]) / self.arrays["deviation"], *self.net["bounds"])
        for k in range(self.net["layers"]):
            x = (np.maximum(x, 0) if k else x) @ self.arrays[f"kernel_{k}"] + self.arrays[f"bias_{k}"]
        parts = [np.exp(p - p.max(-1, keepdims=True)) for p in np.split(x, self.net["cuts"], -1)]
        return x if self.net["head"] == "tanh" else np.concatenate([p / p.sum(-1, keepdims=True) for p in parts], -1)

    def __call__(self, observation):  # [..., size] to [..., size], or to the number(s) of the likeliest choice(s)
        p, net = self.probabilities(observation), self.net
        if net["head"] == "tanh":
            return np.float32(net["center"]) + np.float32(net["half"]) * np.tanh(np.float32(net["slope"]) * p)
        chosen = [part.argmax(-1).astype(np.int32) for part in np.split(p, net["cuts"], -1)]
        return p if net["head"] == "soft" else chosen[0] if net["head"] == "choice" else np.stack(chosen, -1)
