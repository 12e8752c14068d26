"""``sb3-htr enjoy``: watch a trained agent adapt."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from sb3_htr.zoo.commands.arguments import add_agent_arguments, add_task_arguments, make_parser, parse
from sb3_htr.zoo.run.agents import TrainedAgent
from sb3_htr.zoo.show.play import Moment
from sb3_htr.zoo.show.watch import frame_rate, watch

if TYPE_CHECKING:
    from sb3_htr.zoo.show.captions import Captioner
    from sb3_htr.zoo.show.window import Window

EXAMPLE = """  sb3-htr enjoy --env SparsePointRobot-v0              an agent that comes with the package, or yours in logs/
  sb3-htr enjoy runs/htr-ser/SparsePointRobot-v0_1 --task 3 7
  sb3-htr enjoy --env SparsePointRobot-v0 -f runs --no-render --explorer prior"""


def main(argv: Sequence[str]) -> None:
    """The command, with its arguments."""
    parser = make_parser("enjoy", "Watch a trained agent adapt to tasks that it has not seen, one after the other.", EXAMPLE)
    add_agent_arguments(parser)
    add_task_arguments(parser)
    parser.add_argument("--no-render", action="store_true", help="numbers only")
    parser.add_argument("--fps", type=float, help="frames per second (default: the env's)")
    args, agent = parse(parser, argv)
    window, captioner = (None, None) if args.no_render else _open_window(agent, args.fps)

    def show(moment: Moment) -> bool:
        if window is None or captioner is None or moment.frame is None:
            return True
        return window.show(captioner(moment.frame, moment))

    try:
        watch(agent, args, 0 if window is None else 1, show)
    except KeyboardInterrupt:
        pass
    finally:
        if window is not None:
            window.close()


def _open_window(agent: TrainedAgent, fps: float | None) -> "tuple[Window, Captioner] | tuple[None, None]":
    """None, and a sentence for the user, where no window can be opened."""
    if (own_fps := frame_rate(agent)) is None:
        print(f"Numbers only: {agent.env_id} cannot draw itself, 'rgb_array' is not in its metadata['render_modes'].")
        return None, None
    try:
        from sb3_htr.zoo.show.captions import Captioner
        from sb3_htr.zoo.show.window import Window

        return Window(f"sb3-htr enjoy {agent.env_id}", fps or own_fps), Captioner()
    except ModuleNotFoundError as error:
        reason = f"{error.name} is not installed (pip install 'sb3_htr[video]')"
    except OSError as error:
        reason = str(error)
    print(f"Numbers only: {reason}. `sb3-htr record` films without a screen.")
    return None, None
