"""Networks that agents have in common: one update against float64 NumPy with literal one-hots, and who shares what."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import known_noise
import numpy as np
import pytest
import sharing_reference
from learner_cases import BATCH, DISTRIBUTION, QUANTILES, Case, adam, drawn, layers, random_rows, random_state

from matd3_jax.core import losses, networks, sequential_actors, sharing, update
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.envs import Box, Simplex
from matd3_jax.errors import UserError

KEY, TOLERANCE = jax.random.key(0), 1e-10
KIND, TEAM = {"share_parameters": "kind"}, {"critic": "shared"}
CASES = {
    "kind": Case("simple_spread", "matd3", changes=KIND | {"hidden": (6, 5)}),
    "kind-batched": Case("interleaved", "matd3", changes=KIND | {"smoothing": True}, one_by_one=False, shared=True),
    "kind-own": Case(
        "point_reach", "iltd3", changes=KIND | {"actor_average": 0.3, "critic_norm": "layer", "clip": "network"}
    ),
    "kind-worst-case": Case("simple_tag", "m3matd3", changes=KIND | QUANTILES | {"actor_critics": "all"}, n_step=2),
    "kind-still": Case("simple_tag", "maddpg", "iltd3", changes=KIND, still=("adversaries",), shared=True),
    "team": Case("simple_tag", "matd3", changes=TEAM | {"smoothing": True, "actor_average": 0.2}),
    "team-kinds": Case("interleaved", "matd3", changes=TEAM, one_by_one=False),
    "team-still": Case("simple_adversary", "matd3", changes=TEAM | DISTRIBUTION, still=("adversaries",), n_step=2),
    "team-against-own": Case("simple_adversary", "matd3", "iltd3", changes={"critic_norm": "layer"}),
    "team-random-order": Case("interleaved", "matd3", changes=TEAM, random_order=True, shared=True),
    "both": Case("interleaved", "matd3", changes=TEAM | KIND | {"smoothing": True}),
    "both-batched": Case("simple_tag", "maddpg", changes=TEAM | KIND, one_by_one=False),
}
MIXED = {"team-against-own": {"agents": "shared"}}
"""Critics of single teams."""


def layout_of(name):
    layout = CASES[name].layout()
    kinds = MIXED.get(name, {})
    changed = [dataclasses.replace(one, critic=kinds.get(team, one.critic))
               for one, team in zip(layout.algorithms, layout.teams, strict=True)]  # fmt: skip
    return dataclasses.replace(layout, algorithms=tuple(changed))


@functools.cache
def base(name):
    """(layout, hyper, state, rows, state and metrics after one update) in float64."""
    case, layout = CASES[name], layout_of(name)
    hyper = case.hyper(layout)
    teams = list(dict.fromkeys(layout.teams))
    firsts = [next(h for h, group in zip(hyper, layout.groups, strict=True) if layout.teams[group.members[0]] == team)
              for team in teams]  # fmt: skip
    hyper = [firsts[teams.index(layout.teams[group.members[0]])] for group in layout.groups]  # one for each team
    batches = 1 if case.shared else layout.num_minibatches
    move = [layout.teams[group.members[0]] not in case.still for group in layout.groups]

    def run(state, rows):
        given = drawn(layout, rows, hyper)
        options = {"one_by_one": case.one_by_one, "random_order": case.random_order}
        return update.update(layout, state, hyper, given, KEY, move, **options)

    rng = np.random.default_rng(1)
    with jax.enable_x64(True), known_noise.known(BATCH):
        state, rows = random_state(layout, rng), random_rows(layout, rng, batches)
        return layout, hyper, state, rows, *jax.tree.map(np.asarray, jax.jit(run)(state, rows))


def network(online, target, optimizer, *place):
    return sharing_reference.Network(layers(online, *place), layers(target, *place), adam(optimizer, *place))


def taken_apart(layout, state):
    """(actors, critics) of the reference: by kind or one for each agent, by team, by kind or one for each agent."""
    actors, critics = [], {}
    for group, s in zip(layout.groups, state, strict=True):
        algorithm, together = group.algorithm, group.algorithm.share_parameters == "kind"
        owners = [list(group.members)] if together else [[i] for i in group.members]
        for k, who in enumerate(owners):
            average = None if s.actor_average is None else layers(s.actor_average, k)
            net = network(s.actor, s.actor_target, s.actor_optimizer, k)
            actors.append(sharing_reference.Actor(who, net, average))
            of_team = algorithm.critic == "shared"
            key = layout.teams[who[0]] if of_team else tuple(who)
            if key in critics:
                critics[key].owners += who
                assert s.critic is None or of_team
                continue
            nets = [network(s.critic, s.critic_target, s.critic_optimizer, k, c) for c in range(algorithm.num_critics)]
            critics[key] = sharing_reference.Critics(list(who), nets, of_team)
    return actors, list(critics.values())


def expected(name, alter=lambda actors, critics: None):
    layout, hyper, state, rows, *_ = base(name)
    case = CASES[name]
    hypers = [hyper[layout.place(i)[0]] for i in range(layout.num_agents)]
    facts = layout.action_spaces, layout.observation_sizes, layout.algorithms, hypers, layout.teams
    people = [sharing_reference.Agent(*own) for own in zip(*facts, strict=True)]
    actors, critics = taken_apart(layout, state)
    alter(actors, critics)
    order = None
    if case.random_order:
        order = sequential_actors.permutation(KEY, range(layout.num_agents)).tolist()
    return sharing_reference.update(
        people,
        actors,
        critics,
        [rows[0 if case.shared else layout.minibatches[i]] for i in range(layout.num_agents)],
        functools.partial(known_noise.table, "gumbel", batch=BATCH),
        functools.partial(known_noise.table, "normal", batch=BATCH),
        [team not in case.still for team in layout.teams],
        order,
    )


def numbers(tree):
    """All arrays in a tree of dataclasses and lists."""
    if dataclasses.is_dataclass(tree):
        return [leaf for field in dataclasses.fields(tree) for leaf in numbers(getattr(tree, field.name))]
    if isinstance(tree, list | tuple):
        return [leaf for one in tree for leaf in numbers(one)]
    return [] if tree is None else [np.asarray(tree)]


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_update_equals_reference(name):
    """All parameters, targets, moments and losses after one update."""
    layout, _, _, _, new, metrics = base(name)
    *want, losses_wanted = expected(name)
    got = taken_apart(layout, new)
    found, wanted = numbers(list(got)), numbers(list(want))
    assert len(found) == len(wanted) > 20
    for a, b in zip(found, wanted, strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=TOLERANCE, atol=TOLERANCE)
    np.testing.assert_allclose(np.stack(metrics), losses_wanted, rtol=TOLERANCE, atol=TOLERANCE)


@pytest.mark.parametrize("name", ["kind", "both"])
def test_large_minibatches_are_computed_alike(name, monkeypatch):
    """In a loop over the agents that adds their gradients up: the same numbers."""
    *_, wanted, _ = base(name)
    monkeypatch.setattr(networks, "SMALL_BATCH", 0)
    *_, found, _ = base.__wrapped__(name)
    for a, b in zip(*map(jax.tree.leaves, (found, wanted)), strict=True):
        np.testing.assert_allclose(a, b, rtol=TOLERANCE, atol=TOLERANCE)


@pytest.mark.parametrize("part", [0, 1], ids=["actor", "critics"])
def test_reference_distinguishes(part):
    """With the index in another order it is elsewhere, by far more than the tolerance."""
    right, wrong = (
        expected("kind", alter)[part] for alter in (lambda *_: None, lambda *both: both[part][0].owners.reverse())
    )
    wrong[0].owners.reverse()
    gaps = [np.abs(a - b).max() for a, b in zip(numbers(right), numbers(wrong), strict=True) if a.ndim]
    assert max(gaps) > 1000 * TOLERANCE


# ---- who shares what -------------------------------------------------------------------------------------------------


def leading(tree):
    return {leaf.shape[0] for leaf in jax.tree.leaves(tree)}


def size(tree):
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


def test_memory_and_optimizers_are_those_of_one_network():
    """Three agents: a third of the numbers, and the rows of the index; the team's critics are there once."""
    plain, kind, team, both = (
        jax.eval_shape(functools.partial(update.init, layout), KEY)[0]
        for layout in (dataclasses.replace(Case("simple_spread", "matd3", changes=change).layout())
                       for change in ({}, KIND, TEAM, KIND | TEAM))
    )  # fmt: skip
    assert leading((plain.actor, plain.critic)) == {3}
    assert leading(kind) == leading(both) == {1} == leading(team.critic_optimizer) and leading(team.actor) == {3}
    rows, critics = 3 * 6, 2  # of the index; twins of 6 hidden units
    assert 3 * (size(kind.actor) - rows) == size(plain.actor)
    assert 3 * (size(kind.critic) - critics * rows) == size(plain.critic)
    assert size(team.critic) == size(both.critic) == size(plain.critic) // 3
    assert size(both.actor_optimizer) == size(kind.actor_optimizer)


