"""Ceilings that are told the task, SAC with HER and scripts; and the floor."""

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv

from helpers import ENV_ID
from helpers.carts import make_cart
from helpers.envs import times_three
from htr_envs import DynamicsVectorEnv, PointRobotFamily
from htr_envs.point_robot import PointRobotDynamics
from sb3_htr import evaluate_adaptation
from sb3_htr.adaptation.evaluation import record_adaptation
from sb3_htr.common.vec_env import BatchedTaskVecEnv, make_task_vec_env
from sb3_htr.rivals.off_policy import replay_state
from sb3_htr.rivals.sac_her import SACHER, TaskHerReplayBuffer
from sb3_htr.rivals.scripted import ScriptedAgent
from sb3_htr.rivals.shown_task import ShownTaskVecEnv

N_STEPS = 20


class FallingDynamics(PointRobotDynamics):
    """Point robots whose episodes end to the right of the start."""

    def step(self, actions: Any) -> Any:
        states, task_free_rewards, _ = super().step(actions)
        return states, task_free_rewards, states[:, 0] > 0.1


def tiny_sac_her(env: Any = None, **kwargs: Any) -> SACHER:
    """A SACHER that trains in a moment, 80 steps a rollout."""
    env = make_task_vec_env(ENV_ID, 4, seed=0) if env is None else env
    settings = {"gradient_steps": 2, "learning_starts": 0, "batch_size": 32, "buffer_size": 4000, "seed": 0}
    return SACHER("MultiInputPolicy", env, **{**settings, "policy_kwargs": {"net_arch": [8]}, **kwargs})


def test_the_task_and_what_the_state_solves_are_shown() -> None:
    inner = make_task_vec_env(ENV_ID, 3, seed=0)
    env, rng = ShownTaskVecEnv(inner), np.random.default_rng(0)
    obs: Any = env.reset()
    before = inner.get_attr("task")
    for _ in range(N_STEPS):
        np.testing.assert_array_equal(obs["desired_goal"], before)
        np.testing.assert_allclose(obs["achieved_goal"], obs["observation"])
        obs, _, dones, infos = env.step(rng.uniform(-1, 1, (3, 2)).astype(np.float32))
    assert dones.all()
    np.testing.assert_array_equal(obs["desired_goal"], inner.get_attr("task"))
    for info, task in zip(infos, before, strict=True):
        final = info["terminal_observation"]
        np.testing.assert_array_equal(final["desired_goal"], task)
        np.testing.assert_allclose(final["achieved_goal"], info["achieved_task"], atol=1e-6)


def test_relabelled_rewards_are_those_of_the_task_family() -> None:
    model, family = tiny_sac_her().learn(400), PointRobotFamily()
    assert isinstance(model.replay_buffer, TaskHerReplayBuffer)
    data = model.replay_buffer.sample(400)
    goals, reached = (data.observations["desired_goal"].numpy(), data.next_observations["observation"].numpy())
    assert th.equal(data.observations["desired_goal"], data.next_observations["desired_goal"])
    distance = np.linalg.norm(goals - reached, axis=1)
    expected = np.where(distance < 0.2, 1 - distance, 0)
    np.testing.assert_allclose(data.rewards[:, 0].numpy(), expected, atol=1e-5)
    is_own = (np.abs(goals[:, None] - family.train_tasks).max(axis=-1) < 1e-6).any(axis=1)
    assert 0.1 < is_own.mean() < 0.3, "four of five are relabelled"
    assert (expected[~is_own] > 0).mean() > 0.1


def test_it_learns_and_is_the_same_after_save_and_load(tmp_path: Any) -> None:
    model = tiny_sac_her().learn(240)
    assert model._n_updates > 0
    model.save(tmp_path / "model")
    loaded = SACHER.load(tmp_path / "model")
    ours, theirs = (evaluate_adaptation(agent, ENV_ID, "validation", 2, seed=4) for agent in (model, loaded))
    np.testing.assert_array_equal(ours, theirs)
    with pytest.raises(ValueError, match="loaded without an env, which learning needs: pass env to load"):
        loaded.learn(80)
    loaded.set_env(make_task_vec_env(ENV_ID, 4))
    assert loaded.learn(80, reset_num_timesteps=False).num_timesteps == 320


