"""How experience gets another task."""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import numpy as np
import torch as th

from sb3_htr.common.type_aliases import Context
from sb3_htr.htr.episode_store import EpisodeStore

if TYPE_CHECKING:
    from sb3_htr.htr.multi_task_replay_buffer import MultiTaskReplayBuffer


class AdaptingPolicy(Protocol):
    """What a relabeller may ask of networks; :class:`sb3_htr.pearl.policies.PEARLPolicy` is one."""

    @property
    def device(self) -> th.device:
        """Where the networks are."""
        ...

    def infer(self, context: Context) -> tuple[th.Tensor, th.Tensor]:
        """Mean and variance (n_tasks, latent_dim) of the posteriors over z."""
        ...

    def values(self, obs: np.ndarray, z: th.Tensor) -> th.Tensor:
        """Values (n, k) of acting with z (n, k, latent_dim) in observations (n, obs_dim)."""
        ...


class HindsightDraw(NamedTuple):
    """
    Where m rows of a meta-batch take their transitions from, and under which tasks.

    :param store: holds the transitions: the buffer's own store, or one of the relabeller's
    :param context: (m, 2) int, half-open ranges of virtual rows of the store that contexts are drawn from
    :param batch: (m, 2) int, the same for RL batches
    :param tasks: (m, task_dim) float32, the hindsight tasks
    :param is_relabelled: whether the stored rewards are those of the hindsight tasks already; if not, the buffer computes them
        for what it draws
    :param elsewhere: share of the transitions of the RL batches that are drawn from all of the replay instead, whatever their
        task; only where the buffer computes the rewards
    """

    store: EpisodeStore
    context: np.ndarray
    batch: np.ndarray
    tasks: np.ndarray
    is_relabelled: bool
    elsewhere: float = 0.0

    def check(self, m: int, task_dim: int) -> None:
        """
        :param m: number of rows that were to be relabelled
        :param task_dim: length of a task
        :raises ValueError: if it is not for so many, ranges are not within the store, tasks are not finite, or rows of
            elsewhere would keep the rewards of other tasks
        """
        if not 0 <= self.elsewhere <= 1:
            raise ValueError(f"elsewhere of a HindsightDraw is {self.elsewhere}, expected a share from 0 to 1.")
        if self.is_relabelled and self.elsewhere:
            raise ValueError(
                f"elsewhere of a HindsightDraw is {self.elsewhere}, and what is drawn there has the rewards of other tasks: "
                "expected 0, or is_relabelled=False."
            )
        n_rows = len(self.store.index().rows)
        for name, ranges in (("context", self.context), ("batch", self.batch)):
            ranges = np.asarray(ranges)
            if ranges.shape != (m, 2) or ranges.dtype.kind not in "iu":
                raise ValueError(
                    f"{name} of a HindsightDraw has shape {ranges.shape} and dtype {ranges.dtype}, expected whole numbers, "
                    f"({m}, 2)."
                )
            if not ((ranges[:, 0] >= 0) & (ranges[:, 0] < ranges[:, 1]) & (ranges[:, 1] <= n_rows)).all():
                raise ValueError(
                    f"{name} of a HindsightDraw has a range that is empty or not within the {n_rows} rows of its store."
                )
        if np.shape(self.tasks) != (m, task_dim) or not np.isfinite(self.tasks).all():
            raise ValueError(
                f"tasks of a HindsightDraw are {self.tasks!r:.200}, expected finite numbers of shape ({m}, {task_dim})."
            )


class Relabeller(ABC):
    """
    Gives experience another task: eagerly, when an episode is complete (:meth:`on_episode`), or lazily, when it is drawn
    (:meth:`draw`).

    The buffer decides *whether* a row of a meta-batch is relabelled, with probability K; a relabeller decides what such a row
    is. It owns its settings and its state. Its randomness is ``buffer.relabel_rng``, so that K = 0 changes nothing else.
    """

    buffer: "MultiTaskReplayBuffer"
    #: Networks, for strategies that ask for values of tasks
    policy: AdaptingPolicy
    #: Whether it has experience of its own, which is saved with the buffer's
    keeps_experience: ClassVar[bool] = False

    def bind(self, buffer: "MultiTaskReplayBuffer") -> None:
        """
        :param buffer: whose episodes are relabelled; called once, before the first of them
        """
        self.buffer = buffer

    def on_episode(self, task: int, episode: np.ndarray) -> None:
        """
        Called for each finished episode, after it was stored; not if K is 0.

        :param task: index of the training task that it was collected on
        :param episode: (length, width) float32, its transitions, a copy that cannot be written to; columns are those of
            ``buffer.transitions``, a :class:`sb3_htr.htr.transitions.Transitions`
        """

    @abstractmethod
    def draw(self, tasks: np.ndarray) -> HindsightDraw:
        """
        :param tasks: (m,) int, training tasks of the rows of the meta-batch that are relabelled; each has episodes
        :return: where their transitions come from
        """

    def reset(self) -> None:
        """Forget all episodes."""

    def stats(self) -> dict[str, float]:
        """
        :return: what is worth logging, by its key
        """
        return {}

    def state_dict(self) -> dict[str, Any]:
        """
        :return: tensors, numbers and strings, in dicts and lists, for :meth:`load_state_dict`; an array of numpy is refused
            when it is saved
        """
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: of :meth:`state_dict` of a relabeller with the same settings
        """
