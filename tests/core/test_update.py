"""One update against the float64 reference, for every algorithm of the family, and what must not depend on what."""

import contextlib
import dataclasses
import functools

import jax
import jax.numpy as jnp
import known_noise
import numpy as np
import pytest
import reference
from learner_cases import BATCH, CASES, agents_of, drawn, numbers, random_rows, random_state

from matd3_jax.core import minibatch, networks, sequential_actors, update

KEY = jax.random.key(0)
TOLERANCE = 1e-10
"""Absolute and relative, both sides in float64: sums of some hundred terms round at about 1e-14, Adam's division by
roots of second moments as small as 1e-13 (weights move 0.01 m / sqrt(v)) enlarges that some hundred times. The smallest
effect meant to be seen, Adam's epsilon in the other place, is above 1e-7 (`test_reference_distinguishes`)."""


def noise_table(kind, size, batch=BATCH):
    """The noise of every draw (`test_draws_have_their_own_keys` looks at keys and their order)."""
    return known_noise.table(kind, size, batch)


class Program:
    """The compiled update of a case in float64, with known noise; call it with (state, rows)."""

    def __init__(self, case):
        self.case, self.layout = case, case.layout()
        self.hyper = case.hyper(self.layout)
        self.move = [self.layout.teams[group.members[0]] not in case.still for group in self.layout.groups]
        self.batches = 1 if case.shared else self.layout.num_agents

        def run(state, rows):
            key, options = KEY, {"sequential": case.sequential, "one_by_one": case.one_by_one}
            options["random_order"] = case.random_order
            rows = drawn(self.layout, rows, self.hyper)
            return update.update(self.layout, state, self.hyper, rows, key, self.move, **options)

        self.jitted = jax.jit(run)

    def __call__(self, state, rows, known_noise_given=True):
        noise = known_noise.known(BATCH) if known_noise_given else contextlib.nullcontext()
        with jax.enable_x64(True), noise:
            return jax.tree.map(np.asarray, self.jitted(state, rows))

    def inputs(self, seed=0):
        rng = np.random.default_rng(seed)
        with jax.enable_x64(True):
            return random_state(self.layout, rng), random_rows(self.layout, rng, self.batches)

    def reference(self, state, rows, sequential=None, alter=lambda agent: None, order="drawn", chosen="drawn"):
        agents = agents_of(self.layout, state, self.hyper)
        for agent in agents:
            alter(agent)
        return reference.update(
            agents,
            [rows[0 if self.case.shared else i] for i in range(len(agents))],
            gumbel=functools.partial(noise_table, "gumbel"),
            normal=functools.partial(noise_table, "normal"),
            move=[self.layout.teams[i] not in self.case.still for i in range(len(agents))],
            sequential=self.case.sequential if sequential is None else sequential,
            order=self.order() if order == "drawn" else order,
            chosen=self.chosen() if chosen == "drawn" else chosen,
        )

    def chosen(self):
        """Of each agent, the numbers of the critics that make its target."""
        found = [None] * self.layout.num_agents
        keys = jax.random.split(KEY, len(self.layout.groups))
        for group, key in zip(self.layout.groups, keys, strict=True):
            drawn = minibatch.draw_noise(self.layout, group, (self.batches, BATCH), key, None).critics
            for k, i in enumerate(group.members):
                found[i] = None if drawn is None else drawn[k].tolist()
        return found

    def order(self):
        """Of the actors that move, where they move in random order."""
        if not self.case.random_order:
            return None
        moving = [i for i, team in enumerate(self.layout.teams) if team not in self.case.still]
        return sequential_actors.permutation(KEY, moving).tolist()

    def agents(self, state):
        return agents_of(self.layout, state, self.hyper)


@functools.cache
def program(name):
    return Program(CASES[name])


@functools.cache
def base(name):
    """(program, state, rows, state and metrics after the update) of a case."""
    p = program(name)
    state, rows = p.inputs()
    return p, state, rows, *p(state, rows)


def differing(before, after, **kwargs):
    """Paths of the arrays that are not bit for bit the same in two agents."""
    before, after = numbers(before, **kwargs), numbers(after, **kwargs)
    assert before.keys() == after.keys()
    return {path for path in before if not np.array_equal(before[path], after[path])}


