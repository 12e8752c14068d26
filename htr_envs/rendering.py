"""Pictures of the environments that need no simulator's renderer: numpy draws them, with smooth edges."""

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
BLUE = (0, 114, 178)
WHITE = (255, 255, 255)

Colour = tuple[int, int, int]

# Glyphs of 3 x 5 pixels, rows from top to bottom; a font library would be one more dependency for a dozen of signs.
GLYPHS = {
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
    "O": "111 101 101 101 111",
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
        centers = (np.arange(SIZE) + 0.5) * self.pixel - half_width
        self._x, self._y = np.meshgrid(centers, centers[::-1])  # y grows upwards, rows grow downwards
        self._image = np.full((SIZE, SIZE, 3), 255.0)

    def _blend(self, distance: NDArray[np.float64], colour: Colour, opacity: float) -> None:
        # an edge is one pixel wide: full colour half a pixel inside (distance < 0), none half a pixel outside
        alpha = opacity * np.clip(0.5 - distance / self.pixel, 0.0, 1.0)[..., None]
        self._image += alpha * (np.array(colour) - self._image)

    def _distance_to(self, point: ArrayLike) -> NDArray[np.float64]:
        x, y = np.asarray(point, dtype=np.float64)
        distance: NDArray[np.float64] = np.hypot(self._x - x, self._y - y)
        return distance

    def disc(self, center: ArrayLike, radius: float, colour: Colour, opacity: float = 1.0) -> None:
        """Draw a filled circle."""
        self._blend(self._distance_to(center) - radius, colour, opacity)

    def circle(self, center: ArrayLike, radius: float, width: float, colour: Colour) -> None:
        """Draw the outline of a circle."""
        self._blend(np.abs(self._distance_to(center) - radius) - width / 2 * self.pixel, colour, 1.0)

    def line(self, points: ArrayLike, width: float, colour: Colour) -> None:
        """Draw straight lines from point to point, (n, 2)."""
        vertices = np.asarray(points, dtype=np.float64)
        nearest = self._distance_to(vertices[0])
        for (x, y), (dx, dy) in zip(vertices[:-1], np.diff(vertices, axis=0), strict=True):
            # foot of the perpendicular, kept between the two ends; the tiny number is for a segment of length zero
            along = np.clip(((self._x - x) * dx + (self._y - y) * dy) / (dx * dx + dy * dy + 1e-12), 0.0, 1.0)
            nearest = np.minimum(nearest, np.hypot(self._x - x - along * dx, self._y - y - along * dy))
        self._blend(nearest - width / 2 * self.pixel, colour, 1.0)

    def text(self, point: ArrayLike, text: str, colour: Colour) -> None:
        """Write digits, minus and some capital letters, with the top left corner at a point."""
        x, y = np.asarray(point, dtype=np.float64) / self.pixel
        left, top = round(SIZE / 2 + x), round(SIZE / 2 - y)
        rows = [" ".join(GLYPHS[sign].split()[row] for sign in text).replace(" ", "0") for row in range(5)]
        dots = (
            np.array([[dot == "1" for dot in row] for row in rows]).repeat(GLYPH_PIXELS, axis=0).repeat(GLYPH_PIXELS, axis=1)
        )
        self._image[top : top + dots.shape[0], left : left + dots.shape[1]][dots] = colour

    def image(self) -> NDArray[np.uint8]:
        """The picture so far, shape (400, 400, 3)."""
        return self._image.round().astype(np.uint8)


def draw_point_robot(path: FloatArray, goal: FloatArray, goal_distance: float, goal_radius: float) -> NDArray[np.uint8]:
    """Draw one episode of the point robot: axes, the semicircle of possible goals, the goal, the start, the path, the robot.

    The goal is filled strongly while the robot is in it.

    :param path: positions from the start up to now, shape (n, 2).
    :param goal: the episode's goal, shape (2,).
    :param goal_distance: radius of the semicircle.
    :param goal_radius: radius of the goal.
    :return: picture (400, 400, 3), uint8.
    """
    # 20 steps lead at most 2 along each axis: a robot of that episode length never leaves the picture
    half_width = max(2.2, 1.1 * goal_distance + goal_radius)
    canvas = Canvas(half_width)
    pixel = canvas.pixel

    tick = 1 if half_width < 5.0 else 5
    canvas.line([(-half_width, 0.0), (half_width, 0.0)], 1, GREY)
    canvas.line([(0.0, -half_width), (0.0, half_width)], 1, GREY)
    for value in range(-2 * tick, 3 * tick, tick):
        if value and abs(value) < half_width:
            canvas.line([(value, -4 * pixel), (value, 4 * pixel)], 1, DARK_GREY)
            canvas.line([(-4 * pixel, value), (4 * pixel, value)], 1, DARK_GREY)
            canvas.text((value - 4 * pixel, -8 * pixel), str(value), DARK_GREY)
            canvas.text((8 * pixel, value + 5 * pixel), str(value), DARK_GREY)

    angles = np.linspace(0.0, np.pi, 49)
    canvas.line(goal_distance * np.stack((np.cos(angles), np.sin(angles)), axis=-1), 3, (250, 226, 170))
    reached = bool(np.hypot(*(path[-1] - goal)) < goal_radius)
    canvas.disc(goal, goal_radius, ORANGE, 1.0 if reached else 0.5)
    canvas.circle(goal, goal_radius, 2, ORANGE)

    canvas.line(path, 2, BLUE)
    for position in path[1:-1]:
        canvas.disc(position, 3 * pixel, BLUE)
    marker = 6 * pixel
    canvas.line(path[0] + np.array([(-marker, -marker), (marker, marker)]), 2.5, BLACK)
    canvas.line(path[0] + np.array([(-marker, marker), (marker, -marker)]), 2.5, BLACK)
    canvas.disc(path[-1], 8 * pixel, WHITE)
    canvas.disc(path[-1], 7 * pixel, BLUE)

    legend = np.array((-half_width, half_width)) + np.array((8 * pixel, -8 * pixel))
    for row, (word, colour) in enumerate((("GOAL", ORANGE), ("START", BLACK), ("ROBOT", BLUE))):
        canvas.disc(legend + np.array((5 * pixel, -(5 + 16 * row) * pixel)), 5 * pixel, colour)
        canvas.text(legend + np.array((16 * pixel, -16 * row * pixel)), word, DARK_GREY)
    return canvas.image()