def test_opponents_share_nothing():
    """Agents alike in two teams of one algorithm: a group for each team."""
    for change in ({}, KIND, TEAM):
        layout = JointLayout(
            agents=tuple("abcd"),
            teams=("agents", "adversaries") * 2,
            observation_sizes=(3,) * 4,
            action_spaces=(Simplex((2,)),) * 4,
            algorithms=(Algorithm(**change),) * 4,
        )
        assert [group.members for group in layout.groups] == [(0, 2), (1, 3)]
        assert [layout.critic_group(g) for g in range(2)] == [0, 1]
        assert layout.minibatches == ((0, 1, 0, 1) if change is TEAM else (0, 1, 2, 3))


def test_one_agent_of_a_kind_is_as_without_sharing():
    """To the bit: nobody to be told apart from."""
    layouts = [Case("simple_speaker_listener", "matd3", changes=change).layout() for change in ({}, KIND)]
    one, other = (update.init(layout, KEY) for layout in layouts)
    assert not any(group.shared for group in layouts[1].groups)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


def test_agents_that_see_the_same_can_act_differently():
    """And are valued differently by their common critics; as networks with a literal one-hot say."""
    layout = Case("simple_spread", "matd3", changes=KIND).layout()
    (group,) = layout.groups
    (state,) = update.init(layout, KEY)
    seen = jnp.broadcast_to(jax.random.normal(KEY, (1, 4, 18)), (3, 4, 18))
    found = np.asarray(group.outputs(state.actor, seen))
    assert min(np.abs(found[a] - found[b]).max() for a, b in ((0, 1), (0, 2), (1, 2))) > 1e-3
    index = jnp.broadcast_to(jnp.eye(3)[:, None], (3, 4, 3))
    literal = networks.apply(group.actor, jax.tree.map(lambda leaf: leaf[0], state.actor),
                           jnp.concatenate([seen, index], axis=-1).reshape(12, 21))  # fmt: skip
    np.testing.assert_allclose(found.reshape(12, 5), literal, rtol=1e-5, atol=1e-6)
    inputs = jax.random.normal(KEY, (4, layout.observation_size + layout.action_size))
    values = [np.asarray(group.critic.values(group.of_member(state.critic, k), inputs)) for k in range(3)]
    assert np.abs(values[0] - values[1]).max() > 1e-3


