"""A film of episodes in the simulated cell: a picture whenever one is due while arms move, with words below it if wanted."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from marl_handover.cell.cell import Cell
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.palette import FAINT, GREY, INK, OUTCOMES, PAPER, SHARED, YELLOW, arm_colour
from marl_handover.simulation.backend import PhysicsBackend
from marl_handover.simulation.block import TABLE_RGB
from marl_handover.simulation.camera import Pixels
from marl_handover.simulation.video import FrameClock, Video
from marl_handover.simulation.world import CONTROL_S, SimulatedCell

Floats = NDArray[np.float64]

_TINT, _SHARED_TINT = 0.22, 0.4
_STRIP = 96
_APART_MM = 60.0
"""Neighbours on the edge of a chart that are so far apart belong to two pieces."""


def dress(cell: SimulatedCell) -> None:
    """Tint the sectors of the table that the arms reach and what each two of them share, and colour the bases, until the next reset."""
    model = cell.model.cell
    for index in range(len(cell.arms)):
        colour = arm_colour(index)
        cell.engine.lay(*_sector_mm(model, index), 0.1 + 0.05 * index, _tinted(colour, _TINT))
        cell.engine.paint_base(index, _rgb(colour))
    for number, (one, other) in enumerate(_shared_mm(model)):
        cell.engine.lay(one, other, 0.1 + 0.05 * len(cell.arms) + 0.01 * number, _tinted(SHARED, _SHARED_TINT))


def _sector_mm(cell: Cell, arm: int) -> tuple[Floats, Floats]:
    """Inner and outer edge (n, 2) of an arm's annulus sector."""
    base = cell.bases[arm]
    ring = cell.arms[arm]
    angle = base.facing_rad + np.linspace(*ring.yaw_rad, _STRIP)
    ray = np.stack([np.cos(angle), np.sin(angle)], -1)
    at = base.position_mm
    return at + ring.r_min_mm * ray, at + ring.r_max_mm * ray


def _shared_mm(cell: Cell) -> Iterator[tuple[Floats, Floats]]:
    """Lower and upper edge (n, 2) of every chart, one after the other; a chart of several pieces in as many."""
    along = np.linspace(-1.0, 1.0, _STRIP)
    for _, space in sorted(cell.graph.edges.items()):
        one, other = (np.asarray(space.to_table(along, 0 * along + end)) for end in (-1, 1))
        apart = np.maximum(*(np.hypot(*np.diff(edge, axis=0).T) for edge in (one, other))) > _APART_MM
        for piece in np.split(np.arange(_STRIP), np.flatnonzero(apart) + 1):
            if len(piece) > 1:
                yield one[piece], other[piece]


def _rgb(colour: str) -> Floats:
    return np.array([int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)])


def _tinted(colour: str, share: float) -> Floats:
    """The table with so much of a colour over it."""
    return share * _rgb(colour) + (1 - share) * np.array(TABLE_RGB)


_LINES_A_PICTURE, _WIDTH_A_LETTER = 21.0, 37.0
"""A letter is as high as a picture of this many lines, and as wide as one of so many letters of this size, whichever is smaller."""

_LONGEST = 9
"""Letters of an arm's name; longer ones are cut."""

_LEADING, _MARGIN = 1.35, 0.5
"""Height of a line, and the border around all, in letters."""


BRIGHT = (YELLOW,)
"""Colours on which white cannot be read."""


class Caption(NamedTuple):
    """What there is to say about one picture.

    ``arm`` is the index of the one that moves, -1 before the first transfer, and ``label`` what the cell calls it; ``away_mm`` and
    ``turned_rad`` (signed) are the block's errors against the goal; ``outcome`` is empty while the episode goes on.
    """

    transfer: int
    arm: int
    final: bool
    away_mm: float
    turned_rad: float
    outcome: str = ""
    label: str = ""


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
        draw.text((margin + 0.55 * letter, first), _label(caption)[0].upper(), PAPER, _font(letter), anchor="mm")
        left += 1.6 * letter
    draw.text((left, first), _deed(caption), INK, _font(letter), anchor="lm")
    draw.text((margin, second), _distance(caption), INK, _font(letter), anchor="lm")
    if caption.outcome:
        words = caption.outcome.replace("_", " ")
        _badge(draw, (width - margin, (first + second) / 2), words, OUTCOMES.get(caption.outcome, GREY), round(1.2 * letter))
    return np.asarray(page)


