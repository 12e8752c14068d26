"""``sb3-htr record``: film a trained agent that adapts."""

import math
from collections.abc import Sequence
from pathlib import Path

import imageio_ffmpeg

from sb3_htr.common.atomic import atomic_path
from sb3_htr.zoo.commands.arguments import add_agent_arguments, add_task_arguments, make_parser, parse
from sb3_htr.zoo.show.captions import Captioner
from sb3_htr.zoo.show.film import MAX_GIF_FPS, SUFFIXES, Film
from sb3_htr.zoo.show.play import Moment
from sb3_htr.zoo.show.watch import frame_rate, watch

EXAMPLE = """  sb3-htr record --env SparsePointRobot-v0                       SparsePointRobot-v0.mp4
  sb3-htr record runs -o adaptation.gif --task 2 --n-episodes 6
  sb3-htr record --env SparseAnt-v0 --every 3 --speed 2"""
# Seconds that the last frame of an episode, and of a task, is held
EPISODE_END, TASK_END = 0.4, 1.2


def is_whole(film: Path) -> bool:
    """
    :param film: that was written
    :return: whether it can be read to its end: the encoder does not tell when it could not write
    """
    if film.suffix != ".mp4":
        return True
    try:
        imageio_ffmpeg.count_frames_and_secs(film)
    except RuntimeError:
        return False
    return True


def main(argv: Sequence[str]) -> None:
    """The command, with its arguments."""
    parser = make_parser("record", "Film a trained agent that adapts to tasks that it has not seen; needs no screen.", EXAMPLE)
    add_agent_arguments(parser)
    add_task_arguments(parser)
    parser.add_argument("-o", "--output", type=Path, help="file, .mp4 or .gif (default: ENV_ID.mp4)")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only every N-th frame, for long episodes")
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help="times as fast as the env (default: 1)")
    args, agent = parse(parser, argv)
    output = args.output or Path(f"{agent.stem}.mp4")
    if output.suffix not in SUFFIXES:
        raise ValueError(f"{output} has the suffix {output.suffix!r}, expected one of {', '.join(SUFFIXES)}.")
    if args.every < 1 or not 0 < args.speed < math.inf:
        raise ValueError(f"--every is {args.every} and --speed {args.speed}, expected at least 1 and a number above 0.")
    if (own_fps := frame_rate(agent)) is None:
        raise ValueError(f"{agent.env_id} cannot be filmed: 'rgb_array' is not in its metadata['render_modes'].")
    fps = own_fps * args.speed / args.every
    if output.suffix == ".gif" and fps > MAX_GIF_FPS:
        every = math.ceil(args.every * fps / MAX_GIF_FPS)
        raise ValueError(
            f"The film would have {fps:.0f} frames a second, and players show no more than {MAX_GIF_FPS} of a gif: add "
            f"--every {every}, or write an .mp4."
        )
    captioner = Captioner()
    with atomic_path(output) as temporary:
        film = Film(temporary, fps)

        def show(moment: Moment) -> bool:
            if moment.frame is not None:
                end = TASK_END if moment.episode == moment.n_episodes else EPISODE_END
                film.add(captioner(moment.frame, moment), end if moment.ended else 0.0)
            return True

        watch(agent, args, args.every, show)
        film.close()
        if not is_whole(temporary):
            raise OSError(f"{output} could not be written to its end: is the disk full?")
    print(f"{output}: {len(film.seconds)} frames, {sum(film.seconds):.0f} seconds, {output.stat().st_size / 1e6:.1f} MB")