def test_another_env_brings_its_task_family_unless_there_is_experience() -> None:
    model = tiny_sac_her()
    model.set_env(make_task_vec_env(ENV_ID, 4, seed=0, env_kwargs={"goal_radius": 0.9, "max_episode_steps": 10}))
    assert model.learn(40).num_timesteps == 40, "a rollout is an episode of each env"
    assert isinstance(model.replay_buffer, TaskHerReplayBuffer)
    data = model.replay_buffer.sample(200)
    distance = np.linalg.norm((data.observations["desired_goal"] - data.next_observations["observation"]).numpy(), axis=1)
    np.testing.assert_allclose(data.rewards[:, 0].numpy(), np.where(distance < 0.9, 1 - distance, 0), atol=1e-5)
    with pytest.raises(ValueError, match="The env has another task family: its goal_radius is"):
        model.set_env(make_task_vec_env(ENV_ID, 4))
    same = make_task_vec_env(ENV_ID, 4, seed=1, env_kwargs={"goal_radius": 0.9})
    model.set_env(same)
    assert model.learn(80).num_timesteps == 80


def test_a_deep_copy_of_a_deep_copy_learns_and_saves_its_replay(tmp_path: Any) -> None:
    twin = copy.deepcopy(copy.deepcopy(tiny_sac_her().learn(80)))
    twin.save_replay_buffer(tmp_path / "replay")
    assert twin.learn(80, reset_num_timesteps=False).num_timesteps == 160


def test_episodes_that_end_early_are_nothing_to_warn_of(recwarn: pytest.WarningsRecorder) -> None:
    """A rollout then ends within episodes."""
    model = tiny_sac_her(BatchedTaskVecEnv(DynamicsVectorEnv(PointRobotFamily(), FallingDynamics(4), max_episode_steps=20)))
    model.learn(240)
    assert not [warning for warning in recwarn if "truncated" in str(warning.message)]


