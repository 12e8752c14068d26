"""A good task env, and one class for each promise that can be broken."""

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces

from htr_envs import TaskEnv, TaskFamily

# Annotations here are wide on purpose: most of these classes break the types that they should have.


class LineFamily(TaskFamily):
    """Find a place on a line; written for arrays."""

    def __init__(self) -> None:
        space = spaces.Box(-5.0, 5.0, (1,), np.float32)
        super().__init__(space, [[1.0], [-1.0], [0.5], [2.0]], [[1.5]], [[-1.5], [-2.0]])

    def sample_tasks(self, n: int, rng: np.random.Generator) -> Any:
        return rng.uniform(-2.0, 2.0, (n, 1)).astype(np.float32)

    def distance(self, traj: Any, task: Any) -> Any:
        return np.abs(traj.next_observations[..., 0] - task[..., None, 0])

    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        if reward_type not in ("sparse", "dense"):
            raise ValueError("unknown")
        distance = self.distance(traj, task)
        return (-distance if reward_type == "dense" else (distance < 0.05).astype(np.float32)) + traj.task_free_reward

    def is_success(self, traj: Any, task: Any) -> Any:
        return self.distance(traj, task) < 0.05

    def hindsight_task(self, traj: Any, index: Any) -> Any:
        states = traj.next_observations[..., :1]
        leading = np.broadcast_shapes(np.shape(index), states.shape[:-2])
        states = np.broadcast_to(states, leading + states.shape[-2:])
        return np.take_along_axis(states, np.broadcast_to(index, leading)[..., None, None], axis=-2)[..., 0, :]