# ---- against the reference -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CASES)
def test_update_equals_reference(name):
    """All parameters, targets, moments and losses after one update: the whole algorithm, gradients included."""
    p, state, rows, new, metrics = base(name)
    expected, losses, clipped = p.reference(state, rows)
    for i, (agent, other) in enumerate(zip(p.agents(new), expected, strict=True)):
        got, want = numbers(agent), numbers(other)
        assert got.keys() == want.keys()
        for path in want:
            assert np.shape(got[path]) == np.shape(want[path])
            np.testing.assert_allclose(
                got[path], want[path], rtol=TOLERANCE, atol=TOLERANCE, err_msg=f"{name}, {p.layout.agents[i]}: {path}"
            )
    np.testing.assert_allclose(np.stack(metrics), losses, rtol=TOLERANCE, atol=TOLERANCE)
    assert (clipped > 0) == (p.layout.algorithms[0].clip != "none")


@pytest.mark.parametrize(
    "name",
    ["matd3", "box", "n-step", "tanh", "matd3-shared-sequential", "layer-norm", "categorical-3-steps", "m3matd3-box"],
)
def test_large_minibatches_are_computed_alike(name, monkeypatch):
    """The program that large minibatches get (a loop over agents, products that transpose) against the reference."""
    monkeypatch.setattr(networks, "SMALL_BATCH", 0)
    p = Program(CASES[name])
    state, rows = p.inputs()
    expected, losses, _ = p.reference(state, rows)
    new, metrics = p(state, rows)
    for agent, other in zip(p.agents(new), expected, strict=True):
        got, want = numbers(agent), numbers(other)
        for path in want:
            np.testing.assert_allclose(got[path], want[path], rtol=TOLERANCE, atol=TOLERANCE, err_msg=path)
    np.testing.assert_allclose(np.stack(metrics), losses, rtol=TOLERANCE, atol=TOLERANCE)


def test_some_norms_are_clipped_and_some_are_not():
    """The comparison covers both sides of the clipping: 3 agents with 3 networks of 3 layers have 54 variables."""
    p, state, rows, _, _ = base("matd3")
    assert 5 < p.reference(state, rows)[2] < 49


@pytest.mark.parametrize(
    "name, field, value",
    [
        ("matd3", "algorithm.clip", "network"),
        ("matd3", "algorithm.adam", "epsilon_hat"),
        ("matd3", "algorithm.critic", "own"),
        ("box", "algorithm.smoothing", False),
        ("box", "hyper.target_noise_clip", 9.0),
        ("matd3", "hyper.logit_regularizer", 0.0),
        ("matd3", "sequential", True),
        ("matd3-shared-sequential", "sequential", False),
        ("interleaved", "sequential", False),
        ("random-order", "order", lambda order: None),
        ("random-order-interleaved", "order", lambda order: order[::-1]),
        ("categorical", "algorithm.critic_range", (-2.0, 1.6)),
        ("quantile", "algorithm.dropped_quantiles", 1),
        ("quantile-m3matd3", "algorithm.actor_critics", "first"),
        ("subset", "chosen", lambda chosen: chosen[::-1]),
        ("subset", "chosen", lambda chosen: None),
        ("m3ddpg", "hyper.adversarial_step", 0.5999),
        ("m3matd3-box", "hyper.adversarial_step_team", 0.2499),
        ("m3matd3-interleaved", "algorithm.adversarial", False),
    ],
)
def test_reference_distinguishes(name, field, value):
    """What the cases vary is seen by the comparison: with one setting changed the reference is elsewhere, by far more
    than the tolerance."""
    p, state, rows, _, _ = base(name)

    def alter(agent):
        part, _, key = field.partition(".")
        if part == "algorithm":
            agent.algorithm = dataclasses.replace(agent.algorithm, **{key: value})
        elif part == "hyper":
            agent.hyper = agent.hyper._replace(**{key: value})

    right, _, _ = p.reference(state, rows)
    if field == "algorithm.critic":
        # The critics' inputs would not fit: only check that the central critic does read the others' parts.
        rows = rows.copy()
        rows[..., p.layout.observation_sizes[0]] += 1
        wrong, _, _ = p.reference(state, rows)
    else:
        sequential = value if field == "sequential" else None
        order = p.order() and value(p.order()) if field == "order" else "drawn"
        chosen = value(p.chosen()) if field == "chosen" else "drawn"
        wrong, _, _ = p.reference(state, rows, sequential=sequential, alter=alter, order=order, chosen=chosen)
    gaps = [
        np.abs(np.asarray(a) - b).max()
        for one, other in zip(map(numbers, right), map(numbers, wrong), strict=True)
        for a, b in zip(one.values(), other.values(), strict=True)
    ]
    assert max(gaps) > 100 * TOLERANCE


