"""Captions: below the picture, never over it, large enough to be read, with room at both sides."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import ImageColor

from marl_handover.palette import OUTCOMES, arm_colour
from marl_handover.simulation.film import Caption, band_px, captioned

SIZES = [(640, 360), (640, 480), (320, 240), (1280, 720), (480, 480), (360, 640)]
WIDEST = Caption(88, 1, True, 888.8, -math.radians(178.8), "wrong_orientation")


def drawn(caption, size):
    """The whole, and the band alone."""
    picture = np.full((size[1] - band_px(size), size[0], 3), 99, np.uint8)
    whole = captioned(picture, caption, size)
    np.testing.assert_array_equal(whole[: len(picture)], picture)
    return whole, whole[len(picture) + 1 :]


def rows_and_columns(band, colour=None):
    """Where the band is not white, or has a colour."""
    marked = (band != 255).any(-1) if colour is None else (band == ImageColor.getrgb(colour)).all(-1)
    return np.flatnonzero(marked.any(1)), np.flatnonzero(marked.any(0))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("outcome", [*OUTCOMES, ""])
def test_the_picture_is_untouched_and_the_words_have_room(size, outcome):
    whole, band = drawn(WIDEST._replace(outcome=outcome), size)
    assert whole.shape == (size[1], size[0], 3)
    rows, columns = rows_and_columns(band)
    assert 0 < rows.min() <= rows.max() < len(band) - 1
    assert 0 < columns.min() <= columns.max() < size[0] - 1


@pytest.mark.parametrize("size", SIZES)
def test_the_outcome_covers_no_other_words(size):
    """The box stands right of all that is there without it."""
    _, band = drawn(WIDEST, size)
    _, without = drawn(WIDEST._replace(outcome=""), size)
    _, box = rows_and_columns(band, OUTCOMES["wrong_orientation"])
    _, words = rows_and_columns(without)
    assert words.max() < box.min()


def test_at_640_by_360_letters_are_large_enough():
    _, band = drawn(Caption(1, 0, False, 100.0, 0.5), (640, 360))
    dark = (band < 80).all(-1).any(1)
    heights = np.diff(np.flatnonzero(np.diff(np.concatenate([[0], dark, [0]]))))[::2]
    assert len(heights) == 2  # two lines, apart
    assert heights.min() >= 12


def test_what_is_said_is_seen():
    size = (640, 360)
    one = Caption(2, 0, False, 10.0, 0.1)
    changes = [{"transfer": 3}, {"arm": 1}, {"final": True}, {"away_mm": 10.1}, {"turned_rad": -0.1}, {"outcome": "success"}, {"arm": -1}]
    pictures = {drawn(one._replace(**change), size)[0].tobytes() for change in changes} | {drawn(one, size)[0].tobytes()}
    assert len(pictures) == len(changes) + 1
    for arm in (0, 1):
        _, band = drawn(one._replace(arm=arm), size)
        assert len(rows_and_columns(band, arm_colour(arm))[0])
    assert drawn(one._replace(turned_rad=-1e-6), size)[0].tobytes() == drawn(one._replace(turned_rad=0.0), size)[0].tobytes()


@given(width=st.integers(16, 400), height=st.integers(30, 400))
def test_any_size_gives_that_size(width, height):
    size = (2 * width, 2 * height)
    assert 0 < band_px(size) < size[1]
    assert band_px(size) % 2 == 0
    whole, _ = drawn(WIDEST, size)
    assert whole.shape == (size[1], size[0], 3)


def test_an_arm_of_many_is_called_by_its_name_and_a_long_one_is_cut():
    """The box has its colour and first letter; names differ in words, and even the longest leaves room for the outcome."""
    size = (640, 360)
    many = [Caption(1, 2, False, 100.0, 0.5, label=label) for label in ("east", "west", "a very long name of an arm")]
    bands = [drawn(caption, size)[1] for caption in many]
    for band in bands:
        assert len(rows_and_columns(band, arm_colour(2))[0]) > 0
    assert (bands[0] != bands[1]).any()
    long = WIDEST._replace(label="a very long name of an arm")
    _, box = rows_and_columns(drawn(long, size)[1], OUTCOMES["wrong_orientation"])
    _, words = rows_and_columns(drawn(long._replace(outcome=""), size)[1])
    assert words.max() < box.min()
