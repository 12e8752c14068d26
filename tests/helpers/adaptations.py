"""Adaptations to made-up rewards, of models that know made-up tasks."""

from typing import Any

import numpy as np
import torch as th

from sb3_htr import PEARL
from sb3_htr.adaptation import Adaptation, Step
from sb3_htr.adaptation.explorers import to_explorer
from sb3_htr.adaptation.knowledge import Particles
from sb3_htr.pearl.reward_model import RewardModel


class OnALine(RewardModel):
    """Tasks are places on a line, z their coordinate; a step within half a unit of its task returns ``reward``."""

    def __init__(self, reward: float = 5.0) -> None:
        super().__init__(2, 2, 3)
        self.reward = reward
        self.scale.fill_(reward)

    def task_free(self, obs: th.Tensor, action: th.Tensor, next_obs: th.Tensor) -> th.Tensor:
        return th.zeros_like(next_obs[..., 0])

    def success_logits(self, states: th.Tensor, tasks: th.Tensor) -> th.Tensor:
        return 20.0 - 40.0 * (states[..., :, None] - tasks[..., None, :]).abs()

    def success_rewards(self, states: th.Tensor, tasks: th.Tensor) -> th.Tensor:
        return th.full((*states.shape, tasks.shape[-1]), self.reward)


def know_tasks(model: PEARL, n: int = 4) -> np.ndarray:
    """
    z of the tasks 0 to n - 1 of a line, as likely as one another: acting as if it were one of them returns 5 if it is, and
    nothing otherwise. The critics expect the same everywhere.
    """
    toy = OnALine()
    toy.state_tower = toy.task_tower = _FirstColumn()
    model.policy.reward_model = toy
    for parameter in model.critic.parameters():
        th.nn.init.zeros_(parameter)
    z = th.zeros(n, model.policy.latent_dim)
    z[:, 0] = th.arange(n)
    likely = th.zeros(n)
    model.knowledge.set_particles(Particles(z, 5 * th.eye(n), 5 * th.eye(n), likely, likely == 0))
    return z.numpy()


class _FirstColumn(th.nn.Module):
    """Of a state or z."""

    def forward(self, x: th.Tensor) -> th.Tensor:
        return x[..., 0]


def begin(model: PEARL, explorer: Any, n_envs: int = 1, context_size: int = 64) -> Adaptation:
    """An adaptation, always of the same seed."""
    generator = th.Generator().manual_seed(0)
    return Adaptation(
        model.policy,
        model.knowledge,
        to_explorer(explorer),
        n_envs,
        gamma=model.gamma,
        context_size=context_size,
        generator=generator,
    )


def step(obs: Any, rewards: Any, ended: Any, actions: Any = None) -> Step:
    """One step of each env; as action, the observation, clipped. Its infos are empty."""
    obs, rewards = np.asarray(obs, dtype=np.float32), np.asarray(rewards, dtype=np.float64)
    actions = np.clip(obs, -1, 1) if actions is None else actions
    dones = np.broadcast_to(np.asarray(ended, dtype=bool), rewards.shape)
    return Step(obs, actions, rewards, obs, dones, [{}] * len(rewards))


def play(adaptation: Adaptation, rewards: list[list[float]], length: int = 3) -> list[np.ndarray]:
    """Episodes of ``length`` steps with the given return per env; the z of each episode, and of the one to come."""
    z = []
    for returns in rewards:
        adaptation.explorer.look(np.zeros((len(returns), 2), dtype=np.float32))
        z.append(adaptation.z.copy())
        for i in range(length):
            reward = np.array(returns) if i == 0 else np.zeros(len(returns))
            adaptation.observe(step(np.full((len(returns), 2), 0.1 * i), reward, i == length - 1))
    adaptation.explorer.look(np.zeros((len(returns), 2), dtype=np.float32))
    return [*z, adaptation.z.copy()]


def walk(adaptation: Adaptation, task: np.ndarray, n_episodes: int, length: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """
    Envs whose agents stand at the place that their z says, on that line: what each step's place was, and its reward, both
    (n_envs, n_episodes, length).
    """
    places, rewards = [], []
    for i in range(n_episodes * length):
        adaptation.explorer.look(np.zeros((len(task), 2), dtype=np.float32))
        place = adaptation.z[:, 0].copy()
        reward = np.where(np.abs(place - task) < 0.5, 5.0, 0.0)
        adaptation.observe(step(np.stack([place, place], axis=1), reward, (i + 1) % length == 0))
        places.append(place)
        rewards.append(reward)
    shape = (len(task), n_episodes, length)
    return np.stack(places, axis=1).reshape(shape), np.stack(rewards, axis=1).reshape(shape)
