"""A film of frames, as mp4 or gif."""

from collections.abc import Generator
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from PIL import Image

SUFFIXES = (".mp4", ".gif")
MAX_GIF_FRAMES = 1500
# Of a gif, browsers show frames of 10 ms and less ten times as long
MAX_GIF_FPS = 50


class Film:
    """
    A file that is being filmed; an mp4 is written as it comes in, a gif at the end.

    :param path: file to write, ``.mp4`` or ``.gif``
    :param fps: frames per second
    """

    def __init__(self, path: Path, fps: float) -> None:
        self.path, self.fps = path, fps
        self.seconds: list[float] = []
        self._frames: list[np.ndarray] = []
        self._size: tuple[int, ...] | None = None
        self._ffmpeg: Generator[None, np.ndarray | None, None] | None = None

    def add(self, frame: np.ndarray, hold: float) -> None:
        """
        :param frame: (height, width, 3) uint8, the sides even numbers
        :param hold: seconds that it is shown longer than others
        :raises ValueError: for a frame of another size than the first one, and a gif that would not fit into memory
        """
        size = frame.shape[1::-1]
        self._size = self._size or size
        if size != self._size:
            given, expected = (f"{width} x {height}" for width, height in (size, self._size))
            raise ValueError(
                f"A picture of the film has {given} pixels, expected {expected} as the first one: let render() of the env "
                "give pictures of one size."
            )
        self.seconds.append(1 / self.fps + hold)
        if self.path.suffix == ".mp4":
            if self._ffmpeg is None:
                # Sides need not be multiples of 16 for today's players
                self._ffmpeg = imageio_ffmpeg.write_frames(self.path, size, fps=self.fps, quality=7, macro_block_size=2)
                self._ffmpeg.send(None)
            for _ in range(round(self.seconds[-1] * self.fps)):
                self._ffmpeg.send(np.ascontiguousarray(frame))
            return
        if len(self._frames) == MAX_GIF_FRAMES:
            raise ValueError(f"A gif holds at most {MAX_GIF_FRAMES} frames: write an .mp4, or fewer frames with --every.")
        self._frames.append(frame)

    def close(self) -> None:
        """Finish the file."""
        if self._ffmpeg is not None:
            self._ffmpeg.close()
            return
        # One palette for all frames: colours do not flicker, and what does not move costs nothing
        sample = np.concatenate(self._frames[:: max(len(self._frames) // 8, 1)])
        palette = Image.fromarray(sample).quantize(128, Image.Quantize.MAXCOVERAGE)
        first, *rest = (Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in self._frames)
        # A gif counts hundredths of a second, so the rounding of one frame is made up for by the next
        durations = [10 * int(n) for n in np.diff(np.round(100 * np.cumsum(self.seconds)), prepend=0)]
        first.save(self.path, save_all=True, append_images=rest, duration=durations, loop=0, optimize=True)
