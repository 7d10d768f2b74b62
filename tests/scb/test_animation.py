import jax
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

import scb
from scb.analysis import animation
from scb.errors import UserError


def lines(environment, observation):
    axes = Figure().subplots()
    animation.picture(axes, environment, np.array(observation))
    return [np.stack(line.get_data(), axis=1) for line in axes.lines]


def test_a_pendulum_is_drawn_where_it_points():
    np.testing.assert_allclose(lines("Pendulum-v1", [1.0, 0.0, 0.0])[0][-1], [0.0, 1.0])
    # A quarter turn counter-clockwise points to the left.
    np.testing.assert_allclose(lines("Pendulum-v1", [0.0, 1.0, 0.0])[0][-1], [-1.0, 0.0])


def test_an_acrobot_hangs_and_stands():
    hanging = lines("Acrobot-v1", [1.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(hanging[-1][-1], [0.0, -2.0], atol=1e-12)
    # The second angle is relative to the first link: both at half a turn and none stands upright.
    standing = lines("Acrobot-v1", [-1.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(standing[-1][-1], [0.0, 2.0], atol=1e-12)


def test_a_pole_leans_to_the_right_for_positive_angles():
    pole = lines("CartPole-v1", [0.5, 0.0, 0.2, 0.0])[-1]
    np.testing.assert_allclose(pole[0], [0.5, 0.15])
    assert pole[1][0] > 0.5


def test_a_car_stands_on_the_mountain():
    car = lines("MountainCar-v0", [-np.pi / 6, 0.0])[-1][0]
    # The valley's bottom is at 0.1.
    np.testing.assert_allclose(car, [-np.pi / 6, 0.14], atol=1e-9)


def test_a_gif_has_a_picture_of_every_observation(tmp_path):
    angles = np.linspace(0, 3, 7)
    observations = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    path = animation.save_gif(tmp_path / "x.gif", "Pendulum-v1", observations, every=2)
    with Image.open(path) as gif:
        assert gif.n_frames == 7
        assert gif.info["duration"] == 40


def test_what_has_no_picture_is_refused():
    with pytest.raises(UserError, match="no picture of ant: choose one of Acrobot-v1"):
        animation.picture(Figure().subplots(), "ant", np.zeros(3))


@pytest.mark.slow
def test_a_brax_episode_is_a_page_with_its_states(tmp_path):
    env, _ = scb.make("inverted_pendulum", backend="spring")
    path, earned = animation.save_brax_html(
        tmp_path / "x.html", env, lambda o, k: jax.numpy.zeros(1), jax.random.key(0), 20
    )
    # One for every step that the pole stands.
    assert 0 < earned <= 20
    assert "<html" in path.read_text().lower()
