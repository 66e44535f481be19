"""Drawings in the plane: what is seen where, in which color and how large, and that nothing leaves the picture."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from matd3_jax.envs import OptionError, make
from matd3_jax.envs.point_reach import PointState
from matd3_jax.figures.style import BLUE, DARK_GREY, GREEN, GREY, PALE_GREEN, PURPLE, VERMILION, YELLOW
from matd3_jax.video import particle, plane, point_reach

SIDE = 300
TASKS = (
    "simple_spread", "simple_speaker_listener", "simple_crypto", "simple_push", "simple_adversary", "simple_tag",
    "simple", "simple_reference", "simple_world_comm",
)  # fmt: skip


def still(env, frames=1, **changes):
    """A start state of a particle task with some fields changed, repeated."""
    state, _ = jax.jit(env.reset)(jax.random.key(0))
    state = state._replace(**{name: jnp.asarray(value) for name, value in changes.items()})
    return jax.tree.map(lambda leaf: jnp.stack([leaf] * frames), state)


def draw(env, states):
    return [np.asarray(image) for image in particle.scene(env, states).images(SIDE)]


def at(place, half=1.08, center=(0.0, 0.0)):
    """(row, column) of a place in the world, where the view is a square about `center`."""
    x, y = (np.asarray(place) - center) / (2 * half)
    return int((0.5 - y) * SIDE), int((0.5 + x) * SIDE)


def close(pixels, color, tolerance=60):
    """Where pixels [..., 3] show a color, an agent's transparency allowed for."""
    return np.abs(np.asarray(pixels, int) - color).max(axis=-1) < tolerance


TAG = [[-0.6, 0.5], [0.6, 0.5], [0.0, -0.4], [0.2, 0.8]]


def test_everything_is_where_it_is_and_in_its_color():
    """Three predators and a prey, y upwards; obstacles dark."""
    image = draw(make("simple_tag"), still(make("simple_tag"), pos=TAG, landmark=[[-0.5, -0.6], [0.6, -0.5]]))[0]
    assert image.shape == (SIDE, SIDE, 3) and image.dtype == np.uint8
    for place, color in zip(TAG, [VERMILION] * 3 + [BLUE], strict=True):
        row, column = at(np.array(place) + [0, 0.035])  # above the number that stands in its middle
        assert close(image[row, column], color), (place, image[row, column])
    for place in ([-0.5, -0.6], [0.6, -0.5]):
        assert close(image[at(place)], DARK_GREY, 5)
    assert close(image[at([0.5, 0.0])], (255, 255, 255), 25)


