"""Words under a video's pictures: who moves, what for, and how far the block is from its goal. They need no font of the system."""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.palette import FAINT, GREY, INK, OUTCOMES, PAPER, YELLOW, arm_colour
from marl_handover.simulation.camera import Pixels

_LINES_A_PICTURE, _WIDTH_A_LETTER = 21.0, 37.0
"""A letter is as high as a picture of this many lines, and as wide as one of so many letters of this size, whichever is smaller."""

_LEADING, _MARGIN = 1.35, 0.5
"""Height of a line, and the border around all, in letters."""


BRIGHT = (YELLOW,)
"""Colours on which white cannot be read."""


class Caption(NamedTuple):
    """What there is to say about one picture.

    ``arm`` is the index of the one that moves, -1 before the first transfer; ``away_mm`` and ``turned_rad`` (signed) are the block's errors
    against the goal; ``outcome`` is empty while the episode goes on.
    """

    transfer: int
    arm: int
    final: bool
    away_mm: float
    turned_rad: float
    outcome: str = ""


def band_px(size: tuple[int, int]) -> int:
    """How many of the lines of a video of ``size`` (width, height) the words take: an even number, below the picture, never over it."""
    letter = _letter_px(size)
    return 2 * math.ceil((2 * _LEADING + 2 * _MARGIN) * letter / 2)


def captioned(picture: Pixels, caption: Caption, size: tuple[int, int]) -> Pixels:
    """``picture`` with the words below: RGB (height, width, 3) of ``size``.

    Args:
        picture: RGB, ``size`` without the band's lines.
        caption: what to say.
        size: width and height of the whole.
    """
    page = Image.new("RGB", size, PAPER)
    page.paste(Image.fromarray(picture))
    draw, letter, width, top = ImageDraw.Draw(page), _letter_px(size), size[0], picture.shape[0]
    draw.line([(0, top), (width, top)], fill=FAINT)
    margin, first = _MARGIN * letter, top + (_MARGIN + _LEADING / 2) * letter
    second = first + _LEADING * letter
    left = margin
    if caption.arm >= 0:
        box = [margin, first - 0.55 * letter, margin + 1.1 * letter, first + 0.55 * letter]
        draw.rectangle(box, fill=arm_colour(caption.arm))
        draw.text((margin + 0.55 * letter, first), ARM_LETTERS[caption.arm], PAPER, _font(letter), anchor="mm")
        left += 1.6 * letter
    draw.text((left, first), _deed(caption), INK, _font(letter), anchor="lm")
    draw.text((margin, second), _distance(caption), INK, _font(letter), anchor="lm")
    if caption.outcome:
        words = caption.outcome.replace("_", " ")
        _badge(draw, (width - margin, (first + second) / 2), words, OUTCOMES.get(caption.outcome, GREY), round(1.2 * letter))
    return np.asarray(page)


def _deed(caption: Caption) -> str:
    if caption.arm < 0:
        return "the task: the block onto the green square, red bar on red bar"
    arm = {"L": "left arm", "R": "right arm"}.get(ARM_LETTERS[caption.arm], f"arm {ARM_LETTERS[caption.arm]}")
    return f"transfer {caption.transfer}: {arm}, {'final: to the goal' if caption.final else 'hand-over'}"


def _distance(caption: Caption) -> str:
    degrees = round(math.degrees(caption.turned_rad), 1) + 0.0  # no -0.0
    return f"to the goal: {caption.away_mm:.1f} mm, {degrees:+z.1f}°"


def _badge(draw: ImageDraw.ImageDraw, right: tuple[float, float], words: str, colour: str, letter: int) -> None:
    """Words in a coloured box that ends at ``right``."""
    font = _font(letter)
    width = font.getlength(words)
    x, y = right
    draw.rectangle([x - width - 1.2 * letter, y - 0.85 * letter, x, y + 0.85 * letter], fill=colour)
    draw.text((x - 0.6 * letter, y), words, INK if colour in BRIGHT else PAPER, font, anchor="rm")


def _letter_px(size: tuple[int, int]) -> int:
    width, height = size
    return max(6, round(min(height / _LINES_A_PICTURE, width / _WIDTH_A_LETTER)))


@cache
def _font(letter_px: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own font, which comes with it."""
    return ImageFont.load_default(size=letter_px)
