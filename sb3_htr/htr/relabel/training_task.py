"""Relabelling under training tasks: what HFR and HIPI share."""

from abc import abstractmethod
from typing import Any

import numpy as np
import torch as th

from sb3_htr.common.settings import check_numbers
from sb3_htr.htr.relabel.base import HindsightDraw
from sb3_htr.htr.relabel.hindsight_buffers import HindsightBuffers


class TrainingTaskRelabelling(HindsightBuffers):
    """
    Episodes go to the hindsight buffers of training tasks. An episode goes to the task psi with probability

        q(psi | episode) proportional to exp(U(episode, psi) / temperature - log Z(psi)),

    where U is the utility that a subclass defines, and Z(psi) the mean of exp(U / temperature) over the episodes that have
    come in together. Without Z, an easy task would get everything.

    Relabelling is eager, as in HFR's code: once, when the first meta-batch after a rollout is drawn, with the networks as they
    are then. A relabelled row of a meta-batch is drawn as PEARL draws it, from any hindsight buffer that holds something, with
    equal chances. Hindsight buffers take as much memory as the replay.

    :param temperature: what utilities are divided by. PEARL's and HFR's code scale rewards instead, at entropy coefficient 1:
        this is the entropy coefficient that goes with unscaled rewards. 0.01, the default, is the reward scale 100 of their
        point robots, and the default of :class:`sb3_htr.PEARL`; HFR's robots have 0.2. Infinity draws tasks evenly
    :raises ValueError: if the temperature is not above 0
    """

    def __init__(self, temperature: float = 0.01) -> None:
        check_numbers(temperature=(temperature, 0.0, float("inf")))
        if temperature == 0:
            raise ValueError("temperature is 0, by which utilities cannot be divided: expected a number above 0.")
        self.temperature = temperature

    @abstractmethod
    def utilities(self, rows: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        """
        :param rows: (n, width) float32, transitions of some episodes, those of the first one first
        :param lengths: (n_episodes,) int, how many are of each
        :return: (n_episodes, n_tasks), utility of each episode for each training task
        """

    def reset(self) -> None:
        self.make_buffers(self.buffer.n_tasks)
        self._new: list[np.ndarray] = []
        # Of the episodes that came in last: mean entropy of q in nats
        self._entropy = 0.0

    def on_episode(self, task: int, episode: np.ndarray) -> None:
        self._new.append(episode.copy())

    def draw(self, tasks: np.ndarray) -> HindsightDraw:
        self._take_in()
        buffer, known = self.buffer, self.episodes.index().tasks
        # Also tasks that no episode was collected on yet, as experience may be relabelled for them before
        chosen = known[buffer.relabel_rng.integers(len(known), size=len(tasks))]
        return self.draw_from(chosen, buffer.task_family.train_tasks[chosen])

    def _take_in(self) -> None:
        """Relabel and store what has come in."""
        if not self._new:
            return
        rows, lengths = np.concatenate(self._new), np.array([len(episode) for episode in self._new])
        self._new = []
        with th.no_grad():
            logits = self.utilities(rows, lengths) / self.temperature
        tasks = self._choose(logits)
        self.buffer.write_rewards(rows, np.arange(len(rows)), self.buffer.task_family.train_tasks[np.repeat(tasks, lengths)])
        for task, episode in zip(tasks, np.split(rows, np.cumsum(lengths)[:-1]), strict=True):
            self.episodes.add(int(task), episode)

    def _choose(self, logits: np.ndarray) -> np.ndarray:
        """(n_episodes,) int, a task for each."""
        # Each task's partition function, a mean over the episodes: by how much the sum is larger is the same for all tasks
        logits = logits - np.logaddexp.reduce(logits, axis=0)
        log_q = logits - np.logaddexp.reduce(logits, axis=1, keepdims=True)
        self._entropy = float(-(np.exp(log_q) * log_q).sum(axis=1).mean())
        # The largest of logits with Gumbel noise is a draw from their softmax
        chosen: np.ndarray = (logits + self.buffer.relabel_rng.gumbel(size=logits.shape)).argmax(axis=1)
        return chosen

    def stats(self) -> dict[str, float]:
        return {**super().stats(), "replay/relabelling_entropy": self._entropy}

    def state_dict(self) -> dict[str, Any]:
        new = np.concatenate([np.zeros((0, self.buffer.transitions.width), dtype=np.float32), *self._new])
        return {
            **super().state_dict(),
            "new": th.from_numpy(new),
            "lengths": th.tensor([len(episode) for episode in self._new], dtype=th.int64),
            "entropy": self._entropy,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self._new = [episode.numpy().copy() for episode in state["new"].split(state["lengths"].tolist())]
        self._entropy = state["entropy"]
