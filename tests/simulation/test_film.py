"""A film: its frames, its still pictures at both ends, and words that follow what happens."""

import imageio.v2 as imageio
import numpy as np
import pytest

from marl_handover.arrays import wrap
from marl_handover.config import TaskConfig
from marl_handover.envs.backends import make_backend
from marl_handover.simulation.film import BEGIN_S, END_S, filming, picture_size

SIZE, FPS = (160, 120), 10


@pytest.fixture(scope="module")
def backend(model, motion, engine):
    backend = make_backend(engine, model, TaskConfig(), motion, grasp="constraint", size=picture_size(SIZE, True))
    yield backend
    backend.close()


def difference(theta_rad, goal_rad):
    return float(wrap(theta_rad - goal_rad))


def test_an_episode_on_film(backend, cycle, tmp_path):
    backend.reset(np.array([60.0, -10.0, 0.0]), 0)
    with filming(tmp_path / "a.mp4", FPS, backend, SIZE, True, difference) as film:
        film.begin(np.array([-40.0, 5.0, 0.0]))
        film.turn(1, True)
        done = backend.carry_out(1, cycle(1, (60.0, -10.0), (-40.0, 5.0), 0.6))
        film.end("success")
    assert done.refusal is None
    assert backend.on_step is None
    frames = np.stack([*imageio.get_reader(tmp_path / "a.mp4").iter_data()]).astype(int)
    assert frames.shape[1:3] == (SIZE[1], SIZE[0])
    moving = FPS * backend.last.duration_s
    assert len(frames) == pytest.approx(FPS * (BEGIN_S + END_S) + moving, abs=2)
    top = picture_size(SIZE, True)[1]
    first, last = frames[0], frames[-1]
    words = [np.abs(frame[top + 1 :] - first[top + 1 :]).max() for frame in frames]
    assert max(words[: round(FPS * BEGIN_S)]) < 40  # stands still, but for what compression does
    assert min(words[round(FPS * BEGIN_S) + 1 :]) > 100  # an arm has been named
    assert np.abs(last[:top] - first[:top]).max() > 100  # the block has moved


def test_an_error_leaves_neither_film_nor_camera_man(backend, tmp_path):
    def fail():
        with filming(tmp_path / "a.gif", FPS, backend, SIZE, False, difference) as film:
            film.begin(np.zeros(3))
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert backend.on_step is None
    assert not list(tmp_path.iterdir())


def test_without_words_the_picture_has_all_the_room():
    assert picture_size(SIZE, False) == SIZE
    assert picture_size(SIZE, True)[1] < SIZE[1]
