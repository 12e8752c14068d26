"""A canvas for environments that need no simulator's renderer."""

from __future__ import annotations

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import ArrayLike, NDArray

from htr_envs.task_env import FloatArray

try:
    from PIL import Image, ImageDraw, ImageFont
except ImportError as error:
    raise DependencyNotInstalled('Pillow is missing, which draws the pictures: run `pip install "sb3_htr[video]"`.') from error

SIZE = 400
# Drawn this much larger and made smaller at the end, for smooth edges
SCALE = 3

# Okabe and Ito's palette, whose colours stay apart for colour-blind eyes
BLACK, WHITE = (0, 0, 0), (255, 255, 255)
GREY, DARK_GREY = (200, 200, 200), (110, 110, 110)
ORANGE, PALE_ORANGE = (230, 159, 0), (250, 226, 170)
BLUE = (0, 114, 178)

Colour = tuple[int, int, int]


class Canvas:
    """A white square picture of the plane around (0, 0).

    Shapes are given in the plane's units, line widths and sizes of signs in pixels. What is drawn later covers what was drawn
    before.

    :param half_width: the picture shows x and y from minus to plus this number.
    """

    def __init__(self, half_width: float) -> None:
        self.pixel = 2.0 * half_width / SIZE
        self._half_width = half_width
        self._image = Image.new("RGB", (SCALE * SIZE, SCALE * SIZE), WHITE)
        self._draw = ImageDraw.Draw(self._image)
        self._font = ImageFont.load_default(13 * SCALE)

    def _at(self, points: ArrayLike) -> list[tuple[float, float]]:
        x, y = np.atleast_2d(np.asarray(points, dtype=np.float64)).T * (SCALE / self.pixel)
        middle = SCALE * SIZE / 2
        return [*zip((middle + x).tolist(), (middle - y).tolist(), strict=True)]  # y grows upwards, rows grow downwards

    def _box(self, center: ArrayLike, radius: float) -> tuple[float, float, float, float]:
        ((x, y),) = self._at(center)
        reach = SCALE * radius / self.pixel
        return x - reach, y - reach, x + reach, y + reach

    def disc(self, center: ArrayLike, radius: float, colour: Colour) -> None:
        """Draw a filled circle."""
        self._draw.ellipse(self._box(center, radius), fill=colour)

    def circle(self, center: ArrayLike, radius: float, width: float, colour: Colour, upper_half: bool = False) -> None:
        """Draw the outline of a circle, or of its upper half."""
        box = self._box(center, radius + width / 2 * self.pixel)
        self._draw.arc(box, *((180, 360) if upper_half else (0, 360)), fill=colour, width=max(round(SCALE * width), 1))

    def line(self, points: ArrayLike, width: float, colour: Colour) -> None:
        """Draw straight lines from point to point, (n, 2)."""
        self._draw.line(self._at(points), fill=colour, width=round(SCALE * width), joint="curve")

    def cross(self, center: ArrayLike, size: float, colour: Colour) -> None:
        """Draw an x."""
        reach = size * self.pixel
        for slope in (-1.0, 1.0):
            self.line(np.asarray(center) + np.array([(-reach, -slope * reach), (reach, slope * reach)]), 2.5, colour)

    def text(self, point: ArrayLike, text: str, anchor: str = "lm") -> None:
        """Write, with the point where Pillow's anchor says."""
        self._draw.text(self._at(point)[0], text, DARK_GREY, self._font, anchor)

    def axes(self) -> None:
        """Draw both axes with labelled ticks."""
        half_width, pixel = self._half_width, self.pixel
        tick = 1 if half_width < 5.0 else 5
        self.line([(-half_width, 0.0), (half_width, 0.0)], 1, GREY)
        self.line([(0.0, -half_width), (0.0, half_width)], 1, GREY)
        for value in range(-4 * tick, 5 * tick, tick):
            if value and abs(value) < 0.93 * half_width:  # nearer to the edge the label would be cut
                self.line([(value, -4 * pixel), (value, 4 * pixel)], 1, DARK_GREY)
                self.line([(-4 * pixel, value), (4 * pixel, value)], 1, DARK_GREY)
                self.text((value, -7 * pixel), str(value), "mt")
                self.text((8 * pixel, value), str(value))

    def legend(self, entries: list[tuple[str, Colour | None]]) -> None:
        """Explain what is drawn, at the top left: words with a disc of their colour, or a black cross where that is None."""
        for row, (words, colour) in enumerate(entries):
            left, middle = (8 - SIZE / 2) * self.pixel, (SIZE / 2 - 14 - 18 * row) * self.pixel
            if colour is None:
                self.cross((left + 5 * self.pixel, middle), 4, BLACK)
            else:
                self.disc((left + 5 * self.pixel, middle), 5 * self.pixel, colour)
            self.text((left + 16 * self.pixel, middle), words)

    def path(self, points: FloatArray) -> None:
        """Draw a path (n, 2): a cross at its start, a large disc at its end, small ones in between."""
        self.line(points, 2, BLUE)
        for point in points[1:-1]:
            self.disc(point, 3 * self.pixel, BLUE)
        self.cross(points[0], 6, BLACK)
        self.disc(points[-1], 8 * self.pixel, WHITE)
        self.disc(points[-1], 7 * self.pixel, BLUE)

    def image(self) -> NDArray[np.uint8]:
        """The picture so far, shape (400, 400, 3)."""
        return np.asarray(self._image.resize((SIZE, SIZE), Image.Resampling.BOX))
