"""``sb3-htr record``: film a trained agent that adapts."""

from collections.abc import Generator, Sequence
from pathlib import Path

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
from PIL import Image

from sb3_htr.common.atomic import atomic_path
from sb3_htr.zoo.commands.arguments import add_agent_arguments, make_parser, parse
from sb3_htr.zoo.show.captions import Captioner
from sb3_htr.zoo.commands.enjoy import add_task_arguments, can_be_drawn, watch
from sb3_htr.zoo.show.play import Moment

EXAMPLE = """  sb3-htr record --env SparsePointRobot-v0                       SparsePointRobot-v0.mp4
  sb3-htr record runs -o adaptation.gif --task 2 --n-episodes 6
  sb3-htr record --env SparseAnt-v0 --every 3 --speed 2"""
SUFFIXES = (".mp4", ".gif")
# Seconds that the last frame of an episode, and of a task, is held
EPISODE_END, TASK_END = 0.4, 1.2
MAX_GIF_FRAMES = 1500


class Film:
    """
    A file that is being filmed; an mp4 is written as it comes in, a gif at the end.

    :param path: file to write, ``.mp4`` or ``.gif``
    :param fps: frames per second of an mp4
    """

    def __init__(self, path: Path, fps: float) -> None:
        self.path, self.fps = path, fps
        self.seconds: list[float] = []
        self._frames: list[np.ndarray] = []
        self._ffmpeg: Generator[None, np.ndarray | None, None] | None = None

    def add(self, frame: np.ndarray, hold: float) -> None:
        """
        :param frame: (height, width, 3) uint8, the sides even numbers
        :param hold: seconds that it is shown longer than others
        :raises ValueError: for a gif that would not fit into memory
        """
        self.seconds.append(1 / self.fps + hold)
        if self.path.suffix == ".mp4":
            if self._ffmpeg is None:
                # Sides need not be multiples of 16 for today's players
                size = frame.shape[1::-1]
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
        durations = [round(1000 * seconds) for seconds in self.seconds]
        first.save(self.path, save_all=True, append_images=rest, duration=durations, loop=0, optimize=True)


def main(argv: Sequence[str]) -> None:
    """
    :param argv: arguments of the command
    """
    parser = make_parser("record", "Film a trained agent that adapts to tasks that it has not seen; needs no screen.", EXAMPLE)
    add_agent_arguments(parser)
    add_task_arguments(parser)
    parser.add_argument("-o", "--output", type=Path, help="file, .mp4 or .gif (default: ENV_ID.mp4)")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only every N-th frame, for long episodes")
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help="times as fast as the env (default: 1)")
    args, agent = parse(parser, argv)
    output = args.output or Path(f"{agent.env_id}.mp4")
    if output.suffix not in SUFFIXES:
        raise ValueError(f"{output} has the suffix {output.suffix!r}, expected one of {', '.join(SUFFIXES)}.")
    if args.every < 1 or not args.speed > 0:
        raise ValueError(f"--every is {args.every} and --speed {args.speed}, expected at least 1 and more than 0.")
    if not can_be_drawn(agent):
        raise ValueError(f"{agent.env_id} cannot be filmed: 'rgb_array' is not in its metadata['render_modes'].")
    fps = agent.make_env().metadata.get("render_fps", 30) * args.speed / args.every
    captioner = Captioner()
    with atomic_path(output) as temporary:
        film = Film(temporary, fps)

        def show(env: gym.Env, moment: Moment) -> bool:
            if moment.ended or moment.step % args.every == 0:
                frame = env.render()
                assert isinstance(frame, np.ndarray)
                end = TASK_END if moment.episode == moment.n_episodes else EPISODE_END
                film.add(captioner(frame, moment), end if moment.ended else 0.0)
            return True

        watch(agent, args, "rgb_array", show)
        film.close()
    print(f"{output}: {len(film.seconds)} frames, {sum(film.seconds):.0f} seconds, {output.stat().st_size / 1e6:.1f} MB")