def test_tasks_that_a_state_does_not_tell_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the action did is not in the observation after it."""

    def of_the_step(self: Any, traj: Any, index: Any) -> np.ndarray:
        return np.asarray((traj.observations + traj.actions)[..., index, :], dtype=np.float32)

    monkeypatch.setattr(PointRobotFamily, "hindsight_task", of_the_step)
    with pytest.raises(ValueError, match="tasks of PointRobotFamily are no functions of a state"):
        tiny_sac_her().learn(80)


def test_goals_that_their_state_does_not_solve_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def beside(self: Any, traj: Any, index: Any) -> np.ndarray:
        return np.asarray(traj.next_observations[..., index, :] + 1, dtype=np.float32)

    monkeypatch.setattr(PointRobotFamily, "hindsight_task", beside)
    with pytest.raises(ValueError, match="hindsight_task of PointRobotFamily names a task that its own step does not solve"):
        tiny_sac_her().learn(80)


def test_floor_and_ceiling_of_the_point_robot() -> None:
    """13.38 is the best return that there is, and one of a thousand random episodes solves its task."""
    space: Any = make_task_vec_env(ENV_ID).action_space
    straight = ScriptedAgent(space, lambda obs, tasks: np.clip((tasks - obs) / 0.1, -1, 1))
    returns, successes = evaluate_adaptation(straight, ENV_ID, n_episodes=2)
    assert successes.all() and 13.3 < returns.mean() < 13.4
    floor = ScriptedAgent(space)
    with pytest.raises(ValueError, match="ScriptedAgent has no explorers, but the explorer is 'belieff': leave it out"):
        floor.start_adaptation(1, "belieff")
    returns, successes = evaluate_adaptation(floor, ENV_ID, n_episodes=3)
    assert returns.mean() < 0.1 and successes.mean() < 0.02
    walks = [record_adaptation(floor, ENV_ID, n_episodes=1, seed=seed).achieved for seed in (0, 0, 1)]
    assert np.array_equal(walks[0], walks[1]) and not np.array_equal(walks[0], walks[2])


def test_a_family_without_hindsight_tasks_is_refused() -> None:
    with pytest.raises(ValueError, match="task_family has no compute_reward, which hindsight relabelling"):
        tiny_sac_her(DummyVecEnv([make_cart]))


def test_rewards_that_are_not_those_of_the_tasks_are_refused() -> None:
    with pytest.raises(ValueError, match="The env's reward_type is not 'sparse'"):
        tiny_sac_her(make_task_vec_env(ENV_ID, 2, env_kwargs={"reward_type": "dense"}))
    with pytest.raises(ValueError, match="gymnasium's RewardWrapper, which changes its rewards"):
        tiny_sac_her(gym.wrappers.TransformReward(gym.make(ENV_ID), lambda reward: 100 * float(reward)))

    class Pays(gym.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            obs, reward, *ends = self.env.step(action)
            return obs, float(reward) + 0.5, *ends

    with pytest.raises(ValueError, match=r"The env gave 0\.5 for a step of task .*, but its compute_reward gives 0"):
        tiny_sac_her(Pays(gym.make(ENV_ID))).learn(20)


class Silent(gym.Wrapper[Any, Any, Any, Any]):
    """Does not name what a step achieved."""

    def step(self, action: Any) -> Any:
        *others, info = self.env.step(action)
        return *others, {key: value for key, value in info.items() if key != "achieved_task"}


def test_an_env_need_not_name_what_a_step_achieved() -> None:
    model = tiny_sac_her(make_task_vec_env(ENV_ID, 4, wrapper=Silent)).learn(160)
    assert model.num_timesteps == 160


def test_replay_of_another_family_or_number_of_envs_is_refused_and_not_learnt_from(tmp_path: Any) -> None:
    tiny_sac_her(make_task_vec_env(ENV_ID, 4, env_kwargs={"goal_radius": 0.9})).learn(400).save_replay_buffer(tmp_path / "far")
    tiny_sac_her(make_task_vec_env(ENV_ID, 2)).learn(80).save_replay_buffer(tmp_path / "two")
    tiny_sac_her().learn(80).save_replay_buffer(tmp_path / "same")
    model = tiny_sac_her()
    before = model.replay_buffer
    for name, message in (("far", "another task family: its goal_radius"), ("two", "of 2 envs, and this model has 4")):
        with pytest.raises(ValueError, match=message):
            model.load_replay_buffer(tmp_path / name)
        assert model.replay_buffer is before
    model.load_replay_buffer(tmp_path / "same")
    assert model.replay_buffer is not before and model.learn(80).num_timesteps == 80


def test_a_replay_that_began_anew_is_saved_whole() -> None:
    """Of 50 steps of each env, after 60."""
    model, other = tiny_sac_her(buffer_size=200).learn(240), tiny_sac_her(buffer_size=200)
    other.load_state_dict(copy.deepcopy(model.state_dict()))
    ours, theirs = model.replay_buffer, other.replay_buffer
    assert isinstance(ours, TaskHerReplayBuffer) and isinstance(theirs, TaskHerReplayBuffer)
    assert ours.full and theirs.full and ours.pos == theirs.pos == 10
    arrays = replay_state(ours)["arrays"]
    assert {"observations/desired_goal", "next_observations/achieved_goal", "rewards", "ep_start", "ep_length"} < {*arrays}
    for name, array in replay_state(theirs)["arrays"].items():
        np.testing.assert_array_equal(array, arrays[name], err_msg=name)
    np.testing.assert_array_equal(theirs._current_ep_start, ours._current_ep_start)


@pytest.mark.parametrize(
    ("n_steps", "n_envs", "buffer_size", "message"),
    [
        (160, 4, 80, "has 40 steps of each of 4 envs, and the buffer is of 20 of each of 4: .*buffer_size"),
        (240, 4, 400, "has 50 steps of each of 4 envs, and the buffer is of 100 of each of 4"),  # it has begun anew
        (80, 1, 50, "has 20 steps of each of 4 envs, and the buffer is of 50 of each of 1: .*as many envs"),
    ],
)
def test_a_replay_of_another_size_is_refused(n_steps: int, n_envs: int, buffer_size: int, message: str) -> None:
    state = tiny_sac_her(buffer_size=200).learn(n_steps).state_dict()
    model = tiny_sac_her(make_task_vec_env(ENV_ID, n_envs, seed=0), buffer_size=buffer_size)
    with pytest.raises(ValueError, match=message):
        model.load_state_dict(state)
    assert model.replay_buffer is not None
    assert model.num_timesteps == 0 and model.replay_buffer.size() == 0, "nothing was taken"


def test_networks_that_do_not_fit_leave_the_replay_as_it_was() -> None:
    state = tiny_sac_her(buffer_size=200).learn(40).state_dict()
    model = tiny_sac_her(buffer_size=200, policy_kwargs={"net_arch": [7]})
    with pytest.raises(RuntimeError, match="size mismatch"):
        model.load_state_dict(state)
    assert model.replay_buffer is not None and model.replay_buffer.size() == 0


def test_a_rollout_that_ends_within_an_episode_ends_it_in_the_replay() -> None:
    env = BatchedTaskVecEnv(DynamicsVectorEnv(PointRobotFamily(), FallingDynamics(4), max_episode_steps=20))
    replay = tiny_sac_her(env).learn(480).replay_buffer
    assert isinstance(replay, TaskHerReplayBuffer) and not replay.full
    first, then = slice(0, replay.pos - 1), slice(1, replay.pos)
    is_one = replay.ep_start[first] == replay.ep_start[then]
    follows = (replay.next_observations["observation"][first] == replay.observations["observation"][then]).all(axis=-1)
    assert follows[is_one].all() and not is_one.all()


class Costly(PointRobotDynamics):
    def step(self, actions: Any) -> Any:
        states, _, ends = super().step(actions)
        return states, np.full(self.num_envs, -0.25, dtype=np.float32), ends


def test_a_relabelled_step_costs_what_it_cost() -> None:
    env = BatchedTaskVecEnv(DynamicsVectorEnv(PointRobotFamily(), Costly(4), max_episode_steps=20))
    replay = tiny_sac_her(env).learn(400).replay_buffer
    assert isinstance(replay, TaskHerReplayBuffer)
    data = replay.sample(400)
    distance = np.linalg.norm((data.observations["desired_goal"] - data.next_observations["observation"]).numpy(), axis=1)
    np.testing.assert_allclose(data.rewards[:, 0], np.where(distance < 0.2, 1 - distance, 0) - 0.25, atol=1e-5)


def test_hindsight_rewards_are_of_actions_in_the_bounds_of_the_env(monkeypatch: pytest.MonkeyPatch) -> None:
    replay = tiny_sac_her(make_task_vec_env(ENV_ID, 4, seed=0, wrapper=times_three)).learn(160).replay_buffer
    assert isinstance(replay, TaskHerReplayBuffer)
    seen: list[float] = []
    own = PointRobotFamily.compute_reward

    def noting(family: Any, traj: Any, *args: Any) -> Any:
        seen.append(float(np.abs(traj.actions).max()))
        return own(family, traj, *args)

    monkeypatch.setattr(PointRobotFamily, "compute_reward", noting)
    replay.sample(100)
    assert min(seen) > 2


def test_an_agent_that_is_told_its_task_can_sample_its_actions() -> None:
    model = tiny_sac_her(make_task_vec_env(ENV_ID, 4, seed=0))
    tasks = PointRobotFamily().test_tasks[:4]
    sampled, mean = (record_adaptation(model, ENV_ID, tasks, 1, deterministic=d).achieved for d in (False, True))
    assert not np.allclose(sampled, mean, atol=1e-2)
