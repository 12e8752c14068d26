"""A window that shows frames, where there is a screen."""

import matplotlib.pyplot as plt
import numpy as np


class Window:
    """
    Shows frames one after the other.

    :param title: of the window
    :param fps: frames per second, at most
    :raises OSError: if no window can be opened
    """

    def __init__(self, title: str, fps: float) -> None:
        # matplotlib falls back on pictures in memory where it finds no screen
        if plt.get_backend().lower() == "agg":
            raise OSError("no screen or no window toolkit (such as tkinter) was found")
        self.pause = 1 / fps
        plt.rcParams["toolbar"] = "None"
        self.figure, axes = plt.subplots(num=title, layout="tight")
        axes.set_axis_off()
        self.image = axes.imshow(np.full((2, 2, 3), 255, dtype=np.uint8), interpolation="nearest")

    def show(self, frame: np.ndarray) -> bool:
        """
        :param frame: (height, width, 3) uint8
        :return: whether the window is still open
        """
        height, width = frame.shape[:2]
        self.image.set_data(frame)
        self.image.set_extent((0.0, float(width), float(height), 0.0))
        plt.pause(self.pause)
        return bool(plt.fignum_exists(self.figure.number))

    def close(self) -> None:
        """Close it."""
        plt.close(self.figure)
