"""HiddenGoal: any GoalEnv becomes a task family whose goal is not shown."""

from __future__ import annotations

import inspect
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec, register
from numpy.typing import ArrayLike, NDArray

from htr_envs.goal_env_source import (
    GoalEnvSource,
    draw_goal,
    draw_goal_sets,
    goal_rewards,
    probe,
    space_without_goal,
    without_goal,
)
from htr_envs.headless import open_no_window
from htr_envs.task_env import BoolArray, FloatArray, TaskEnv, TaskFamily, Trajectory, at_step, check_reward_type, l2_distance
from htr_envs.task_sets import check_task_sets

NAMESPACE = "HiddenGoal"
NOT_BEGUN = -1


class HiddenGoalFamily(TaskFamily):
    """The goals of a GoalEnv, worth 1 for each step that ends at the goal and 0 for any other.

    The env draws the goals, and its ``compute_reward`` says which are reached. It is made when it is first asked, once for
    all families of the process; pickled is how to make it. The last numbers of an observation are the achieved goal.

    :param env_id: of the GoalEnv, see :class:`HiddenGoalEnv`.
    :param env_kwargs: arguments of the GoalEnv.
    :param n_train_tasks: how many training tasks.
    :param n_test_tasks: how many test tasks.
    :param n_validation_tasks: how many validation tasks.
    :param task_seed: seed of the task sets.
    :raises ValueError: if the env is no GoalEnv, its reward is not sparse, it has too few goals, or a number is out of range.
    :raises gymnasium.error.Error: if there is no such env, or it cannot be made with what is installed.
    """

    def __init__(
        self,
        env_id: str | EnvSpec,
        env_kwargs: dict[str, Any] | None = None,
        n_train_tasks: int = 80,
        n_test_tasks: int = 100,
        n_validation_tasks: int = 20,
        task_seed: int = 1337,
    ) -> None:
        self.source = GoalEnvSource.find(env_id, env_kwargs or {})
        check_task_sets(n_train_tasks, n_validation_tasks, n_test_tasks, task_seed)
        goals = draw_goal_sets(self.source, n_train_tasks, n_validation_tasks, n_test_tasks, task_seed)
        self.failure_reward = goals.failure_reward
        # whatever bounds the env has: where an object falls, its position is a hindsight task too
        task_space = spaces.Box(-np.inf, np.inf, goals.train.shape[1:], np.float32)
        super().__init__(task_space, goals.train, goals.validation, goals.test)

    def sample_tasks(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Have the env draw goals."""
        return np.stack([draw_goal(self.source, int(seed)) for seed in rng.integers(2**31, size=n)])

    def compute_reward(self, traj: Trajectory, task: ArrayLike, reward_type: str = "sparse") -> FloatArray:
        """Goal reward plus task-free reward of every step.

        :param reward_type: ``"sparse"``: 1 where the goal is reached, else 0. ``"dense"``: the env's own dense reward, or
            minus the distance to the goal where it has no argument ``reward_type``.
        """
        check_reward_type(reward_type)
        goal_reward = self._dense_reward(traj, task) if reward_type == "dense" else self.is_success(traj, task)
        return np.asarray(goal_reward + traj.task_free_reward, dtype=np.float32)

    def is_success(self, traj: Trajectory, task: ArrayLike) -> BoolArray:
        """Whether the next state of every step is at the goal, by the env's own reward."""
        return self.reached(*self._goals(traj, task))

    def reached(self, achieved_goals: ArrayLike, goals: ArrayLike) -> BoolArray:
        """Where goals are reached.

        :param achieved_goals: shape (..., goal_dim).
        :param goals: shape (..., goal_dim); leading axes broadcast.
        :return: shape (...).
        """
        return np.asarray(goal_rewards(self.source, achieved_goals, goals) > self.failure_reward)

    def hindsight_task(self, traj: Trajectory, index: ArrayLike) -> FloatArray:
        """The goal that is achieved after one step."""
        return at_step(self._achieved(traj), index)

    def _achieved(self, traj: Trajectory) -> FloatArray:
        return np.asarray(traj.next_observations, dtype=np.float32)[..., -self.train_tasks.shape[1] :]

    def _goals(self, traj: Trajectory, task: ArrayLike) -> tuple[FloatArray, FloatArray]:
        return self._achieved(traj), np.asarray(task, dtype=np.float32)[..., None, :]

    def _dense_reward(self, traj: Trajectory, task: ArrayLike) -> FloatArray:
        achieved, goals = self._goals(traj, task)
        dense = self.source.dense()
        if dense is not None:
            return goal_rewards(dense, achieved, goals)
        return -l2_distance(achieved, goals)


class HiddenGoalEnv(TaskEnv):
    """
    ## Description

    An env that other people made for hindsight experience replay, a GoalEnv, with its goal hidden: what was to be read in the
    observation must be found out. The first episodes on a task search, the later ones go where the reward was.

    ## Action Space

    That of the GoalEnv, in float32. Actions are clipped to it.

    ## Observation Space

    `observation` of the GoalEnv, then its `achieved_goal`, in float32, without bounds. `desired_goal` is left out, and
    so are all infos.

    ## Rewards

    - `reward_type="sparse"`: `1` where the GoalEnv's own `compute_reward` says that the goal is reached, else `0`. Both kinds
      of sparse rewards, -1 and 0 or 0 and 1, become this one. An agent that was trained so and adapts to a robot must be given
      1 and 0 as well, as `HiddenGoalWrapper` does.
    - `reward_type="dense"`: the reward of the GoalEnv with its own argument `reward_type="dense"`; minus the distance between
      achieved and desired goal where it has no such argument.

    There is no task-free reward: `info["task_free_reward"]` is 0.

    ## Task distribution

    A task is a goal. The GoalEnv draws all of them itself, by resets that are seeded by `task_seed`: training, validation and
    test tasks, of which no two are alike. `task_space` has no bounds, because a hindsight task is any goal that was achieved.

    ## Starting State

    That of the GoalEnv, which has a goal of its own that nobody sees. It is drawn anew with each start, whatever the task, so
    that a start says nothing about the task, even in mazes, where the start is kept away from the env's own goal.

    ## Episode End

    ### Termination

    Where the GoalEnv ends, unless it ends because its own goal is reached, which means nothing here: then it is stepped on, so
    it must not refuse that.

    ### Truncation

    After as many steps as in the GoalEnv, or where it truncates an episode itself.

    ## Arguments

    | Parameter            | Default    | Description                                                            |
    |----------------------|------------|------------------------------------------------------------------------|
    | `env_id`             |            | id of the GoalEnv; `"module:id"` imports the module that registers it  |
    | `env_kwargs`         | `None`     | arguments of the GoalEnv                                               |
    | `n_train_tasks`      | `80`       | number of training tasks                                               |
    | `n_test_tasks`       | `100`      | number of test tasks                                                   |
    | `n_validation_tasks` | `20`       | number of validation tasks                                             |
    | `task_seed`          | `1337`     | seed of the task sets, apart from the run's seed                       |
    | `reward_type`        | `"sparse"` | reward of `step`, `"sparse"` or `"dense"`                              |
    | `render_mode`        | `None`     | `"rgb_array"` for pictures, with the hidden goal                       |

    `reset(options={"task_id": i})` or `reset(options={"task": goal})` gives the env a task, which stays until it is changed.

    ## Version History

    - v0: first version
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 25}  # type: ignore[misc]
    task_family: HiddenGoalFamily

    def __init__(
        self,
        env_id: str | EnvSpec,
        env_kwargs: dict[str, Any] | None = None,
        reward_type: str = "sparse",
        render_mode: str | None = None,
        **task_sets: Any,
    ) -> None:
        super().__init__(HiddenGoalFamily(env_id, env_kwargs, **task_sets), reward_type)
        env = probe(self.task_family.source)
        assert isinstance(env.action_space, spaces.Box)
        self.observation_space = space_without_goal(env)
        self._bounds = env.action_space.low, env.action_space.high
        low, high = (bound.astype(np.float32) for bound in self._bounds)
        self.action_space = spaces.Box(low, high, dtype=np.float32)
        modes = [mode for mode in self.metadata["render_modes"] if mode in env.metadata.get("render_modes", ())]
        if render_mode not in (None, *modes):
            raise ValueError(f"render_mode is {render_mode!r}, expected None or one of {modes}.")
        shown = {"render_modes": modes, "render_fps": env.metadata.get("render_fps", 25)}
        self.metadata = {**self.metadata, **shown}  # type: ignore[misc]
        self.render_mode = render_mode
        self._truncated = False  # by the GoalEnv, in its latest step
        # An episode is its seed and its actions: with them, a copy plays it again, as simulations can rarely be copied
        self._seed, self._actions = 0, list[NDArray[Any]]()
        self._env: gym.Env[Any, Any] | None = None
        # Pictures are taken of an env that follows, whose own goal is the hidden one
        self._picture: gym.Env[Any, Any] | None = None
        self._n_shown = NOT_BEGUN

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_env": None, "_picture": None}

    def _reset_state(self) -> FloatArray:
        # each start is drawn by our generator alone, so that its state is all there is to resume from
        self._seed, self._actions, self._n_shown = int(self.np_random.integers(2**31)), [], NOT_BEGUN
        if self._env is None:
            self._env = self.task_family.source.make()
        observation, _ = self._env.reset(seed=self._seed)
        return without_goal(observation)

    def _step_state(self, action: FloatArray) -> tuple[FloatArray, float, bool]:
        if self._env is None:
            self._env = self.task_family.source.make()
            self._follow(self._env, NOT_BEGUN)
        # by bounds of the GoalEnv's own dtype: those of our space, rounded to float32, may lie outside of them
        self._actions.append(np.clip(action, *self._bounds))
        observation, paid, terminated, self._truncated, _ = self._env.step(self._actions[-1].copy())
        failure = self.task_family.failure_reward
        if paid not in (failure, failure + 1.0):
            raise ValueError(
                f"A step of {self.task_family.source.spec.id} gave the reward {float(paid):.3g}, but compute_reward gives "
                f"{failure:.3g} or {failure + 1.0:.3g}: a reward must depend on achieved and desired goal alone."
            )
        own_end = terminated and self.task_family.reached(observation["achieved_goal"], observation["desired_goal"])
        return without_goal(observation), 0.0, bool(terminated and not own_end)

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Do one step; the time limit is left to the TimeLimit wrapper.

        :param action: the action, shape (act_dim,).
        :return: next observation (obs_dim,), reward, terminated, whether the GoalEnv was truncated, info.
        """
        observation, reward, terminated, _, info = super().step(action)
        return observation, reward, terminated, bool(self._truncated), info

    def _follow(self, env: gym.Env[Any, Any], n_steps: int) -> None:
        """Play the episode in an env that has done so many steps of it."""
        if n_steps == NOT_BEGUN:
            env.reset(seed=self._seed)
        for action in self._actions[max(n_steps, 0) :]:
            env.step(action.copy())

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the GoalEnv with the hidden goal in the place of its own, where it keeps that in an attribute ``goal``.

        :return: picture (height, width, 3), uint8; None without a render mode.
        :raises gymnasium.error.ResetNeeded: before the first reset, with a render mode.
        """
        if self.render_mode is None:
            return None
        goal = self.task
        if self._picture is None:
            open_no_window()
            self._picture, self._n_shown = self.task_family.source.make(render_mode=self.render_mode), NOT_BEGUN
        self._follow(self._picture, self._n_shown)
        self._n_shown = len(self._actions)
        _show_goal(self._picture.unwrapped, goal)
        _take_window_back(self._picture.unwrapped)
        frame: Any = self._picture.render()
        return np.asarray(frame, dtype=np.uint8)

    def close(self) -> None:
        """Close the GoalEnv; a later reset makes it anew."""
        for env in (self._env, self._picture):
            if env is not None:
                env.close()
        self._env = self._picture = None


def _show_goal(env: Any, goal: FloatArray) -> None:
    owner: Any = env if hasattr(env, "goal") else getattr(env, "task", None)  # panda-gym has a task that keeps it
    if hasattr(owner, "goal"):
        owner.goal = goal.astype(np.float64)
    if hasattr(env, "update_target_site_pos"):  # mazes, whose next step would move it
        import mujoco

        env.update_target_site_pos()
        mujoco.mj_kinematics(env.model, env.data)
    elif hasattr(env, "sim") and hasattr(env.sim, "set_base_pose"):  # panda-gym
        env.sim.set_base_pose("target", goal, np.array([0.0, 0.0, 0.0, 1.0]))


def _take_window_back(env: Any) -> None:
    # another env's window of MuJoCo, opened or closed since, may have taken OpenGL away; then pictures are black
    for part in (env, *vars(env).values()):
        renderer = getattr(part, "mujoco_renderer", None)
        if renderer is not None and renderer.viewer is not None:
            renderer.viewer.make_context_current()


def hide_goal(env_id: str, **env_kwargs: Any) -> str:
    """Register the task family of a GoalEnv, with the time limit of the GoalEnv.

    A later call for the same GoalEnv, with other arguments, takes the place of this one: the id does not name them. For
    variants side by side, register ids of your own for the GoalEnv.

    :param env_id: id of the GoalEnv; ``"module:id"`` imports the module that registers it.
    :param env_kwargs: arguments of the GoalEnv.
    :return: id of the family, ``HiddenGoal/`` and that of the GoalEnv (``/`` in it becomes ``-``).
    :raises ValueError: if it is no id, or an argument is one of the family.
    :raises gymnasium.error.Error: if there is no such env, or its package is not installed.
    """
    if not isinstance(env_id, str):
        raise ValueError(f"hide_goal takes the id of a GoalEnv, got {env_id!r}: register the env, and give its id.")
    of_family = sorted({*inspect.signature(HiddenGoalFamily).parameters} & env_kwargs.keys())
    if of_family:
        raise ValueError(
            f"{of_family[0]} is an argument of the family, and not of {env_id}: "
            f"gymnasium.make(hide_goal({env_id!r}), {of_family[0]}={env_kwargs[of_family[0]]!r})."
        )
    spec = GoalEnvSource.find(env_id, env_kwargs).spec
    hidden_id = f"{NAMESPACE}/{spec.id.replace('/', '-')}"
    # the registration, not its id: in a process of its own the registry may not have it
    known = gym.registry.get(hidden_id)
    steps = spec.max_episode_steps
    own = GoalEnvSource.find(spec, {})
    if known is None or known.max_episode_steps != steps or GoalEnvSource.find(known.kwargs["env_id"], {}) != own:
        register(hidden_id, "htr_envs.goal_env:HiddenGoalEnv", max_episode_steps=steps, kwargs={"env_id": spec})
    return hidden_id


def find_hidden(env_id: str) -> None:
    """Register ``HiddenGoal/ID`` if that is what an id spells, as on a command line, and if it is not registered yet.

    :param env_id: the id.
    :raises gymnasium.error.Error: if there is no such GoalEnv, or its package is not installed.
    """
    namespace, _, goal_env_id = env_id.partition("/")
    # no "module:id": what a file may name is looked up here too, and must not have code imported
    if namespace == NAMESPACE and ":" not in goal_env_id and env_id not in gym.registry:
        own = [known for known in gym.registry if known.replace("/", "-") == goal_env_id]
        hide_goal(own[0] if own else goal_env_id)
