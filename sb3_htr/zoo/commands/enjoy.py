"""``sb3-htr enjoy``: watch a trained agent adapt."""

import argparse
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from sb3_htr.adaptation.evaluation import task_set
from sb3_htr.common.checks import get_task_family
from sb3_htr.common.settings import check_numbers
from sb3_htr.zoo.commands.arguments import add_adaptation_arguments, add_agent_arguments, make_parser, parse
from sb3_htr.zoo.run.agents import TrainedAgent
from sb3_htr.zoo.show.play import Moment, Player, heading, line, summary

if TYPE_CHECKING:
    from sb3_htr.zoo.show.captions import Captioner
    from sb3_htr.zoo.show.window import Window

EXAMPLE = """  sb3-htr enjoy --env SparsePointRobot-v0              an agent that comes with the package, or yours in logs/
  sb3-htr enjoy runs/htr-ser/SparsePointRobot-v0_1 --task 3 7
  sb3-htr enjoy --env SparsePointRobot-v0 -f runs --no-render --explorer prior"""

# Shows a moment; False to stop
Show = Callable[[Moment], bool]


def add_task_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: gets the arguments that say which tasks to play
    """
    add_adaptation_arguments(parser, n_episodes=8)
    group = parser.add_argument_group("tasks")
    group.add_argument("--n-tasks", type=int, default=3, metavar="N", help="the first N of the set (default: 3)")
    group.add_argument("--task", type=int, nargs="+", metavar="N", help="numbers of tasks in the set, from 1 on")
    group.add_argument("-n", "--n-timesteps", type=int, metavar="N", help="stop after N steps (default: play all tasks)")
    group.add_argument("--verbose", type=int, default=1, help="0 prints nothing, 1 (default) a line for each episode")


def watch(agent: TrainedAgent, args: argparse.Namespace, every: int, show: Show) -> list[Moment]:
    """
    Play the tasks that the arguments name, and print what happens.

    :param agent: who plays
    :param args: of :func:`add_task_arguments`
    :param every: takes every N-th frame of an episode, and the last one; 0 takes none
    :param show: called at every reset and step
    :return: last moment of each task
    :raises ValueError: for a task that there is not
    """
    model = agent.load(args.device)
    env = agent.make_env("rgb_array" if every else None)
    player = Player(model, env, args.explorer, not args.stochastic, args.seed, every, agent.around)
    tasks = task_set(get_task_family(player.vec_env), args.tasks)
    check_numbers(**{"--n-tasks": (args.n_tasks, 1)})
    numbers = args.task or range(1, min(args.n_tasks, len(tasks)) + 1)
    wrong = [number for number in numbers if not 1 <= number <= len(tasks)]
    if wrong:
        raise ValueError(f"There is no {args.tasks} task {wrong[0]}: --task takes numbers from 1 to {len(tasks)}.")
    say = print if args.verbose > 0 else lambda text: None
    say(f"{agent.path}: {agent.env_id}, explorer {args.explorer or model.explorer.name!r}")
    if not args.task and args.n_tasks > len(tasks):
        say(f"There are only {len(tasks)} {args.tasks} tasks, fewer than --n-tasks {args.n_tasks}: playing all of them.")
    ends: list[Moment] = []
    n_steps, going_on = 0, True
    for number in numbers:
        say(heading(tasks, args.tasks, number))
        for moment in player.play(tasks, number, args.n_episodes):
            n_steps += moment.step > 0
            going_on = show(moment) and (args.n_timesteps is None or n_steps < args.n_timesteps)
            if moment.ended:
                say(line(moment))
            if not going_on:
                break
        ends.append(moment)
        if not going_on:
            break
    env.close()
    say(summary(ends))
    return ends


def can_be_drawn(agent: TrainedAgent) -> bool:
    """
    :param agent: whose env is meant
    :return: whether the env makes pictures
    """
    return "rgb_array" in agent.make_env().metadata.get("render_modes", ())


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
    if not can_be_drawn(agent):
        print(f"Numbers only: {agent.env_id} cannot draw itself, 'rgb_array' is not in its metadata['render_modes'].")
        return None, None
    try:
        from sb3_htr.zoo.show.captions import Captioner
        from sb3_htr.zoo.show.window import Window

        return Window(f"sb3-htr enjoy {agent.env_id}", fps or agent.make_env().metadata.get("render_fps", 30)), Captioner()
    except ModuleNotFoundError as error:
        reason = f"{error.name} is not installed (pip install 'sb3_htr[video]')"
    except OSError as error:
        reason = str(error)
    print(f"Numbers only: {reason}. `sb3-htr record` films without a screen.")
    return None, None