def test_other_networks_are_refused():
    with pytest.raises(UserError, match="share_parameters=kind knows perceptrons alone"):
        sharing.network_of({"Dense_0": {"kernel": jnp.ones((1, 5, 2))}}, 0, 2)


def test_only_the_team_s_first_group_has_its_critics():
    layout, _, state, _, new, _ = base("team-kinds")
    for s in (state, new):
        assert [one.critic is None for one in s] == [False, True, True]
        assert all(one.critic_target is None and one.critic_optimizer is None for one in s[1:])
    assert [layout.critic_group(g) for g in range(3)] == [0, 0, 0] and layout.num_minibatches == 1


def test_a_team_s_reward_is_its_mean():
    layout = layout_of("team-against-own")  # an adversary with its own critics, and two agents
    rewards = jnp.array([[5.0, 1.0, 3.0], [0.0, -2.0, 4.0]])
    np.testing.assert_array_equal(layout.team_mean(rewards), [[5, 2, 2], [0, 1, 1]])
    assert layout.minibatches == (0, 1, 1)


def test_targets_are_those_of_the_team(monkeypatch):
    """The team's target is made once an update, whoever many agents there are."""
    calls, real = [], losses.td_target
    monkeypatch.setattr(losses, "td_target", lambda *args: calls.append(1) or real(*args))
    hyper = Case("interleaved", "matd3").hyper(Case("interleaved", "matd3").layout())

    def one_update(layout, state, rows):
        return update.update(layout, state, hyper, rows, KEY, [True] * 3, one_by_one=True)

    for change, number in ((TEAM, 1), (TEAM | KIND, 1), ({}, 5)):
        calls.clear()
        layout = Case("interleaved", "matd3", changes=change).layout()
        state = jax.eval_shape(functools.partial(update.init, layout), KEY)
        rows = jax.ShapeDtypeStruct((layout.num_minibatches, 4, layout.row_size), jnp.float32)
        jax.eval_shape(functools.partial(one_update, layout), state, rows)
        assert len(calls) == number


def test_boxes_have_kinds_of_their_own():
    one, two = Box(2, -1.0, 1.0), Box(2, -1.0, 2.0)
    layout = JointLayout(tuple("abc"), ("agents",) * 3, (3,) * 3, (one, two, one), (Algorithm(**KIND),) * 3)
    assert [(group.members, group.shared) for group in layout.groups] == [((0, 2), True), ((1,), False)]
