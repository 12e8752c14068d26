"""An adaptation to one task, step by step, for those who watch it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th

from sb3_htr import PEARL


@dataclass(frozen=True)
class Moment:
    """
    A reset or a step.

    :param task: number of the task, from 1 on
    :param n_tasks: how many there are in its set
    :param n_episodes: adaptation episodes on it
    :param step: steps of the episode so far, 0 at the reset
    :param returns: of the episodes so far, the current one last
    :param successes: whether each of them solved the task so far
    :param exploring: whether the explorer chose z in this episode
    :param deviation: standard deviation of what is known about z, mean over its dimensions
    :param ended: whether the episode ends here
    """

    task: int
    n_tasks: int
    n_episodes: int
    step: int
    returns: tuple[float, ...]
    successes: tuple[bool, ...]
    exploring: bool
    deviation: float
    ended: bool

    @property
    def episode(self) -> int:
        """Number of the episode, from 1 on."""
        return len(self.returns)


class Player:
    """
    Plays adaptations of a model in one env.

    :param model: a PEARL
    :param env: single env of its task family
    :param normalize: what the model sees of an observation
    :param explorer: how z is drawn before the posterior is used, the model's own by default
    :param deterministic: mean actions instead of samples
    :param seed: of env and z
    """

    def __init__(
        self,
        model: PEARL,
        env: gym.Env,
        normalize: Callable[[Any], Any],
        explorer: str | None = None,
        deterministic: bool = True,
        seed: int = 0,
    ) -> None:
        self.model, self.env, self.normalize = model, env, normalize
        self.explorer, self.deterministic = explorer, deterministic
        self.generator = th.Generator().manual_seed(seed)
        # For the first reset only
        self.seed: int | None = seed

    def play(self, tasks: np.ndarray, number: int, n_episodes: int) -> Iterator[Moment]:
        """
        Adapt to one task, from nothing.

        :param tasks: set of tasks (n, task_dim)
        :param number: which of them, from 1 on
        :param n_episodes: adaptation episodes
        :return: each reset and step; the env can be rendered in between
        """
        policy = self.model.policy
        adaptation = self.model.start_adaptation(1, None, self.explorer, self.generator)
        returns, successes = [], []
        for _ in range(n_episodes):
            obs, _ = self.env.reset(seed=self.seed, options={"task": tasks[number - 1]})
            obs, self.seed = self.normalize(obs), None
            returns.append(0.0)
            successes.append(False)
            exploring, step, ended = bool(adaptation.exploring()[0]), 0, False
            deviation = float(adaptation.deviation().mean())
            while True:
                scores = tuple(returns), tuple(successes)
                yield Moment(number, len(tasks), n_episodes, step, *scores, exploring, deviation, ended)
                if ended:
                    break
                action, _ = policy.predict(obs, (adaptation.z,), deterministic=self.deterministic)
                new_obs, reward, terminated, truncated, info = self.env.step(action)
                step, ended = step + 1, terminated or truncated
                returns[-1] += float(reward)
                successes[-1] |= info["is_success"]
                adaptation.observe(
                    obs[None],
                    policy.scale_action(action)[None],
                    np.array([reward]),
                    np.array([info["task_free_reward"]]),
                    np.array([ended]),
                )
                deviation = float(adaptation.deviation().mean())
                obs = self.normalize(new_obs)


def line(moment: Moment) -> str:
    """
    :param moment: end of an episode
    :return: what there is to say about the episode
    """
    how = "explores" if moment.exploring else "adapted"
    solved = "solved" if moment.successes[-1] else "-"
    score = f"return {moment.returns[-1]:8.2f}   {solved:<6}"
    return f"  episode {moment.episode:3d}   {how:<8}   {score}   uncertainty of z {moment.deviation:.2f}"


def summary(ends: list[Moment]) -> str:
    """
    :param ends: last moment of each task
    :return: what there is to say about all of them
    """
    solved = [moment.successes.index(True) + 1 for moment in ends if any(moment.successes)]
    last = float(np.mean([moment.returns[-1] for moment in ends]))
    first = f", for the first time in episode {np.mean(solved):.1f} on average" if solved else ""
    return f"Solved {len(solved)} of {len(ends)} tasks{first}. Mean return of the last episode: {last:.2f}"


def heading(tasks: np.ndarray, which: str, number: int) -> str:
    """
    :param tasks: set of tasks
    :param which: name of the set
    :param number: of a task, from 1 on
    :return: what there is to say about the task
    """
    vector = ", ".join(f"{value:.2f}" for value in tasks[number - 1])
    return f"{which} task {number} of {len(tasks)}, which the agent is not told: ({vector})"
