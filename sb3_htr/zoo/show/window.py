"""A window that shows frames, where there is a screen."""

import os

import numpy as np

from htr_envs.headless import has_screen


class Window:
    """
    Shows frames one after the other.

    :param title: of the window
    :param fps: frames per second, at most
    :raises OSError: if there is no screen
    """

    def __init__(self, title: str, fps: float) -> None:
        # SDL would draw into memory that nobody sees, unless it is told to
        if not has_screen() and "SDL_VIDEODRIVER" not in os.environ:
            raise OSError("no screen was found")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        import pygame

        self.title, self.fps, self.pygame = title, fps, pygame
        self.clock = pygame.time.Clock()
        pygame.display.init()

    def show(self, frame: np.ndarray) -> bool:
        """
        :param frame: (height, width, 3) uint8
        :return: whether nobody has closed the window
        """
        display, size = self.pygame.display, frame.shape[1::-1]
        surface = display.get_surface()
        if surface is None:
            surface = display.set_mode(size)
            display.set_caption(self.title)
        surface.blit(self.pygame.image.frombuffer(frame.tobytes(), size, "RGB"), (0, 0))
        display.flip()
        self.clock.tick(self.fps)
        return not any(event.type == self.pygame.QUIT for event in self.pygame.event.get())

    def close(self) -> None:
        """Close it."""
        self.pygame.display.quit()