@pytest.mark.parametrize(("name", "radius"), [("simple_spread", 0.15), ("simple_tag", 0.05)])
def test_sizes_are_those_of_the_world(name, radius):
    """An agent alone in the lower half is as wide and as high there as its diameter: more blue than red."""
    env = make(name)
    pos = [[-0.6, 0.5], [0.6, 0.5], [0.0, 0.3]][: len(env.agents) - 1] + [[0.1, -0.5]]
    image = draw(env, still(env, pos=pos, landmark=np.full((len(env.world.landmark_radius), 2), 0.7)))[0]
    lower = image[SIDE // 2 + 5 :].astype(int)
    for places in np.nonzero(lower[..., 2] - lower[..., 0] > 40):
        assert places.max() - places.min() + 1 == pytest.approx(2 * radius / 2.16 * SIDE, abs=2)


def test_the_view_stays_and_holds_what_runs_away():
    """One agent ends at (7, -3): it is in sight there, and a landmark is in the same place from first to last."""
    env = make("simple_spread")
    states = still(env, frames=3, landmark=[[0.5, 0.5], [-0.5, 0.5], [0, -0.5]])
    path = jnp.array([[0.0, 0.0], [3.0, -1.0], [7.0, -3.0]])
    states = states._replace(pos=states.pos.at[:, 0].set(path).at[:, 1:].set(jnp.array([[0.9, 0.9], [-0.9, 0.9]])))
    images = draw(env, states)
    half, center = 1.08 * 8.15 / 2, (3.075, -1.075)  # from -1 to 7.15, and from -3.15 to 1
    for image, place in zip(images, path, strict=True):
        assert close(image[at(place, half, center)], BLUE)
        for landmark in ([0.5, 0.5], [-0.5, 0.5], [0, -0.5]):
            assert close(image[at(landmark, half, center)], GREY)
    assert not close(images[2][at(path[0], half, center)], BLUE)


def test_nothing_shrinks_out_of_sight():
    env = make("simple_tag")
    states = still(env, pos=[[50.0, 0.0], *TAG[1:]])
    image = draw(env, states)[0]
    assert close(image, VERMILION).sum() > 30 and close(image, BLUE).sum() > 5


def test_a_landmark_under_an_agent_stays_visible():
    env = make("simple_spread")
    image = draw(env, still(env, pos=[[0.5, 0.5], [-0.5, 0.5], [0.5, -0.5]], landmark=[[0.58, 0.5]] * 3))[0]
    covered, free = image[at([0.58, 0.5])].astype(int), image[at([0.42, 0.5])].astype(int)
    assert free[0] - covered[0] > 15 and covered[2] > covered[0] + 60  # darker, and still blue


@pytest.mark.parametrize("name", ["simple_push", "simple_adversary", "simple_speaker_listener"])
def test_the_goal_is_green(name):
    env = make(name)
    states = still(env, goal=1)
    image = draw(env, states._replace(pos=states.pos * 0 + 0.9))[0]
    half, center = plane_of(env, states._replace(pos=states.pos * 0 + 0.9))
    for i, place in enumerate(np.asarray(states.landmark[0])):
        assert close(image[at(place, half, center)], GREEN if i == 1 else GREY, 25)


def plane_of(env, states):
    center, half = particle.scene(env, states).view()
    return half, center


def messages(env, comm, **changes):
    pos = changes.pop("pos", np.linspace(-0.7, 0.7, 2 * len(env.agents)).reshape(-1, 2))
    return draw(env, still(env, pos=pos, comm=comm, **changes))[0]


def test_a_speaker_shows_each_entry_of_its_message():
    env = make("simple_speaker_listener")

    def purple(*said):
        return close(messages(env, [said, [0.0] * 3]), PURPLE, 10).sum()

    silent, half, one, all_ = purple(0, 0, 0), purple(0, 0.5, 0), purple(0, 1, 0), purple(1, 1, 1)
    assert silent < half < one < all_
    assert all_ - silent == pytest.approx(3 * (one - silent), rel=0.15)  # widths differ by a pixel
    assert half - silent == pytest.approx((one - silent) / 2, rel=0.1)


def test_a_walking_speaker_takes_its_message_along():
    """The leader goes from left to right; its chart stays above it and the silent ones have none."""
    env = make("simple_world_comm")
    n = len(env.agents)
    states = still(env, frames=2, comm=np.ones((n, 4)), landmark=[[0.9, -0.9]] * 5)
    pos = np.full((2, n, 2), -0.9)
    pos[:, 0] = [[-0.5, 0.3], [0.5, 0.3]]
    for place, image in zip(pos[:, 0], draw(env, states._replace(pos=jnp.asarray(pos))), strict=True):
        rows, columns = np.nonzero(close(image, PURPLE, 10))
        half, center = plane_of(env, states._replace(pos=jnp.asarray(pos)))
        row, column = at(place, half, center)
        assert rows.max() < row and columns.mean() == pytest.approx(column, abs=2)
        assert columns.max() - columns.min() == pytest.approx(4 * 0.03 * SIDE, abs=4)


def test_a_long_message_is_no_wider_than_a_fifth_of_the_picture():
    env = make("simple_reference")
    image = messages(env, np.concatenate([np.ones((1, 10)), np.zeros((1, 10))]), pos=[[-0.5, 0.0], [0.5, 0.0]])
    left = np.nonzero(close(image[:, : SIDE // 2], PURPLE, 10))[1]
    assert left.max() - left.min() == pytest.approx(0.2 * SIDE, abs=4)


@pytest.mark.parametrize(("goal", "labels"), [([2, 0], ["0", "", "1"]), ([1, 1], ["", "0 1", ""])])
def test_goals_bear_the_numbers_of_those_that_should_go_there(goal, labels):
    """In simple_reference goal[0] is agent 1's and goal[1] is agent 0's."""
    env = make("simple_reference")
    discs = particle.scene(env, still(env, goal=goal)).discs[:3]
    assert [disc.label for disc in discs] == labels
    assert [disc.ringed for disc in discs] == [bool(label) for label in labels]
    assert [disc.color for disc in discs] == [GREEN if label else GREY for label in labels]


def test_food_in_a_forest_is_seen_and_so_is_who_hides_there():
    """Whatever the order of landmarks, forests lie lowest."""
    env = make("simple_world_comm")
    landmark = [[-0.6, -0.6], [0.5, 0.6], [0.6, -0.6], [0.5, 0.5], [-0.5, 0.6]]
    pos = [[-0.9, 0.0], [-0.3, 0.0], [0.0, 0.0], [0.3, 0.0], [0.5, 0.4], [0.9, 0.0]]
    image = draw(env, still(env, landmark=landmark, pos=pos))[0]
    half, center = plane_of(env, still(env, landmark=landmark, pos=pos))
    for place, color in (
        ([-0.6, -0.6], DARK_GREY), ([0.5, 0.6], YELLOW), ([0.6, -0.6], YELLOW), ([0.3, 0.5], PALE_GREEN),
        ([-0.5, 0.6], PALE_GREEN), ([0.47, 0.4], BLUE),
    ):  # fmt: skip
        assert close(image[at(place, half, center)], color, 45), place


def test_silent_agents_show_no_message():
    for name in ("simple_spread", "simple_push", "simple_adversary", "simple_tag"):
        assert not close(draw(make(name), still(make(name)))[0], PURPLE, 10).any()


@pytest.mark.parametrize("goal", [0, 1])
def test_the_entry_for_the_goal_is_green_in_covert_communication(goal):
    """Bob says the right code: green; Eve the other one: purple."""
    env = make("simple_crypto")
    right, wrong = np.eye(4)[goal], np.eye(4)[1 - goal]
    alone = close(messages(env, [wrong, [0.0] * 4, [0.0] * 4], goal=goal), GREEN, 10).sum()
    assert close(messages(env, [wrong, right, [0.0] * 4], goal=goal), GREEN, 10).sum() > 2 * alone


@pytest.mark.parametrize("corner", [(1, 1), (-1, 1), (1, -1), (-1, -1), (0, 0)])
def test_message_and_label_stay_in_sight(corner):
    """The speaker in any corner: all of its message is seen, and as much black of its name as in the middle."""
    env = make("simple_speaker_listener")
    middle, there = (
        messages(env, [[1.0] * 3, [0.0] * 3], pos=[place, (0.5, 0.5)])
        for place in ((-0.5, 0.0), np.array(corner) * 1.0)
    )
    assert close(there, PURPLE, 10).sum() >= 0.97 * close(middle, PURPLE, 10).sum()
    assert close(there, (0, 0, 0), 100).sum() == pytest.approx(close(middle, (0, 0, 0), 100).sum(), rel=0.2)


@pytest.mark.parametrize("name", TASKS)
def test_every_task_is_drawn_and_explained(name):
    """As many pictures as states, all different where all move; every color of the legend is seen."""
    env = make(name)
    keys = jax.random.split(jax.random.key(1), 4)
    state, _ = jax.jit(env.reset)(keys[0])
    states, step = [state], jax.jit(env.step)
    sample = jax.jit(lambda key: tuple(space.sample(key) for space in env.action_spaces))
    for key in keys:
        action = sample(key)
        states.append(step(key, states[-1], action).state)
    images = draw(env, jax.tree.map(lambda *leaves: jnp.stack(leaves), *states))
    assert len(images) == 5
    assert all(np.any(a != b) for a, b in zip(images, images[1:], strict=False))
    legend = particle.legend(env)
    assert [what for what, _ in legend][: len(set(env.teams))]
    for what, color in legend:
        assert close(images[-1], color).any(), what


def point(env, pos, target):
    state = PointState(jnp.array([pos]), jnp.zeros((1, *np.shape(pos))), jnp.array([target]), jnp.zeros(1, jnp.int32))
    return np.asarray(next(point_reach.scene(env, state).images(SIDE)))


def test_point_masses_on_a_plane():
    image = point(make("point_reach"), [[0.5, 0.5], [-0.5, 0.0]], [0.0, -0.7])
    assert close(image[at([0.0, -0.7])], GREEN, 5)
    for place in ([0.53, 0.5], [-0.47, 0.0]):
        assert close(image[at(place)], BLUE)


def test_point_masses_on_a_line_are_at_height_zero():
    image = point(make("point_reach", dim=1), [[0.5], [-0.5]], [0.0])
    assert close(image[at([0.0, 0.0])], GREEN, 5)
    for place in ([0.53, 0.0], [-0.47, 0.0]):
        assert close(image[at(place)], BLUE)
    assert np.nonzero(close(image, BLUE))[0].mean() == pytest.approx(SIDE / 2, abs=2)


def test_space_cannot_be_drawn():
    with pytest.raises(OptionError, match="dim=3"):
        point(make("point_reach", dim=3), [[0.0] * 3] * 2, [0.0] * 3)


def test_the_typeface_is_there():
    assert plane.font(12).getlength("step") > 10