class LineEnv(TaskEnv):
    """A walker on a line that pays for its effort; its episodes end after ten steps."""

    max_episode_steps = 10

    def __init__(self, family: TaskFamily | None = None) -> None:
        super().__init__(LineFamily() if family is None else family)
        self.observation_space = spaces.Box(-5.0, 5.0, (2,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.x, self.n_steps = 0.0, 0

    def observe(self) -> Any:
        return np.array([self.x, self.n_steps / 10.0], dtype=np.float32)

    def _reset_state(self) -> Any:
        self.x, self.n_steps = float(self.np_random.uniform(-0.1, 0.1)), 0
        return self.observe()

    def _step_state(self, action: Any) -> Any:
        self.x += 0.2 * float(action[0])
        self.n_steps += 1
        return self.observe(), -0.01 * float(action[0]) ** 2, self.n_steps == 10

    def step(self, action: Any) -> Any:
        return self.alter(*super().step(action))

    def alter(self, observation: Any, reward: Any, terminated: Any, truncated: Any, info: Any) -> Any:
        """For subclasses to spoil what step returns."""
        return observation, reward, terminated, truncated, info


def column(*rows: float) -> Any:
    """Read-only float32 tasks of one dimension."""
    tasks = np.array(rows, dtype=np.float32)[:, None]
    tasks.setflags(write=False)
    return tasks


BROKEN: list[tuple[type[LineEnv] | type[LineFamily], str]] = []


def breaks(sentence: str) -> Callable[[Any], Any]:
    """Note the class and what the check must say about it."""

    def note(broken: Any) -> Any:
        BROKEN.append((broken, sentence))
        return broken

    return note


@breaks("Every step of a random episode solves every training task, so nothing can be learnt: is_success asks for too little")
class IsSolvedByAnything(LineFamily):
    def distance(self, traj: Any, task: Any) -> Any:
        return super().distance(traj, task) / 1000


@breaks("The reward nan is not a finite float")
class NoRewardAtAll(LineFamily):
    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        return super().compute_reward(traj, task, reward_type) * np.float32(np.nan)


@breaks("compute_reward returned a number that is not finite, for tasks that hindsight_task named")
class NoRewardAtTheGoal(LineFamily):
    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        at_goal = self.distance(traj, task) == 0
        return np.where(at_goal, np.float32(np.nan), super().compute_reward(traj, task, reward_type))


@breaks("compute_reward with reward_type='dense' must return one float32 for each step")
class DenseRewardOfTheEpisode(LineFamily):
    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        rewards = super().compute_reward(traj, task, reward_type)
        return rewards.sum(axis=-1) if reward_type == "dense" else rewards


@breaks("compute_reward with reward_type='dense' raised NotImplementedError(): it must return rewards, or raise a ValueError")
class DenseRewardToBeDone(LineFamily):
    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        if reward_type == "dense":
            raise NotImplementedError
        return super().compute_reward(traj, task, reward_type)


@breaks("sample_tasks draws from another source")
class GlobalRandomness(LineFamily):
    def sample_tasks(self, n: Any, rng: Any) -> Any:
        return np.random.random((n, 1)).astype(np.float32)


@breaks("sample_tasks(5, rng) returned 1 tasks")
class TooFewSamples(LineFamily):
    def sample_tasks(self, n: Any, rng: Any) -> Any:
        return super().sample_tasks(1, rng)


@breaks("The pickled task family has other test_tasks")
class ForgetsTasks(LineFamily):
    def __setstate__(self, state: Any) -> None:
        super().__setstate__({**state, "test_tasks": column(0.0)})


@breaks("The info of reset lacks `task_id`")
class SilentReset(LineEnv):
    def reset(self, **kwargs: Any) -> Any:
        return super().reset(**kwargs)[0], {}


@breaks("An observation of a step is not in the observation space, or not of its dtype")
class Float64Observation(LineEnv):
    def alter(self, observation: Any, *others: Any) -> Any:
        return observation.astype(np.float64), *others


@breaks("An observation of a step is not in the observation space, or not of its dtype")
class ObservationOutOfSpace(LineEnv):
    def alter(self, observation: Any, *others: Any) -> Any:
        return observation + np.float32(9.0), *others


@breaks("An observation of a step has a number that is not finite")
class NanObservation(LineEnv):
    def alter(self, observation: Any, *others: Any) -> Any:
        return np.full_like(observation, np.nan), *others


@breaks("An observation of a reset has a number that is not finite")
class NanAtReset(LineEnv):
    def reset(self, **kwargs: Any) -> Any:
        observation, info = super().reset(**kwargs)
        return np.full_like(observation, np.nan), info


@breaks("An observation of a reset is not in the observation space")
class ResetOutOfSpace(LineEnv):
    def reset(self, **kwargs: Any) -> Any:
        observation, info = super().reset(**kwargs)
        return observation + np.float32(9.0), info


@breaks("An observation of a step has a number that is not finite")
class InfiniteObservation(LineEnv):
    def __init__(self) -> None:
        super().__init__()
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def alter(self, observation: Any, *others: Any) -> Any:
        return np.full_like(observation, np.inf), *others


@breaks("The reward nan is not a finite float")
class NanReward(LineEnv):
    def alter(self, observation: Any, reward: Any, *others: Any) -> Any:
        return observation, float("nan"), *others


@breaks("is not a finite float")
class NumpyReward(LineEnv):
    def alter(self, observation: Any, reward: Any, *others: Any) -> Any:
        return observation, np.float32(reward), *others


@breaks("compute_reward does not give the rewards that step gave")
class OtherReward(LineEnv):
    def alter(self, observation: Any, reward: Any, *others: Any) -> Any:
        return observation, reward + 0.1, *others


@breaks("compute_reward does not give the rewards that step gave")
class OtherRewardOnSuccess(LineEnv):
    """A random episode would not see it: the check must replay one under a task that it solves."""

    def alter(self, observation: Any, reward: Any, terminated: Any, truncated: Any, info: Any) -> Any:
        return observation, reward + info["is_success"], terminated, truncated, info


@breaks("info['achieved_task'] is not the hindsight_task of its step")
class OtherAchievedTask(LineEnv):
    def alter(self, *result: Any) -> Any:
        result[-1]["achieved_task"] = result[-1]["achieved_task"] + np.float32(0.01)
        return result


@breaks("After set_task(None) an episode had task_id 77")
class IdOutOfRange(LineEnv):
    task_id = property(lambda self: 77)


@breaks("compute_reward fails on an episode. It raised")
class OneStepOnly(LineFamily):
    def compute_reward(self, *args: Any) -> Any:
        return super().compute_reward(*args).reshape(1)


class NoDenseReward(LineFamily):
    """Which breaks nothing: a dense proxy is one's own choice."""

    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        if reward_type == "dense":
            raise ValueError("no such type")
        return super().compute_reward(traj, task, reward_type)


@breaks("compute_reward with reward_type='dense' returned a number that is not finite")
class InfiniteDenseReward(LineFamily):
    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        return super().compute_reward(traj, task, reward_type) + np.float32(np.inf if reward_type == "dense" else 0.0)


@breaks("compute_reward takes an unknown reward_type")
class AnyRewardType(LineFamily):
    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        return super().compute_reward(traj, task, "dense" if reward_type == "dense" else "sparse")


@breaks("compute_reward must return one float32 for each step")
class Float64Reward(LineFamily):
    def compute_reward(self, *args: Any) -> Any:
        return super().compute_reward(*args).astype(np.float64)


@breaks("compute_reward must return one float32 for each step")
class OneRewardForAll(LineFamily):
    def compute_reward(self, *args: Any) -> Any:
        return super().compute_reward(*args)[..., :1]


@breaks("compute_reward returned a number that is not finite")
class InfiniteReward(LineFamily):
    def compute_reward(self, traj: Any, *args: Any) -> Any:
        return super().compute_reward(traj, *args) + np.float32(0.0 if len(traj.actions) == 1 else np.inf)


@breaks("compute_reward fails on some steps of an episode. It raised")
class WholeEpisodesOnly(LineFamily):
    def compute_reward(self, traj: Any, *args: Any) -> Any:
        if traj.actions.shape[-2] == 6:
            raise ValueError("no end of the episode")
        return super().compute_reward(traj, *args)


@breaks("compute_reward does not give the rewards that step gave")
class CenteredReward(LineFamily):
    def compute_reward(self, *args: Any) -> Any:
        rewards = super().compute_reward(*args)
        return rewards - rewards.mean(axis=-1, keepdims=True)


@breaks("compute_reward makes a step depend on other steps")
class RewardOfLength(LineFamily):
    """Right for one step and for a whole episode, wrong for a part of it."""

    def compute_reward(self, traj: Any, *args: Any) -> Any:
        return super().compute_reward(traj, *args) + np.float32(traj.actions.shape[-2] == 6)


@breaks("is_success makes a step depend on other steps")
class SuccessOfLength(LineFamily):
    def is_success(self, traj: Any, task: Any) -> Any:
        return super().is_success(traj, task) ^ (traj.actions.shape[-2] == 6)


@breaks("compute_reward with 'dense' makes a step depend on other steps")
class CenteredDenseReward(LineFamily):
    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        rewards = super().compute_reward(traj, task, reward_type)
        return rewards - rewards.mean(axis=-1, keepdims=True) if reward_type == "dense" else rewards


@breaks("compute_reward is not vectorized")
class FlatReward(LineFamily):
    def compute_reward(self, traj: Any, *args: Any) -> Any:
        if traj.actions.ndim > 2:
            raise IndexError("too many axes")
        return super().compute_reward(traj, *args)


@breaks("compute_reward is not vectorized")
class RewardOfFirstTask(LineFamily):
    def compute_reward(self, traj: Any, task: Any, *args: Any) -> Any:
        first = np.broadcast_to(np.reshape(task, (-1, 1))[0], np.shape(task))
        return super().compute_reward(traj, first, *args)


@breaks("is_success is not vectorized")
class SuccessOfFirstTask(LineFamily):
    def is_success(self, traj: Any, task: Any) -> Any:
        return super().is_success(traj, np.broadcast_to(np.reshape(task, (-1, 1))[0], np.shape(task)))


@breaks("hindsight_task is not vectorized")
class HindsightOfFirstIndex(LineFamily):
    def hindsight_task(self, traj: Any, index: Any) -> Any:
        return super().hindsight_task(traj, np.broadcast_to(np.ravel(index)[0], np.shape(index)))


@breaks("compute_reward gives something else when it is called again")
class RewardWithMemory(LineFamily):
    calls = 0

    def compute_reward(self, traj: Any, *args: Any) -> Any:
        self.calls += len(traj.actions) > 1
        return super().compute_reward(traj, *args) + np.float32(self.calls)


@breaks("A hook of the task family changes the trajectory")
class RewardInPlace(LineFamily):
    def compute_reward(self, traj: Any, *args: Any) -> Any:
        rewards = super().compute_reward(traj, *args)
        if len(traj.actions) > 1:
            traj.actions[...] = 0.0
        return rewards


@breaks("compute_reward of the task family writes into the trajectory or task that it is given: let it make new arrays")
class RewardOnTop(LineFamily):
    """Of the task-free one, which each step would have more of; only where the task is solved."""

    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        rewards = traj.task_free_reward
        rewards += self.is_success(traj, task)
        return rewards


@breaks("is_success of the task family writes into the trajectory or task that it is given: let it make new arrays")
class DistanceInPlace(LineFamily):
    def is_success(self, traj: Any, task: Any) -> Any:
        task -= traj.next_observations[..., 0]
        return np.abs(task) < 0.05


@breaks("does not solve the task that hindsight_task named for it")
class UnsolvedHindsight(LineFamily):
    def hindsight_task(self, traj: Any, index: Any) -> Any:
        return super().hindsight_task(traj, index) + np.float32(0.2)


@breaks("hindsight_task must return a copy")
class HindsightView(LineFamily):
    def hindsight_task(self, traj: Any, index: Any) -> Any:
        return traj.next_observations[index, :1] if np.ndim(index) == 0 else super().hindsight_task(traj, index)


@breaks("The sparse reward of an unsuccessful step is not 0")
class PunishedFailure(LineFamily):
    def compute_reward(self, traj: Any, task: Any, *args: Any) -> Any:
        return super().compute_reward(traj, task, *args) - np.float32(1.0)


@breaks("The sparse reward of an unsuccessful step is not 0")
class LeakingReward(LineFamily):
    def compute_reward(self, traj: Any, task: Any, *args: Any) -> Any:
        return super().compute_reward(traj, task, *args) - np.abs(np.asarray(task, dtype=np.float32))


@breaks("but 5e-05, which leaks the task: compute_reward is what the task pays plus traj.task_free_reward")
class InexactReward(LineFamily):
    """More than rounding."""

    def compute_reward(self, traj: Any, task: Any, *args: Any) -> Any:
        return super().compute_reward(traj, task, *args) + np.float32(5e-5)


@breaks("are worth no more than a failure: compute_reward must pay for each success")
class UnpaidSuccess(LineFamily):
    """Exact ones are paid, and those beside are not."""

    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        rewards = super().compute_reward(traj, task, reward_type)
        exact = self.distance(traj, task) < 0.01
        return rewards if reward_type == "dense" else np.where(exact, rewards, traj.task_free_reward)


@breaks("A step that solves its task exactly is worth no more than a failure")
class WorthlessSuccess(LineFamily):
    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        worth = self.is_success(traj, task) if reward_type == "sparse" else np.float32(0.0)
        return super().compute_reward(traj, task, reward_type) - worth


@breaks("The task leaks into the observations")
class ObservedTask(LineEnv):
    def observe(self) -> Any:
        return np.array([self.x, self.task[0] / 10.0], dtype=np.float32)


@breaks("The task leaks into the end of the episode")
class StopsAtGoal(LineEnv):
    def alter(self, observation: Any, reward: Any, terminated: Any, truncated: Any, info: Any) -> Any:
        return observation, reward, terminated or info["is_success"], truncated, info


@breaks("info['task_free_reward'] depends on the task")
class TaskCost(LineEnv):
    def _step_state(self, action: Any) -> Any:
        state, cost, terminated = super()._step_state(action)
        return state, cost - abs(float(self.task[0])), terminated


@breaks("Calling compute_reward or hindsight_task changes the env")
class DisturbedByHooks(LineEnv):
    def hindsight_task(self, traj: Any, index: Any) -> Any:
        self.x += 0.1 * (len(traj.actions) > 1)
        return super().hindsight_task(traj, index)


@breaks("reset does not honour options={'task': vector}")
class IgnoresVectors(LineEnv):
    def _give_task(self, key: str, value: Any) -> None:
        super()._give_task(key, self.test_tasks[0] if key == "task" and np.isfinite(value).all() else value)


@breaks("reset does not honour options={'task': vector}: the task_id is 0, it must be -1")
class VectorWithTrainingId(LineEnv):
    task_id = property(lambda self: max(0, self._current_task()[0]))


@breaks("The same seed, task and actions gave another episode: use no other randomness than self.np_random")
class OtherRandomness(LineEnv):
    def _reset_state(self) -> Any:
        super()._reset_state()
        self.x = float(np.random.uniform(-0.1, 0.1))
        return self.observe()


@breaks("The action_space has no bounds")
class UnboundedActions(LineEnv):
    def __init__(self, family: Any = None) -> None:
        super().__init__(family)
        self.action_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)


@breaks("reset does not honour options={'task_id': i}")
class IgnoresIds(LineEnv):
    def _give_task(self, key: str, value: Any) -> None:
        super()._give_task(key, 0 if key == "task_id" else value)


@breaks("A task given in the options of a reset does not stay")
class ForgetsOptions(LineEnv):
    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        given = self._given_task
        result = super().reset(seed=seed, options=options)
        self._given_task = given
        return result


@breaks("An env that was given no task must draw a new one at each reset")
class DrawsOnce(LineEnv):
    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return super().reset(seed=0 if seed is None else seed, options=options)


@breaks("set_task changes the task within an episode")
class SetsTaskAtOnce(LineEnv):
    def set_task(self, task: Any) -> None:
        super().set_task(task)
        self._task_of_episode = self._given_task or self._task_of_episode


@breaks("A task id given to set_task does not stay")
class SetTaskIgnoresIds(LineEnv):
    def set_task(self, task: Any) -> None:
        super().set_task(None if isinstance(task, int) else task)


@breaks("A task vector given to set_task does not stay")
class SetTaskIgnoresVectors(LineEnv):
    def set_task(self, task: Any) -> None:
        super().set_task(None if isinstance(task, np.ndarray) else task)


@breaks("After set_task(None) an episode had task_id -1")
class SetTaskIgnoresNone(LineEnv):
    def set_task(self, task: Any) -> None:
        if task is not None:
            super().set_task(task)


@breaks("reset takes options={'task_id': 4}: it must raise a ValueError")
class TakesAnything(LineEnv):
    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        try:
            return super().reset(seed=seed, options=options)
        except ValueError:
            return super().reset(seed=seed)


@breaks("it must raise a ValueError")
class RaisesSomethingElse(LineEnv):
    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        try:
            return super().reset(seed=seed, options=options)
        except ValueError as error:
            raise KeyError("something else") from error
