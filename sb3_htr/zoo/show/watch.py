"""Plays tasks for a command that shows them, and prints what happens."""

import argparse
import contextlib
from collections.abc import Callable

from sb3_htr.adaptation.evaluation import task_set
from sb3_htr.common.checks import get_task_family
from sb3_htr.common.settings import check_numbers
from sb3_htr.zoo.run.agents import TrainedAgent
from sb3_htr.zoo.show.play import Moment, Player, heading, line, summary

# Shows a moment; False to stop
Show = Callable[[Moment], bool]


def watch(agent: TrainedAgent, args: argparse.Namespace, every: int, show: Show) -> list[Moment]:
    """
    Play the tasks that the arguments name, and print what happens.

    :param agent: who plays
    :param args: of :func:`sb3_htr.zoo.commands.arguments.add_task_arguments`
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


def frame_rate(agent: TrainedAgent) -> float | None:
    """
    :param agent: whose env is meant
    :return: frames per second of the env, None if it makes no pictures
    """
    with contextlib.closing(agent.make_env()) as env:
        metadata = env.metadata
    return float(metadata.get("render_fps") or 30) if "rgb_array" in metadata.get("render_modes", ()) else None
