"""Check that an environment keeps the promises of a task family, as ``check_env`` does for those of an environment."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from htr_envs.task_env import BoolArray, FloatArray, TaskFamily, Trajectory

MAX_STEPS = 200  # of an episode that are looked at
N_DRAWS = 30
# What a step that solves nothing may be worth: the difference of two float32. More is a success to all that learns from it
ROUNDING = 1e-5
# Share of the successes that may be worth nothing: a reward that falls to 0 at the rim of a goal rounds some of them to it
UNPAID = 0.1
NOT_REPEATABLE = "The same seed, task and actions gave another episode: use no other randomness than self.np_random."
TASK_SETS = ("train_tasks", "validation_tasks", "test_tasks")
# What tells the reward of a step under any task; a family of a MetaEnv has none of these
REWARD_HOOKS = ("compute_reward", "is_success", "hindsight_task")
INFO_KINDS = {"task_id": int, "is_success": bool, "achieved_task": np.ndarray, "task_free_reward": float}


class Episode(NamedTuple):
    """What one episode gave, T steps long."""

    traj: Trajectory
    rewards: FloatArray
    successes: BoolArray
    achieved_tasks: FloatArray
    terminated: BoolArray
    truncated: BoolArray
    infos: NDArray[np.object_]
    task_id: int


def _require(kept: bool | np.bool_, sentence: str) -> None:
    # not an assert statement, which python -O would skip
    if not kept:
        raise AssertionError(sentence)


def _call(sentence: str, function: Callable[..., Any], *args: Any) -> Any:
    try:
        return function(*args)
    except Exception as error:
        raise AssertionError(f"{sentence} It raised {error!r}.") from error


def _same(first: ArrayLike, second: ArrayLike) -> bool:
    # shapes must agree; a sum over many dimensions may round otherwise in a batch of another shape
    return np.shape(first) == np.shape(second) and np.allclose(first, second, rtol=1e-5, atol=1e-6)


def _select(traj: Trajectory, index: Any) -> Trajectory:
    return Trajectory(*(values[index] for values in traj))


def _has_reward_hooks(family: Any) -> bool:
    return any(hasattr(family, name) for name in REWARD_HOOKS)


def _check_interface(env: gym.Env[Any, Any]) -> TaskFamily:
    _require(isinstance(env, gym.Env), "check_task_env takes one env: pass gymnasium.make(id).")
    base: Any = env.unwrapped
    advice = "hide the goal of a GoalEnv with htr_envs.hide_goal, derive any other env from htr_envs.TaskEnv."
    _require(hasattr(base, "task_family"), f"The env has no `task_family`: {advice}")
    family: TaskFamily = base.task_family
    hooks = REWARD_HOOKS if _has_reward_hooks(family) else ()
    for name in ("sample_tasks", *hooks, *TASK_SETS, "task_space"):
        advice = "derive it from htr_envs.TaskFamily, and call its __init__ with the tasks."
        _require(hasattr(family, name), f"The task family has no `{name}`: {advice}")
    for name in ("set_task", *hooks[::2], *TASK_SETS, "task_space"):
        _require(hasattr(base, name), f"The env has no `{name}`: derive it from htr_envs.TaskEnv.")
    for what, space in (("observation_space", env.observation_space), ("action_space", env.action_space)):
        flat = isinstance(space, spaces.Box) and len(space.shape) == 1 and np.issubdtype(space.dtype, np.floating)
        _require(flat, f"The {what} must be a one-dimensional Box of floats.")
    _require(env.action_space.is_bounded(), "The action_space has no bounds: give it some, and scale actions in the env.")  # type: ignore[attr-defined]
    limited = any(env.has_wrapper_attr(name) for name in ("_max_episode_steps", "max_episode_steps"))
    limited = limited or (env.spec is not None and env.spec.max_episode_steps is not None)
    _require(limited, "The env has no time limit: register it with max_episode_steps, and pass gymnasium.make(id).")
    return family


def _check_task_array(tasks: Any, family: TaskFamily, name: str) -> None:
    (task_dim,) = family.task_space.shape
    is_array = isinstance(tasks, np.ndarray)
    what = f"a {tasks.dtype} array of shape {tasks.shape}" if is_array else f"a {type(tasks).__name__}"
    shaped = is_array and tasks.dtype == np.float32 and tasks.ndim == 2 and tasks.shape[1] == task_dim and len(tasks) > 0
    _require(shaped, f"{name} must be a float32 array (n, {task_dim}) of at least one task, and is {what}.")
    _require(all(family.task_space.contains(task) for task in tasks), f"{name} has a task that is not in the task space.")


def _check_family(family: TaskFamily) -> None:
    flat = isinstance(family.task_space, spaces.Box) and len(family.task_space.shape) == 1
    _require(flat, "The task space must be a one-dimensional Box.")
    seen: set[tuple[float, ...]] = set()
    for name in TASK_SETS:
        tasks = getattr(family, name)
        _check_task_array(tasks, family, name)
        _require(not tasks.flags.writeable, f"{name} can be written to: call its setflags(write=False).")
        keys = {tuple(task) for task in tasks.tolist()}
        _require(len(keys) == len(tasks), f"{name} holds a task twice: the tasks of a set must differ.")
        _require(not keys & seen, f"{name} shares a task with another set: train must not meet validation or test.")
        seen |= keys
    drawn = [family.sample_tasks(5, np.random.default_rng(0)) for _ in range(2)]
    _check_task_array(drawn[0], family, "What sample_tasks returned")
    _require(len(drawn[0]) == 5, f"sample_tasks(5, rng) returned {len(drawn[0])} tasks instead of 5.")
    _require(_same(*drawn), "sample_tasks draws from another source than the generator that it is given.")
    twin = _call("The task family cannot be pickled.", lambda: pickle.loads(pickle.dumps(family)))
    for name in TASK_SETS:
        _require(_same(getattr(twin, name), getattr(family, name)), f"The pickled task family has other {name}.")


def _check_observation(env: gym.Env[Any, Any], observation: Any, when: str) -> None:
    typed = isinstance(observation, np.ndarray) and observation.dtype == env.observation_space.dtype
    _require(not typed or np.isfinite(observation).all(), f"An observation of {when} has a number that is not finite.")
    fits = typed and observation in env.observation_space
    _require(fits, f"An observation of {when} is not in the observation space, or not of its dtype.")


def _check_step(env: gym.Env[Any, Any], family: TaskFamily, observation: Any, reward: Any, info: dict[str, Any]) -> None:
    _check_observation(env, observation, "a step")
    _require(isinstance(reward, float) and bool(np.isfinite(reward)), f"The reward {reward!r} is not a finite float.")
    told = _has_reward_hooks(family)
    for key in INFO_KINDS if told else ("task_id",):
        kind = INFO_KINDS[key]
        _require(key in info, f"The info of step lacks `{key}`.")
        _require(type(info[key]) is kind, f"info[{key!r}] is a {type(info[key]).__name__}, it must be a {kind.__name__}.")
    if not told:
        return
    _require(np.isfinite(info["task_free_reward"]), "info['task_free_reward'] is not finite.")
    _check_task_array(info["achieved_task"][None], family, "info['achieved_task'][None], of hindsight_task,")


def _play(
    env: gym.Env[Any, Any],
    family: TaskFamily,
    seed: int,
    task: FloatArray | int | None = None,
    actions: FloatArray | None = None,
    after_step: Callable[[], object] = lambda: None,
) -> Episode:
    action_space = copy.deepcopy(env.action_space)
    action_space.seed(seed)
    options = None if task is None else {"task_id" if isinstance(task, int) else "task": task}
    observation, info = _call("The env fails in a reset.", lambda: env.reset(seed=seed, options=options))
    _check_observation(env, observation, "a reset")
    _require(type(info.get("task_id")) is int, "The info of reset lacks `task_id`, or it is no int.")
    task_id: int = info["task_id"]
    rows: list[tuple[Any, ...]] = []
    done = False
    while not done and len(rows) < (MAX_STEPS if actions is None else len(actions)):
        action = action_space.sample() if actions is None else actions[len(rows)]
        next_observation, reward, terminated, truncated, info = _call("The env fails in a step.", env.step, action)
        _check_step(env, family, next_observation, reward, info)
        _require(info["task_id"] == task_id, f"The task changed within an episode, from {task_id} to {info['task_id']}.")
        free, success, achieved_task = (info.get(key) for key in ("task_free_reward", "is_success", "achieved_task"))
        fresh = not rows or achieved_task is None or not np.shares_memory(achieved_task, rows[-1][6])
        _require(fresh, "info['achieved_task'] is the same memory at each step: return a copy.")
        step = observation, action, next_observation, free, reward, success, achieved_task
        rows.append((*step, terminated, truncated, info))
        observation, done = next_observation, terminated or truncated
        after_step()
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    traj = Trajectory(*(column.astype(np.float32) for column in columns[:4]))
    successes, achieved_tasks, ends, cuts, infos = columns[5:]
    return Episode(traj, columns[4].astype(np.float32), successes, achieved_tasks, ends, cuts, infos, task_id)


def _check_rewards(env: gym.Env[Any, Any], family: TaskFamily, episode: Episode, task: FloatArray) -> None:
    base: Any = env.unwrapped
    rewards = base.compute_reward(episode.traj, task)
    shaped = isinstance(rewards, np.ndarray) and rewards.dtype == np.float32 and rewards.shape == episode.rewards.shape
    _require(shaped, "compute_reward must return one float32 for each step, an array (..., T).")
    _require(_same(rewards, episode.rewards), "compute_reward does not give the rewards that step gave.")
    successes = family.is_success(episode.traj, task)
    shaped = isinstance(successes, np.ndarray) and successes.dtype == np.bool_
    _require(shaped, "is_success must return one bool for each step, an array (..., T).")
    _require(_same(successes, episode.successes), "is_success does not give the info['is_success'] that step gave.")


def _has_dense(family: TaskFamily, traj: Trajectory, task: FloatArray) -> bool:
    """A family may refuse it, as it does an unknown type."""
    try:
        family.compute_reward(traj, task, "dense")
    except ValueError:
        return False
    except Exception as error:
        told = f"compute_reward with reward_type='dense' raised {error!r}: it must return rewards, or raise a ValueError."
        raise AssertionError(told) from error
    return True


def _check_reward_types(family: TaskFamily, traj: Trajectory, task: FloatArray) -> None:
    reward_type = "dense" if _has_dense(family, traj, task) else "sparse"
    dense = family.compute_reward(traj, task, reward_type)
    shaped = isinstance(dense, np.ndarray) and dense.dtype == np.float32 and dense.shape == traj.task_free_reward.shape
    _require(
        shaped, f"compute_reward with reward_type={reward_type!r} must return one float32 for each step, an array (..., T)."
    )
    try:
        family.compute_reward(traj, task, "no such type")
    except ValueError:
        return
    raise AssertionError("compute_reward takes an unknown reward_type: it must raise a ValueError.")


def _check_vectorized(name: str, hook: Callable[[Trajectory, Any], Any], traj: Trajectory, tasks: FloatArray) -> None:
    length = len(traj.task_free_reward)
    rng = np.random.default_rng(0)
    orders = [rng.permutation(length) for _ in tasks]
    plain, *others = (hook(traj, task) for task in tasks)
    finite = bool(np.isfinite([plain, *others]).all())
    _require(finite, f"{name} returned a number that is not finite, for tasks that hindsight_task named.")
    for pick in (orders[0], orders[0][: length // 2 + 1], orders[0][:1]):
        chosen = _call(f"{name} fails on some steps of an episode.", hook, _select(traj, pick), tasks[0])
        _require(_same(chosen, plain[pick]), f"{name} makes a step depend on other steps of the trajectory.")

    vectorized = f"{name} is not vectorized: leading axes of trajectory and task must broadcast."
    batch = _select(traj, np.stack(orders))
    batch_of_batches = _select(traj, np.stack((orders, orders[::-1])))
    cases = (
        (batch, tasks, [hook(_select(batch, i), task) for i, task in enumerate(tasks)]),
        (batch, tasks[0], [hook(_select(batch, i), tasks[0]) for i in range(len(tasks))]),
        (traj, tasks, [plain, *others]),
        (
            batch_of_batches,
            tasks,
            [[hook(_select(batch_of_batches, (j, i)), task) for i, task in enumerate(tasks)] for j in range(2)],
        ),
    )
    for steps, task, expected in cases:
        _require(_same(_call(vectorized, hook, steps, task), expected), vectorized)


def _check_pure(family: TaskFamily, traj: Trajectory) -> None:
    before = [values.copy() for values in traj]
    task, other_task = family.train_tasks[0], family.train_tasks[-1]
    calls: dict[str, Callable[[], Any]] = {
        "compute_reward": lambda: family.compute_reward(traj, task),
        "is_success": lambda: family.is_success(traj, task),
        "hindsight_task": lambda: family.hindsight_task(traj, 0),
    }
    if _has_dense(family, traj, other_task):
        calls["compute_reward with reward_type='dense'"] = lambda: family.compute_reward(traj, other_task, "dense")
    first, second = ([_call(f"{name} fails on an episode.", call) for name, call in calls.items()] for _ in range(2))
    for name, result, again in zip(calls, first, second, strict=True):
        numbers = _call(f"{name} returned no numbers.", np.isfinite, result)
        _require(bool(np.all(numbers)), f"{name} returned a number that is not finite.")
        _require(_same(result, again), f"{name} gives something else when it is called again: it must be pure.")
    unchanged = all(map(np.array_equal, before, traj))
    _require(unchanged, "A hook of the task family changes the trajectory that it is given: it must be pure.")


def _check_hindsight(family: TaskFamily, episode: Episode) -> FloatArray:
    traj, length = episode.traj, len(episode.rewards)
    tasks = np.stack([family.hindsight_task(traj, index) for index in range(length)])
    _check_task_array(tasks, family, "What hindsight_task returned for each step")
    view = np.shares_memory(family.hindsight_task(traj, 0), traj.next_observations)
    _require(not view, "hindsight_task must return a copy.")
    _require(_same(tasks, episode.achieved_tasks), "info['achieved_task'] is not the hindsight_task of its step.")
    for index, task in enumerate(tasks):
        solved = bool(family.is_success(traj, task)[index])
        advice = "every state must solve some task. What success asks for beside, such as a low speed, belongs into the task."
        _require(solved, f"The state of step {index} does not solve the task that hindsight_task named for it: {advice}")

    vectorized = "hindsight_task is not vectorized: `index` must broadcast with the leading axes of the trajectory."
    indices = np.array([0, length // 2, length - 1])
    batch = _select(traj, np.stack([np.arange(length), np.roll(np.arange(length), 1), np.arange(length)[::-1]]))
    cases: tuple[tuple[Trajectory, Any], ...] = ((batch, indices), (batch, length - 1), (traj, indices))
    for steps, pick in cases:
        rows = [_select(steps, i) if steps is batch else steps for i in range(3)]
        expected = [family.hindsight_task(row, int(i)) for row, i in zip(rows, np.broadcast_to(pick, 3), strict=True)]
        _require(_same(_call(vectorized, family.hindsight_task, steps, pick), expected), vectorized)
    return tasks


def _check_sparse(family: TaskFamily, traj: Trajectory, own_tasks: FloatArray) -> None:
    tasks = np.concatenate((own_tasks, family.train_tasks))
    task_rewards = family.compute_reward(traj, tasks) - traj.task_free_reward
    _require(bool(np.isfinite(task_rewards).all()), "compute_reward returned a number that is not finite for a training task.")
    failures = task_rewards[~family.is_success(traj, tasks)]
    advice = "is_success asks for too little, look at its threshold and units."
    _require(
        len(failures) > 0, f"Every step of a random episode solves every training task, so nothing can be learnt: {advice}"
    )
    more = float(np.abs(failures).max())
    leak = (
        f"The sparse reward of an unsuccessful step is not 0 (beside task_free_reward) but {more:.2g}, which leaks the task: "
    )
    _require(more <= ROUNDING, leak + "compute_reward is what the task pays plus traj.task_free_reward.")
    worth = task_rewards[np.arange(len(own_tasks)), np.arange(len(own_tasks))]
    enough = bool((worth > failures.max() + ROUNDING).all())
    _require(enough, "A step that solves its task exactly is worth no more than a failure.")
    unpaid = float((task_rewards[family.is_success(traj, tasks)] <= failures.max() + ROUNDING).mean())
    advice = "are worth no more than a failure: compute_reward must pay for each success, and is_success ask for what is paid."
    _require(unpaid <= UNPAID, f"Of the steps that solve a task, by is_success, {unpaid:.0%} {advice}")


def _check_no_leak(plain: Episode, other: Episode) -> None:
    same_ends = _same(plain.terminated, other.terminated)
    _require(same_ends, "The task leaks into the end of the episode: same seed and actions, another task, another end.")
    same_states = _same(plain.traj.observations, other.traj.observations)
    same_states = same_states and _same(plain.traj.next_observations, other.traj.next_observations)
    _require(same_states, "The task leaks into the observations: same seed and actions, another task, other observations.")
    same_free = _same(plain.traj.task_free_reward, other.traj.task_free_reward)
    advice = "_step_state returns what every task pays, and compute_reward adds what this one does."
    _require(same_free, f"info['task_free_reward'] depends on the task: {advice}")


def _check_episode(env: gym.Env[Any, Any], family: TaskFamily, seed: int) -> None:
    base: Any = env.unwrapped
    base.set_task(None)
    plain = _play(env, family, seed)
    in_range = 0 <= plain.task_id < len(family.train_tasks)
    _require(in_range, f"After set_task(None) an episode had task_id {plain.task_id}: the env must draw a training task.")
    traj = plain.traj
    again = _play(env, family, seed, family.train_tasks[plain.task_id], traj.actions)
    _require(all(map(_same, traj[:3], again.traj[:3])), NOT_REPEATABLE)
    _check_pure(family, traj)
    _check_rewards(env, family, plain, family.train_tasks[plain.task_id])
    own_tasks = _check_hindsight(family, plain)
    tasks = own_tasks[[0, len(own_tasks) // 2, -1]]
    _check_reward_types(family, traj, tasks[0])

    def dense_reward(steps: Trajectory, task: NDArray[Any]) -> FloatArray:
        return family.compute_reward(steps, task, "dense")

    _check_vectorized("compute_reward", family.compute_reward, traj, tasks)
    if _has_dense(family, traj, tasks[0]):
        _check_vectorized("compute_reward with 'dense'", dense_reward, traj, tasks)
        finite = bool(np.isfinite(dense_reward(traj, family.train_tasks)).all())
        _require(finite, "compute_reward with reward_type='dense' is not finite for a training task.")
    _check_vectorized("is_success", family.is_success, traj, tasks)
    _check_sparse(family, traj, own_tasks)

    # Random episodes rarely see a sparse reward. The same episode again under a task that it solved has one for sure.
    for task in tasks[1:]:
        solved = _play(env, family, seed, task, traj.actions)
        refused = f"reset does not honour options={{'task': vector}}: the task_id is {solved.task_id}, it must be -1."
        _require(solved.task_id == -1, refused)
        _check_no_leak(plain, solved)
        _require(solved.successes.any(), "reset does not honour options={'task': vector}: the episode does not solve it.")
        _check_rewards(env, family, solved, task)

        def use_hooks() -> None:
            base.compute_reward(traj, own_tasks)
            base.hindsight_task(traj, 0)

        disturbed = _play(env, family, seed, task, traj.actions, use_hooks)
        undisturbed = all(map(_same, (disturbed.rewards, *disturbed.traj), (solved.rewards, *solved.traj)))
        _require(undisturbed, "Calling compute_reward or hindsight_task changes the env: the same episode went otherwise.")


def _check_dependent_episode(env: gym.Env[Any, Any], family: TaskFamily, seed: int) -> None:
    """Of a MetaEnv, in which all but the first observation may depend on the task."""
    plain, other = (_play(env, family, seed, task) for task in (family.train_tasks[0], family.test_tasks[0]))
    again = _play(env, family, seed, family.train_tasks[0], plain.traj.actions)
    same = all(
        map(_same, (plain.rewards, plain.terminated, *plain.traj[:3]), (again.rewards, again.terminated, *again.traj[:3]))
    )
    _require(same, NOT_REPEATABLE)
    same_start = _same(plain.traj.observations[0], other.traj.observations[0])
    _require(same_start, "The task leaks into the first observation: same seed, another task, another one.")


def _check_task_rules(env: gym.Env[Any, Any], family: TaskFamily) -> None:
    base: Any = env.unwrapped
    n_tasks = len(family.train_tasks)
    last = n_tasks - 1

    def ids(n_resets: int = 2) -> set[int]:
        return {env.reset()[1]["task_id"] for _ in range(n_resets)}

    base.set_task(None)
    _require(len(ids(N_DRAWS)) > 1 or n_tasks == 1, "An env that was given no task must draw a new one at each reset.")
    _, info = env.reset(options={"task_id": last})
    _require(info["task_id"] == last, "reset does not honour options={'task_id': i}.")
    _require(ids() == {last}, "A task given in the options of a reset does not stay over later resets.")
    base.set_task(0)
    info = env.step(env.action_space.sample())[-1]
    _require(info["task_id"] == last, "set_task changes the task within an episode: it must wait for the next reset.")
    _require(ids() == {0}, "A task id given to set_task does not stay over later resets.")
    base.set_task(family.test_tasks[0])
    _require(ids() == {-1}, "A task vector given to set_task does not stay over later resets with task_id -1.")


def _check_bad_options(env: gym.Env[Any, Any], family: TaskFamily) -> None:
    bad: list[dict[str, Any]] = [
        {"task_id": len(family.train_tasks)},
        {"task_id": -1},
        {"task": np.full_like(family.train_tasks[0], np.nan)},
        {"task": np.append(family.train_tasks[0], 0.0)},
        {"no_such_option": 0},
    ]
    for options in bad:
        try:
            env.reset(options=options)
        except ValueError:
            continue
        except Exception as error:
            raise AssertionError(f"reset(options={options}) raised {error!r}: it must raise a ValueError.") from error
        raise AssertionError(f"reset takes options={options}: it must raise a ValueError.")


def _check_id(env: gym.Env[Any, Any], family: TaskFamily, seed: int) -> None:
    spec = copy.deepcopy(env.spec)
    assert spec is not None
    spec.additional_wrappers = ()  # they change nothing that is looked at here
    spec.kwargs.pop("render_mode", None)  # nobody looks on, and batches have none
    twin = _call("The env cannot be made a second time by its id.", gym.make, spec)
    _check_apart(env, twin, family, seed)
    twins: list[Any] = [twin.unwrapped]
    if spec.vector_entry_point is not None:
        mode = gym.VectorizeMode.VECTOR_ENTRY_POINT
        for n in (1, 2):
            make = partial(gym.make_vec, spec, n, vectorization_mode=mode)
            twins.append(_call("The batch of the id cannot be made.", make))
            _check_batch(twins[-1], twin, family, seed)
    for twin in twins:
        for name in TASK_SETS:
            told = f"Another env of the same id has other {name}: draw them with a generator whose seed is an argument."
            _require(_same(getattr(twin.task_family, name), getattr(family, name)), told)
        twin.close()


def _check_apart(env: gym.Env[Any, Any], twin: gym.Env[Any, Any], family: TaskFamily, seed: int) -> None:
    """Trainings have many in one process."""

    def step_twin() -> None:
        *_, terminated, truncated, _ = twin.step(twin.action_space.high)  # type: ignore[attr-defined]
        if terminated or truncated:
            twin.reset()

    alone = _play(env, family, seed, 0)
    twin.reset(seed=seed)
    beside = _play(env, family, seed, 0, alone.traj.actions, step_twin)
    apart = all(map(_same, alone.traj[:3], beside.traj[:3]))
    _require(apart, "Envs of this id share a state: a step of one of them moves another. Make what moves in each constructor.")


def _check_batch(batch: Any, env: gym.Env[Any, Any], family: TaskFamily, seed: int) -> None:
    """The first of its envs against a single one; what others beside it do makes no difference."""
    for name in ("observation_space", "action_space"):
        own, expected = getattr(batch, f"single_{name}"), getattr(env, name)
        _require(own == expected, f"The batch of the id has another single_{name}, {own}, than the env itself, {expected}.")
    episode = _play(env, family, seed, 0)
    options = {"task_id": np.zeros(batch.num_envs, dtype=np.int64)}
    others = [env.action_space.high] * (batch.num_envs - 1)  # type: ignore[attr-defined]

    def start(seed: int) -> Any:
        return _call("The batch of the id fails in a reset.", lambda: batch.reset(seed=seed, options=options))[0]

    observations = np.array(start(seed))
    finite = bool(np.isfinite(observations).all())
    _require(finite, "The batch of the id begins with an observation that is not finite: see its _reset_state.")
    if not _same(observations[0], episode.traj.observations[0]):
        drawn = any(not _same(observations[0], start(seed + i)[0]) for i in range(1, N_DRAWS))
        _require(
            drawn, "The batch of the id begins elsewhere than the env itself, and not by chance: each seed has this start."
        )
        return  # starts that are drawn in another way: nothing can be compared
    columns = episode.traj.next_observations, episode.rewards, episode.terminated, episode.truncated
    for step, (action, info, *values) in enumerate(zip(episode.traj.actions, episode.infos, *columns, strict=True), start=1):
        before = batch.np_random.bit_generator.state
        actions = np.stack([action, *others])
        _, rewards, terminated, truncated, infos = _call("The batch of the id fails in a step.", batch.step, actions)
        if others and not (terminated | truncated).any() and batch.np_random.bit_generator.state != before:
            return  # noise that is drawn for several: nothing can be compared
        told = {**infos, "reward": rewards, "terminated": terminated, "truncated": truncated}
        named = zip(("final_obs", "reward", "terminated", "truncated"), values, strict=True)
        for name, value in (*named, *((key, info[key]) for key in INFO_KINDS if key in info)):
            own = told[name][0] if name in told else "missing"
            _require(
                name in told and _same(own, value),
                "The batch of the id gives another episode than the env itself, from the same start: "
                f"{name} of step {step} is {own} in place of {value}.",
            )


def check_task_env(env: gym.Env[Any, Any], n_episodes: int = 3, seed: int = 0) -> None:
    """Run random episodes and fail at the first promise of a task family that the env breaks.

    The promises are those of :class:`htr_envs.TaskEnv` and :class:`htr_envs.TaskFamily`, or, where the family has no rewards,
    those of :class:`htr_envs.MetaEnv` and :class:`htr_envs.TaskDistribution`. Numbers are compared up to float32
    rounding. Run gymnasium's ``check_env`` as well: this function does not repeat it. The env is left without a given task.

    An env that was made by its id is made once more, and as a batch, where the id has one of its own.

    :param env: the env with its time limit, wrapped or not; wrappers must not change observations, actions or rewards.
    :param n_episodes: number of random episodes to check.
    :param seed: seed of the first episode.
    :raises AssertionError: with one sentence on the broken promise.
    """
    family = _check_interface(env)
    _check_family(family)
    check_episode = _check_episode if _has_reward_hooks(family) else _check_dependent_episode
    for episode in range(n_episodes):
        check_episode(env, family, seed + episode)
    _check_task_rules(env, family)
    _check_bad_options(env, family)
    if env.spec is not None:
        _check_id(env, family, seed)
    env.unwrapped.set_task(None)  # type: ignore[attr-defined]