# ---- what must not depend on what ------------------------------------------------------------------------------------


def test_own_critic_reads_nothing_of_others():
    """Independent learners: whatever the others saw, did, got and will see, and whatever their networks are, the
    agent's update is the same bit for bit. (IL that peeks through the target or the actor loss is not IL.)"""
    p, state, rows, new, _ = base("iltd3")
    layout, agent = p.layout, 2
    own = np.zeros(layout.row_size, bool)
    own[-1] = True
    x, a = layout.observation_starts[agent], layout.action_starts[agent]
    own[x : x + layout.observation_sizes[agent]] = True
    own[layout.observation_size + a :][: layout.action_spaces[agent].size] = True
    own[layout.observation_size + layout.action_size + agent] = True
    own[-1 - layout.observation_size + x :][: layout.observation_sizes[agent]] = True
    other_rows = np.where(own, rows, rows + 1)
    k = layout.groups[-1].members.index(agent)
    other_state = jax.tree.map(lambda leaf: leaf + leaf.dtype.type(1), state)
    last = jax.tree.map(
        lambda old, moved: np.concatenate([moved[:k], old[k : k + 1], moved[k + 1 :]]), state[-1], other_state[-1]
    )
    after, _ = p((*other_state[:-1], last), other_rows)
    assert not differing(p.agents(new)[agent], p.agents(after)[agent])
    assert differing(p.agents(new)[1], p.agents(after)[1])


def test_minibatch_of_a_member_is_its_own():
    """Independent minibatches: another minibatch for agent 1 changes agent 1 only, and all that it learns."""
    p, state, rows, new, _ = base("matd3")
    rows = rows.copy()
    rows[1] += 0.1
    after, _ = p(state, rows)
    changed = [differing(a, b) for a, b in zip(p.agents(new), p.agents(after), strict=True)]
    assert not changed[0] and not changed[2]
    assert {path.split("[")[1] for path in changed[1]} == {
        f"'{name}']" for name in ("actor", "actor_target", "critics", "critic_targets", "actor_adam", "critic_adams")
    }


def test_others_actions_are_constants():
    """The online actors of the others matter to nothing of an agent: in its actor loss their actions come from the
    replay, in its target from the target actors. Nor does its own actor get a gradient of their losses."""
    p, state, rows, new, _ = base("matd3")

    def shake(s, field):
        """The state with other numbers in `field` of agent 1."""
        part = jax.tree.map(lambda leaf: np.concatenate([leaf[:1], leaf[1:2] + 0.1, leaf[2:]]), getattr(s, field))
        return s._replace(**{field: part})

    for field, reach in {"actor": {1}, "critic": {1}, "critic_target": {1}, "actor_target": {0, 1, 2}}.items():
        after, _ = p((shake(state[0], field),), rows)
        changed = {i for i, (a, b) in enumerate(zip(p.agents(new), p.agents(after), strict=True)) if differing(a, b)}
        assert changed == reach, field


def test_nothing_moves_when_still():
    """An update between two policy updates leaves actor, its optimizer and all targets as they are, bit for bit."""
    p, state, _, new, metrics = base("matd3-still")
    for before, after in zip(p.agents(state), p.agents(new), strict=True):
        assert not differing(before, after, names=("actor", "actor_target", "critic_targets", "actor_adam"))
        assert differing(before, after, names=("critics", "critic_adams"))
    assert np.isnan(metrics.actor_loss).all() and np.isfinite(metrics.critic_loss).all()