def _label(caption: Caption) -> str:
    return caption.label or ARM_LETTERS[caption.arm]


def _deed(caption: Caption) -> str:
    if caption.arm < 0:
        return "the task: the block onto the green square, red bar on red bar"
    label = _label(caption)
    short = label if len(label) <= _LONGEST else f"{label[: _LONGEST - 1]}…"
    arm = {"L": "left arm", "R": "right arm"}.get(label, f"arm {short}")
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


OrientationError = Callable[[float, float], float]
"""Signed error in rad of an orientation against the goal's."""

BEGIN_S, END_S = 1.0, 2.0
"""How long the first and the last picture of an episode stand still, so that one can see the problem and how it ended."""


def picture_size(size: tuple[int, int], captions: bool) -> tuple[int, int]:
    """Width and height of the camera's part of a video of ``size``."""
    return size[0], size[1] - (band_px(size) if captions else 0)


class Film:
    """What :meth:`begin`, :meth:`turn` and :meth:`end` tell it, and what happens in between, as a video.

    Args:
        video: takes the frames.
        fps: pictures a second of simulated time.
        backend: the cell; its pictures have the size of :func:`picture_size`.
        size: width and height of the video.
        captions: whether there are words, and the arms' reach on the table.
        error: how orientations differ.
    """

    def __init__(
        self, video: Video, fps: float, backend: PhysicsBackend, size: tuple[int, int], captions: bool, error: OrientationError
    ) -> None:
        self._video, self._fps, self._backend, self._size, self._captions = video, fps, backend, size, captions
        self._error = error
        self._clock = FrameClock(fps, CONTROL_S)
        self._goal: Floats = np.zeros(3)
        self._transfer, self._arm, self._final, self._outcome = 0, -1, False, ""

    def begin(self, goal: Floats) -> None:
        """An episode begins: show the problem."""
        self._goal = np.asarray(goal, float)
        self._transfer, self._arm, self._final, self._outcome = 0, -1, False, ""
        self._backend.cell.show_goal(self._goal)
        if self._captions:
            dress(self._backend.cell)
        self._add(self._still(BEGIN_S))

    def turn(self, arm: int, final: bool) -> None:
        """``arm`` is to move next."""
        self._transfer, self._arm, self._final = self._transfer + 1, arm, final

    def step(self) -> None:
        """A piece of simulated time, :data:`CONTROL_S`, has passed."""
        self._add(self._clock.due())

    def end(self, outcome: str) -> None:
        """The episode is over: show how it ended."""
        self._outcome = outcome
        self._add(self._still(END_S))

    def _still(self, seconds: float) -> int:
        return max(1, round(seconds * self._fps))

    def _add(self, count: int) -> None:
        """The cell as it is now, so many times."""
        if count == 0:
            return
        picture = self._backend.render()
        if self._captions:
            picture = captioned(picture, self._caption(), self._size)
        for _ in range(count):
            self._video.add(picture)

    def _caption(self) -> Caption:
        pose = self._backend.cell.object_pose()
        away_mm = math.dist(pose[:2], self._goal[:2])
        turned_rad = float(self._error(pose[2], self._goal[2]))
        label = self._backend.cell.model.cell.labels[self._arm] if self._arm >= 0 else ""
        return Caption(self._transfer, self._arm, self._final, away_mm, turned_rad, self._outcome, label)


@contextmanager
def filming(
    path: Path | str, fps: float, backend: PhysicsBackend, size: tuple[int, int], captions: bool, error: OrientationError
) -> Iterator[Film]:
    """A :class:`Film` that gets a picture whenever one is due while arms move; the file appears when the block ends without an error."""
    with Video(path, fps) as video:
        film = Film(video, fps, backend, size, captions, error)
        backend.on_step = film.step
        try:
            yield film
        finally:
            backend.on_step = None
