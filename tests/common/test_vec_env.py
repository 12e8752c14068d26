"""Batched envs as SB3 wants them."""

import os
import signal
import time
from multiprocessing import current_process, get_context
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from helpers import ENV_ID
from htr_envs import DynamicsVectorEnv, PointRobotFamily, PointRobotVectorEnv, Trajectory
from htr_envs.point_robot import PointRobotDynamics
from sb3_htr.common.random_state import kept_env_states
from sb3_htr.common.vec_env import BatchedTaskVecEnv, make_task_vec_env
from sb3_htr.common.vec_wrappers import PatientResultsWriter


def test_an_id_can_name_the_module_that_registers_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = "import gymnasium\ngymnasium.register('OfMine-v0', entry_point='htr_envs:PointRobotEnv', max_episode_steps=9)\n"
    (tmp_path / "of_mine.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    assert make_task_vec_env("of_mine:OfMine-v0").num_envs == 1


def test_an_env_in_place_of_its_id_is_refused() -> None:
    for given in (gym.make(ENV_ID), lambda: gym.make(ENV_ID)):
        with pytest.raises(ValueError, match=r"env_id is .*, expected the id of a registered env"):
            make_task_vec_env(given)  # type: ignore[arg-type]


def test_options_of_a_batch_must_agree() -> None:
    env = make_task_vec_env(ENV_ID, 2)
    env.set_options([{"task_id": 1}, {}])
    with pytest.raises(ValueError, match="options with the same keys"):
        env.reset()


def test_options_that_a_batch_refused_are_not_asked_for_again() -> None:
    env = make_task_vec_env(ENV_ID, 2)
    for refused in ([{"task_id": 1}, {}], [{"task_id": 1}, {"task_id": 999}], {"tusk": 1}):
        env.set_options(refused)
        with pytest.raises(ValueError, match=r"options|out of range"):
            env.reset()
        env.reset()


def test_a_task_that_a_batch_would_not_take_is_refused() -> None:
    env = make_task_vec_env(ENV_ID, 2)
    for name in ("task", "task_id"):
        with pytest.raises(ValueError, match=f"A batch takes no {name}: call set_options, with '{name}' for each env"):
            env.set_attr(name, 3)


def test_only_same_step_autoreset_can_be_an_sb3_vec_env() -> None:
    env = gym.make_vec(ENV_ID, 2, vectorization_mode="sync")
    with pytest.raises(ValueError, match=r"expected AutoresetMode\.SAME_STEP"):
        BatchedTaskVecEnv(env)


def test_a_batch_has_the_attributes_of_single_envs() -> None:
    env = make_task_vec_env(ENV_ID, 2)
    env.set_options([{"task_id": 1}, {"task_id": 3}])
    env.reset()
    assert env.has_attr("task_id") and env.get_attr("task_id", 1) == [3] and not env.has_attr("no_such_attribute")
    assert env.has_attr("task") and len(env.get_attr("task")) == 2
    with pytest.raises(ValueError, match="One call serves the whole batch of envs, not some of them: leave indices out"):
        env.env_method("set_task", None, indices=[0])
    with pytest.raises(ValueError, match="One call serves the whole batch of envs, not some of them: leave indices out"):
        env.set_attr("any", 1, indices=[0])


def test_an_observation_stays_what_it_was() -> None:
    """Envs may write into one array at each step."""
    batch = PointRobotVectorEnv(2)
    buffer = np.zeros((2, 2), dtype=np.float32)
    reset, step = batch.reset, batch.step

    def written(result: Any) -> Any:
        buffer[:] = result[0]
        return buffer, *result[1:]

    batch.reset = lambda **kwargs: written(reset(**kwargs))  # type: ignore[method-assign]
    batch.step = lambda actions: written(step(actions))  # type: ignore[method-assign]
    env = BatchedTaskVecEnv(batch)
    seen = [env.reset(), *(env.step(np.ones((2, 2), dtype=np.float32))[0] for _ in range(2))]
    np.testing.assert_allclose(np.stack([np.asarray(obs)[0, 0] for obs in seen]), [0.0, 0.1, 0.2], atol=1e-6)


class Ends(PointRobotDynamics):
    """An episode ends where x is above 0.15."""

    def step(self, actions: Any) -> Any:
        states, rewards, _ = super().step(actions)
        return states, rewards, states[:, 0] > 0.15


def test_an_end_in_the_last_step_is_an_end() -> None:
    env = BatchedTaskVecEnv(DynamicsVectorEnv(PointRobotFamily(), Ends(2), max_episode_steps=2))
    env.reset()
    for _ in range(2):
        *_, dones, infos = env.step(np.eye(2, dtype=np.float32))
    assert dones.all() and [info["TimeLimit.truncated"] for info in infos] == [False, True]


def test_a_batch_is_as_single_envs_are_one_by_one() -> None:
    batch, single = (make_task_vec_env(ENV_ID, 2, vec_env_class=kind) for kind in (None, DummyVecEnv))
    for env in (batch, single):
        with pytest.raises(ResetNeeded):
            env.get_attr("task")
        env.env_method("set_task", 7)
        env.reset()
        env.env_method("set_task", None)
        for _ in range(20):
            *_, dones, _ = env.step(np.zeros((2, 2), dtype=np.float32))
        assert dones.all() and [info["task_id"] for info in env.unwrapped.reset_infos] == env.get_attr("task_id")
    for name in ("train_tasks", "validation_tasks", "test_tasks", "task_space", "action_space", "observation_space"):
        np.testing.assert_equal(batch.get_attr(name), single.get_attr(name))


@pytest.mark.parametrize("task", [np.array([1, 0]), [0, 1], (0.5, -0.5)])
def test_a_vector_is_one_task_for_all_envs_also_of_a_batch(task: Any) -> None:
    """It is as long as there are envs, and could be an index for each."""
    for kind in (None, DummyVecEnv):
        env = make_task_vec_env(ENV_ID, 2, vec_env_class=kind)
        env.env_method("set_task", task)
        env.reset()
        assert env.get_attr("task_id") == [-1, -1]
        np.testing.assert_array_equal(env.get_attr("task"), np.array([task, task], dtype=np.float32))
        with pytest.raises(ValueError, match="The task has shape"):
            env.env_method("set_task", [1, 0, 0])


@pytest.mark.parametrize("reward_type", ["sparse", "dense"])
def test_a_batch_has_the_reward_hooks_of_single_envs(reward_type: str) -> None:
    batch, single = (
        make_task_vec_env(ENV_ID, 2, env_kwargs={"reward_type": reward_type}, vec_env_class=kind)
        for kind in (None, DummyVecEnv)
    )
    obs, actions, next_obs = np.random.default_rng(0).uniform(-0.2, 0.2, (3, 5, 2)).astype(np.float32)
    traj = Trajectory(obs, actions, next_obs, np.zeros(5, dtype=np.float32))
    calls: list[tuple[str, Any]] = [
        ("compute_reward", (traj, [0.1, 0.0])),
        ("compute_reward", (traj, [0.1, 0.0], "dense")),
        ("hindsight_task", (traj, 0)),
        ("hindsight_task", (traj, [0, 3])),
    ]
    for name, arguments in calls:
        of_batch, of_single = (env.env_method(name, *arguments) for env in (batch, single))
        np.testing.assert_array_equal(of_batch, of_single)


def test_a_batch_that_is_given_a_space_keeps_it() -> None:
    env, space = make_task_vec_env(ENV_ID, 2), gym.spaces.Box(-20.0, 20.0, (2,), np.float32)
    env.set_attr("observation_space", space)
    assert env.get_attr("observation_space") == [space, space]


def test_ctrl_c_leaves_envs_in_processes_to_the_training() -> None:
    """A terminal sends it to all processes."""
    env = make_task_vec_env(ENV_ID, 1, vec_env_class=SubprocVecEnv)
    env.reset()
    processes = env.unwrapped.processes  # type: ignore[attr-defined]
    for process in processes:
        os.kill(process.pid, signal.SIGINT)
    time.sleep(0.5)
    env.step(np.zeros((1, 2), dtype=np.float32))
    env.close()
    assert all(process.exitcode == 0 for process in processes)


def test_an_interrupt_amid_a_step_of_envs_in_processes_stays_one() -> None:
    """The generators of envs are asked for and set through the pipe that the answer to the step comes through."""
    env = make_task_vec_env(ENV_ID, 2, vec_env_class=SubprocVecEnv)
    env.reset()
    with pytest.raises(KeyboardInterrupt), kept_env_states(env):
        env.step_async(np.zeros((2, 2), dtype=np.float32))
        raise KeyboardInterrupt
    env.close()


LEFT_OPEN: list[Any] = []


class ForkedVecEnv(SubprocVecEnv):
    def __init__(self, env_fns: list[Any]) -> None:
        super().__init__(env_fns, start_method="fork")


@pytest.mark.parametrize("exitcode", [0, 1])
def test_a_process_ends_that_leaves_envs_open(exitcode: int) -> None:
    def leave_open() -> None:
        env = make_task_vec_env(ENV_ID, 2, vec_env_class=ForkedVecEnv)
        LEFT_OPEN.append(env)
        env.reset()
        for process in env.unwrapped.processes:  # type: ignore[attr-defined]
            os.kill(process.pid, signal.SIGTERM)  # as a scheduler sends to all
        time.sleep(0.5)
        env.step(np.zeros((2, 2), dtype=np.float32))
        if exitcode:
            env.step_async(np.zeros((2, 2), dtype=np.float32))
            raise KeyboardInterrupt

    process = get_context("fork").Process(target=leave_open)
    process.start()
    process.join(30)
    process.kill()
    assert process.exitcode == exitcode


def test_an_env_that_cannot_be_made_in_a_process_is_told_of() -> None:
    with pytest.raises(RuntimeError, match=f"The process of an env died as {ENV_ID} was made in it: its own traceback"):
        make_task_vec_env(ENV_ID, 1, env_kwargs={"goal": 1}, vec_env_class=SubprocVecEnv)


@pytest.mark.parametrize("how", ["fails", "interrupts"])
def test_a_process_ends_that_could_make_some_of_its_envs_alone(how: str) -> None:
    def make(env: gym.Env) -> gym.Env:
        if current_process().name.endswith(":1"):
            time.sleep(0.5)  # as the other one is made
            if how == "fails":
                raise MemoryError
            os.kill(os.getppid(), signal.SIGINT)
            time.sleep(60)
        return env

    def make_two() -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # which tests in the background do not have
        make_task_vec_env(ENV_ID, 2, wrapper=make, vec_env_class=ForkedVecEnv)

    process = get_context("fork").Process(target=make_two)
    process.start()
    process.join(30)
    process.kill()
    assert process.exitcode == 1


def test_runs_of_consecutive_seeds_share_no_env() -> None:
    """By SB3, number i has the seed ``seed + i``."""
    draws = []
    for seed in (0, 1):
        env, again = (make_task_vec_env(ENV_ID, 5, seed=seed, vec_env_class=DummyVecEnv) for _ in range(2))
        env.reset(), again.reset()
        of_run, of_repetition = ([rng.integers(2**31) for rng in e.get_attr("np_random")] for e in (env, again))
        assert of_run == of_repetition
        draws += of_run
    assert len(set(draws)) == 10


def test_envs_that_draw_are_stepped_one_by_one() -> None:
    env = make_task_vec_env(ENV_ID, 2, env_kwargs={"render_mode": "rgb_array"})
    env.reset()
    picture = env.get_images()[1]
    assert not isinstance(env.unwrapped, BatchedTaskVecEnv) and picture is not None and picture.shape[-1] == 3


def test_a_folder_of_episodes_keeps_those_of_before(tmp_path: Path) -> None:
    """Also where one file of several was removed."""
    for _ in range(3):
        make_task_vec_env(ENV_ID, 1, monitor_dir=str(tmp_path)).close()
    (tmp_path / "0.monitor.csv").unlink()
    before = (tmp_path / "1.monitor.csv").read_text()
    make_task_vec_env(ENV_ID, 1, monitor_dir=str(tmp_path)).close()
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{i}.monitor.csv" for i in range(3)]
    assert (tmp_path / "1.monitor.csv").read_text() == before


def test_trainings_that_begin_at_once_in_one_folder_have_files_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def begin(*args: Any) -> PatientResultsWriter:
        """While another one begins."""
        monkeypatch.undo()
        make_task_vec_env(ENV_ID, 1, monitor_dir=str(tmp_path)).close()
        return PatientResultsWriter(*args)

    monkeypatch.setattr("sb3_htr.common.vec_env.PatientResultsWriter", begin)
    make_task_vec_env(ENV_ID, 1, monitor_dir=str(tmp_path)).close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.monitor.csv", "1.monitor.csv"]