def test_terminated_rows_have_no_future():
    """With discount 0 in all rows, x' and all targets are nothing to the update's critics."""
    p, state, rows, _, _ = base("matd3")
    ended = rows.copy()
    ended[..., -1] = 0
    first, _ = p(state, ended)
    ended[..., -1 - p.layout.observation_size : -1] += 1
    second, _ = p(state, ended)
    for one, other in zip(p.agents(first), p.agents(second), strict=True):
        assert not differing(one, other)


# ---- noise -----------------------------------------------------------------------------------------------------------


def test_twin_critics_see_the_same_action():
    """With real noise, critics of an agent that start alike stay alike: both are trained on one target, made of one
    sample of the joint action and of one smoothing of it."""
    p = Program(dataclasses.replace(CASES["matd3"], changes={"smoothing": True}))
    state, rows = p.inputs()

    def alike(s):
        critics = {name: getattr(s, name) for name in ("critic", "critic_target", "critic_optimizer")}
        same = jax.tree.map(lambda leaf: np.repeat(leaf[:, :1], 2, 1) if leaf.ndim > 1 else leaf, critics)
        return s._replace(**same)

    new, _ = p(tuple(map(alike, state)), rows, known_noise_given=False)
    for s in new:
        for leaf in jax.tree.leaves((s.critic, s.critic_target)):
            np.testing.assert_array_equal(leaf[:, 0], leaf[:, 1])


def test_a_target_s_critics_are_drawn_for_each_agent_and_update():
    """Every pair of four critics as often as any other, none twice, independently for the agents."""
    layout, updates = CASES["subset"].layout(), 3000
    (group,) = layout.groups
    keys = jax.random.split(jax.random.key(7), updates)
    drawn = jax.jit(jax.vmap(lambda key: minibatch.draw_noise(layout, group, (1, 2), key, None).critics))(keys)
    pairs = np.sort(drawn, axis=-1)  # [updates, agents, 2]
    assert (pairs[..., 0] < pairs[..., 1]).all()
    code = 4 * pairs[..., 0] + pairs[..., 1]
    for agent in range(layout.num_agents):
        _, counts = np.unique(code[:, agent], return_counts=True)
        # Of 3000 draws each pair gets 500 with a deviation of 20.
        assert len(counts) == 6 and np.abs(counts - updates / 6).max() < 100
        other = code[:, (agent + 1) % layout.num_agents]
        assert abs(np.mean(code[:, agent] == other) - 1 / 6) < 0.04


def test_a_target_of_all_critics_in_any_order_is_that_of_all():
    p = Program(dataclasses.replace(CASES["box"], changes={**CASES["box"].changes, "target_critics": 3}))
    _, state, rows, new, metrics = base("box")
    found, losses = p(state, rows)
    close = functools.partial(np.testing.assert_allclose, rtol=TOLERANCE, atol=TOLERANCE)  # sums in another order
    jax.tree.map(close, (found, losses), (new, metrics))


def test_draws_have_their_own_keys(monkeypatch):
    """No key is drawn from twice in an update: the target's samples, the smoothing and the actor's own fresh action are
    independent of each other and from group to group."""
    p, keys = Program(CASES["interleaved"]), []

    def draw(key, shape=(), *args, **kwargs):
        keys.append(jax.random.key_data(key))
        return jnp.zeros(shape)

    monkeypatch.setattr(jax.random, "gumbel", draw)
    monkeypatch.setattr(jax.random, "normal", draw)

    def run(state, rows):
        keys.clear()
        update.update(p.layout, state, p.hyper, rows, jax.random.key(1), p.move, sequential=True)
        return jnp.stack(keys)

    p.jitted = jax.jit(run)
    drawn = p(*p.inputs(), known_noise_given=False)
    assert len(np.unique(drawn, axis=0)) == len(drawn)
    # Three groups of central critics, two of them of choices: each has 2 samples and 3 smoothings of targets, and the
    # two an own action.
    assert len(drawn) >= 3 * (2 + 3) + 2
