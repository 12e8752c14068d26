"""An adaptation to one task, step by step, for those who watch it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_htr.adaptation.evaluation import MetaLearner
from sb3_htr.adaptation.loop import adaptation_steps
from sb3_htr.common.random_state import seeded_actions
from sb3_htr.common.vec_env import reset_to_tasks


@dataclass(frozen=True)
class Moment:
    """
    A reset or a step.

    :param task: number of the task, from 1 on
    :param n_episodes: adaptation episodes on it
    :param step: steps of the episode so far, 0 at the reset
    :param returns: of the episodes so far, the current one last
    :param successes: whether each of them solved the task so far
    :param exploring: whether the agent still explored when this episode began, see :meth:`Explorer.exploring`
    :param deviation: standard deviation of what is known about z, mean over its dimensions; NaN for an agent without z
    :param ended: whether the episode ends here
    :param frame: (height, width, 3) uint8, None where none was taken
    """

    task: int
    n_episodes: int
    step: int
    returns: tuple[float, ...]
    successes: tuple[bool, ...]
    exploring: bool
    deviation: float
    ended: bool
    frame: np.ndarray | None

    @property
    def episode(self) -> int:
        """Number of the episode, from 1 on."""
        return len(self.returns)


class Camera(gym.Wrapper):
    """
    Takes a frame at each reset and step: a VecEnv resets within the step that ends an episode, and its last frame is lost.

    :param env: single env
    :param every: takes every N-th frame of an episode, and the last one; 0 takes none
    """

    def __init__(self, env: gym.Env, every: int) -> None:
        super().__init__(env)
        self.every = every
        # Those that next_frame has not returned yet: a step that ends an episode adds two, its own and that of the reset
        self.frames: list[np.ndarray | None] = []
        self._n_steps = 0

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        result = super().reset(**kwargs)
        self._n_steps = 0
        self._take(False)
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        result = super().step(action)
        self._n_steps += 1
        self._take(result[2] or result[3])
        return result

    def _take(self, ended: bool) -> None:
        taken = self.every > 0 and (ended or self._n_steps % self.every == 0)
        self.frames.append(self._picture() if taken else None)

    def _picture(self) -> np.ndarray:
        frame: Any = self.env.render()
        if not (isinstance(frame, np.ndarray) and frame.shape[2:] == (3,) and frame.dtype == np.uint8):
            what = "None" if frame is None else f"a {type(frame).__name__}"
            if isinstance(frame, np.ndarray):
                what = f"an array of shape {frame.shape} of {frame.dtype}"
            raise ValueError(
                f"The env's render() gave {what}, expected a picture (height, width, 3) of uint8: make it return one."
            )
        return frame

    def next_frame(self) -> np.ndarray | None:
        """
        :return: the oldest frame that was not taken away yet
        """
        return self.frames.pop(0)


class Player:
    """
    Plays adaptations of a model in one env.

    :param model: a PEARL, or a rival
    :param env: single env of its task family
    :param explorer: name of the explorer, the model's own by default
    :param deterministic: mean actions instead of samples
    :param seed: of env, z and sampled actions; the random state of others is left alone
    :param every: takes every N-th frame of an episode, and the last one; 0 takes none
    :param around: puts wrappers around the VecEnv that the env is in
    """

    def __init__(
        self,
        model: MetaLearner,
        env: gym.Env,
        explorer: str | None = None,
        deterministic: bool = True,
        seed: int = 0,
        every: int = 0,
        around: Callable[[VecEnv], VecEnv] = lambda env: env,
    ) -> None:
        self.model, self.explorer, self.deterministic, self.seed = model, explorer, deterministic, seed
        self.camera = Camera(env, every)
        self.vec_env = around(DummyVecEnv([lambda: self.camera]))
        self.vec_env.seed(seed)
        self.generator = th.Generator().manual_seed(seed)

    def play(self, tasks: np.ndarray, number: int, n_episodes: int) -> Iterator[Moment]:
        """
        Adapt to one task, from nothing.

        :param tasks: set of tasks (n, task_dim)
        :param number: which of them, from 1 on
        :param n_episodes: adaptation episodes
        :return: each reset and step
        """
        # As an evaluation in one env
        with seeded_actions((self.seed, number - 1), self.deterministic):
            yield from self._play(tasks, number, n_episodes)

    def _play(self, tasks: np.ndarray, number: int, n_episodes: int) -> Iterator[Moment]:
        policy, env = self.model.policy, self.vec_env
        adaptation = self.model.start_adaptation(1, self.explorer, self.generator)
        returns: list[float] = []
        successes: list[bool] = []

        def moment(step: int, exploring: bool, ended: bool) -> Moment:
            deviation = float(adaptation.deviation()[0])
            scores = tuple(returns), tuple(successes)
            frame = self.camera.next_frame()
            return Moment(number, n_episodes, step, *scores, exploring, deviation, ended, frame)

        def begin() -> Moment:
            returns.append(0.0)
            successes.append(False)
            return moment(0, exploring, False)

        self.camera.frames.clear()
        obs, n_steps, exploring = reset_to_tasks(env, tasks[[number - 1]]), 0, bool(adaptation.exploring()[0])
        yield begin()
        act = partial(adaptation.act, deterministic=self.deterministic)
        for step in adaptation_steps(env, adaptation, n_episodes, policy.unscale_action, act, obs):
            n_steps, ended = n_steps + 1, bool(step.dones[0])
            returns[-1] += float(step.rewards[0])
            successes[-1] |= bool(step.infos[0].get("is_success", False))
            yield moment(n_steps, exploring, ended)
            if ended:
                n_steps, exploring = 0, bool(adaptation.exploring()[0])
                if len(returns) < n_episodes:
                    yield begin()


def line(moment: Moment) -> str:
    """
    :param moment: end of an episode
    :return: what there is to say about the episode
    """
    how = "explores" if moment.exploring else "adapted"
    solved = "solved" if moment.successes[-1] else "-"
    score = f"return {moment.returns[-1]:8.2f}   {solved:<6}"
    known = "" if np.isnan(moment.deviation) else f"   uncertainty of z {moment.deviation:.2f}"
    return f"  episode {moment.episode:3d}   {how:<8}   {score}{known}"


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
    return f"{which} task {number} of {len(tasks)}: ({vector})"
