"""What a frame does not show of an adaptation, drawn below it."""

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sb3_htr.zoo.show.play import Moment

# Okabe and Ito's colours, as in the plots
INK, PALE, SOLVED, MISSED = "#222222", "#dddddd", "#0072B2", "#E69F00"
# In units of the font size
LINE, MARGIN, COLUMN = 1.5, 0.7, 10.7
# Of frames in pixels, to have room for words; smaller ones are enlarged
MIN_WIDTH = 300


class Captioner:
    """
    Adds a panel below each frame: task, episode, return, how well z is known, and a bar for the return of each episode.
    """

    def __init__(self) -> None:
        # Return of a full bar; it grows if there is a larger one
        self.top_return = 1.0
        # Of the first moment of each task: z can be known no worse than before the first episode
        self._deviation = 0.0

    def __call__(self, frame: np.ndarray, moment: Moment) -> np.ndarray:
        """
        :param frame: (height, width, 3) uint8
        :param moment: what it shows
        :return: frame with the panel, its sides even numbers, as films want them
        """
        if moment.episode == 1 and moment.step == 0:
            self._deviation = moment.deviation
        self.top_return = max(self.top_return, *moment.returns)
        if (enlarged := -(-MIN_WIDTH // frame.shape[1])) > 1:
            frame = frame.repeat(enlarged, axis=0).repeat(enlarged, axis=1)
        height, width = frame.shape[:2]
        size = max(width // 28, 9)
        panel = int(size * (3 * LINE + 2 * MARGIN + 0.5))
        image = Image.new("RGB", (width + width % 2, height + panel + (height + panel) % 2), "white")
        image.paste(Image.fromarray(frame))
        draw = ImageDraw.Draw(image)
        font = ImageFont.load_default(size)
        left, right, y = size * MARGIN, width - size * MARGIN, height + size * MARGIN
        draw.line([(0, height), (width, height)], fill=PALE, width=1)

        how = "explores" if moment.exploring else "adapted"
        draw.text((left, y), f"task {moment.task}, episode {moment.episode} of {moment.n_episodes}, {how}", INK, font)
        solved = moment.successes[-1]
        result = f"return {moment.returns[-1]:.1f}{', solved' if solved else ''}"
        draw.text((right, y), result, SOLVED if solved else INK, font, anchor="ra")

        y += size * LINE
        bars = left + COLUMN * size
        if not np.isnan(moment.deviation):
            draw.text((left, y), f"uncertainty of z {moment.deviation:.2f}", INK, font)
            self._bar(draw, (bars, y + 0.2 * size, right, y + 1.0 * size), moment.deviation / max(self._deviation, 1e-9))

        y += size * (LINE + 0.3)
        draw.text((left, y + 0.3 * size), f"return, 0 to {self.top_return:.1f}", INK, font)
        self._history(draw, moment, bars, right, y, 1.6 * size)
        return np.asarray(image)

    @staticmethod
    def _bar(draw: ImageDraw.ImageDraw, box: tuple[float, float, float, float], share: float) -> None:
        left, top, right, bottom = box
        draw.rectangle(box, outline=PALE)
        if share > 0:
            draw.rectangle((left, top, left + min(share, 1.0) * (right - left), bottom), fill=INK)

    def _history(
        self, draw: ImageDraw.ImageDraw, moment: Moment, left: float, right: float, top: float, height: float
    ) -> None:
        """One bar for each episode, as high as its return; a line on the floor where there is none."""
        pitch = (right - left) / moment.n_episodes
        floor = top + height
        for i in range(moment.n_episodes):
            x0 = left + i * pitch + 1
            x1 = max(left + (i + 1) * pitch - 2, x0)
            draw.line([(x0, floor), (x1, floor)], fill=PALE, width=2)
            if i < moment.episode:
                colour = SOLVED if moment.successes[i] else MISSED
                share = min(max(moment.returns[i], 0.0) / self.top_return, 1.0)
                draw.rectangle((x0, floor - max(share * height, 2), x1, floor), fill=colour)
