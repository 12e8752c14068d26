"""A canvas for environments that need no simulator's renderer: numpy draws, with smooth edges."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from htr_envs.task_env import FloatArray

SIZE = 400

# Okabe and Ito's palette, whose colours stay apart for colour-blind eyes
BLACK = (0, 0, 0)
GREY = (200, 200, 200)
DARK_GREY = (110, 110, 110)
ORANGE = (230, 159, 0)
PALE_ORANGE = (250, 226, 170)
BLUE = (0, 114, 178)
WHITE = (255, 255, 255)

Colour = tuple[int, int, int]
FloatPoints = NDArray[np.float64]

# Glyphs of 3 x 5 pixels, rows from top to bottom; a font library would be one more dependency for a few signs.
GLYPHS = {
    " ": "000 000 000 000 000",
    "-": "000 000 111 000 000",
    "0": "111 101 101 101 111",
    "1": "010 110 010 010 111",
    "2": "111 001 111 100 111",
    "3": "111 001 111 001 111",
    "4": "101 101 111 001 001",
    "5": "111 100 111 001 111",
    "6": "111 100 111 101 111",
    "7": "111 001 010 010 010",
    "8": "111 101 111 101 111",
    "9": "111 101 111 001 111",
    "A": "010 101 111 101 101",
    "B": "110 101 110 101 110",
    "G": "111 100 101 101 111",
    "L": "100 100 100 100 111",
    "D": "110 101 101 101 110",
    "E": "111 100 111 100 111",
    "O": "111 101 101 101 111",
    "P": "111 101 111 100 100",
    "R": "110 101 110 101 101",
    "S": "111 100 111 001 111",
    "T": "111 010 010 010 010",
}
GLYPH_PIXELS = 2


class Canvas:
    """A white square picture of the plane around (0, 0).

    Shapes are given in the plane's units, line widths in pixels. What is drawn later covers what was drawn before.

    :param half_width: the picture shows x and y from minus to plus this number.
    """

    def __init__(self, half_width: float) -> None:
        self.pixel = 2.0 * half_width / SIZE
        self._half_width = half_width
        centers = (np.arange(SIZE) + 0.5) * self.pixel - half_width
        self._x, self._y = np.meshgrid(centers, centers[::-1])  # y grows upwards, rows grow downwards
        self._image = np.full((SIZE, SIZE, 3), 255.0)

    def _window(self, points: FloatPoints, margin: float) -> tuple[slice, slice]:
        # only the pixels near a shape are worth computing
        left, bottom = (points.min(axis=0) - margin + self._half_width) / self.pixel - 1
        right, top = (points.max(axis=0) + margin + self._half_width) / self.pixel + 1
        left, right, first, last = np.clip((left, right, SIZE - top, SIZE - bottom), 0, SIZE).astype(int)
        return slice(first, last), slice(left, right)

    def _blend(self, window: tuple[slice, slice], distance: FloatPoints, colour: Colour, opacity: float = 1.0) -> None:
        # an edge is one pixel wide: full colour half a pixel inside (distance < 0), none half a pixel outside
        alpha = opacity * np.clip(0.5 - distance / self.pixel, 0.0, 1.0)[..., None]
        self._image[window] += alpha * (np.array(colour) - self._image[window])

    def disc(self, center: ArrayLike, radius: float, colour: Colour, opacity: float = 1.0) -> None:
        """Draw a filled circle."""
        x, y = np.asarray(center, dtype=np.float64)
        window = self._window(np.array([(x, y)]), radius)
        self._blend(window, np.hypot(self._x[window] - x, self._y[window] - y) - radius, colour, opacity)

    def circle(self, center: ArrayLike, radius: float, width: float, colour: Colour, upper_half: bool = False) -> None:
        """Draw the outline of a circle, or of its upper half."""
        x, y = np.asarray(center, dtype=np.float64)
        window = self._window(np.array([(x, y)]), radius + width * self.pixel)
        distance = np.abs(np.hypot(self._x[window] - x, self._y[window] - y) - radius) - width / 2 * self.pixel
        self._blend(window, np.maximum(distance, y - self._y[window]) if upper_half else distance, colour)

    def line(self, points: ArrayLike, width: float, colour: Colour) -> None:
        """Draw straight lines from point to point, (n, 2)."""
        vertices = np.asarray(points, dtype=np.float64)
        window = self._window(vertices, width * self.pixel)
        grid_x, grid_y = self._x[window], self._y[window]
        nearest = np.hypot(grid_x - vertices[0, 0], grid_y - vertices[0, 1])
        for (x, y), (dx, dy) in zip(vertices[:-1], np.diff(vertices, axis=0), strict=True):
            # foot of the perpendicular, kept between the two ends; the tiny number is for a segment of length zero
            along = np.clip(((grid_x - x) * dx + (grid_y - y) * dy) / (dx * dx + dy * dy + 1e-12), 0.0, 1.0)
            nearest = np.minimum(nearest, np.hypot(grid_x - x - along * dx, grid_y - y - along * dy))
        self._blend(window, nearest - width / 2 * self.pixel, colour)

    def cross(self, center: ArrayLike, size: float, colour: Colour) -> None:
        """Draw an x; its size is in pixels."""
        reach = size * self.pixel
        for slope in (-1.0, 1.0):
            self.line(np.asarray(center) + np.array([(-reach, -slope * reach), (reach, slope * reach)]), 2.5, colour)

    def text(self, point: ArrayLike, text: str, colour: Colour) -> None:
        """Write digits, minus and some capital letters, with the top left corner at a point."""
        x, y = np.asarray(point, dtype=np.float64) / self.pixel
        left, top = round(SIZE / 2 + x), round(SIZE / 2 - y)
        rows = [" ".join(GLYPHS[sign].split()[row] for sign in text).replace(" ", "0") for row in range(5)]
        dots = (
            np.array([[dot == "1" for dot in row] for row in rows]).repeat(GLYPH_PIXELS, axis=0).repeat(GLYPH_PIXELS, axis=1)
        )
        self._image[top : top + dots.shape[0], left : left + dots.shape[1]][dots] = colour

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
                self.text((value - 4 * pixel, -8 * pixel), str(value), DARK_GREY)
                self.text((8 * pixel, value + 5 * pixel), str(value), DARK_GREY)

    def legend(self, entries: list[tuple[str, Colour | None]]) -> None:
        """Explain what is drawn, at the top left: words with a disc of their colour, or a black cross where that is None."""
        for row, (word, colour) in enumerate(entries):
            left, middle = (8 - SIZE / 2) * self.pixel, (SIZE / 2 - 13 - 16 * row) * self.pixel
            if colour is None:
                self.cross((left + 5 * self.pixel, middle), 4, BLACK)
            else:
                self.disc((left + 5 * self.pixel, middle), 5 * self.pixel, colour)
            self.text((left + 16 * self.pixel, middle + 5 * self.pixel), word, DARK_GREY)

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
        return self._image.round().astype(np.uint8)
