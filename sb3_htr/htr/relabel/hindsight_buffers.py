"""What relabellers share that keep what they have relabelled: EC, HFR and HIPI."""

from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_htr.htr.episode_store import EpisodeStore
from sb3_htr.htr.relabel.base import HindsightDraw, Relabeller

if TYPE_CHECKING:
    from sb3_htr.htr.multi_task_replay_buffer import MultiTaskReplayBuffer


class HindsightBuffers(Relabeller):
    """
    Keeps relabelled episodes in hindsight buffers of its own, each of one task. A relabelled row of a meta-batch is drawn as
    PEARL draws it, from a hindsight buffer in place of the task's own. A subclass says what goes into which buffer, and which
    one a row is drawn from.
    """

    #: With the hindsight buffers in place of tasks
    episodes: EpisodeStore
    keeps_experience = True

    def bind(self, buffer: "MultiTaskReplayBuffer") -> None:
        super().bind(buffer)
        self.reset()

    def make_buffers(self, n: int) -> None:
        """
        :param n: number of hindsight buffers to begin with, empty ones
        """
        own = self.buffer.episodes
        width = self.buffer.transitions.width
        self.episodes = EpisodeStore(n, own.episodes_per_task, own.episode_length, width)

    def draw_from(self, chosen: np.ndarray, tasks: np.ndarray) -> HindsightDraw:
        """
        :param chosen: (m,) int, a hindsight buffer for each row
        :param tasks: (m, task_dim) float32, their hindsight tasks
        :return: all that the buffers hold, the latest of it for contexts
        """
        index = self.episodes.index()
        context = index.latest_episodes(chosen, self.buffer.context_episodes)
        return HindsightDraw(self.episodes, context, index.all_episodes(chosen), tasks, is_relabelled=True)

    @property
    def n_hindsight_buffers(self) -> int:
        """Number of hindsight buffers that hold something."""
        return int(np.count_nonzero(self.episodes.n_added))

    def stats(self) -> dict[str, float]:
        rewarded = [self.buffer.rewarded(episodes) for episodes in (self.buffer.episodes, self.episodes)]
        real, hindsight = (float(some.mean()) if len(some) else 0.0 for some in rewarded)
        return {
            "replay/rewarded_fraction_real": real,
            "replay/rewarded_fraction_hindsight": hindsight,
            "replay/n_hindsight_buffers": self.n_hindsight_buffers,
            "replay/hindsight_megabytes": self.episodes.nbytes / 1e6,
        }

    def state_dict(self) -> dict[str, Any]:
        return {"episodes": self.episodes.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.episodes.load_state_dict(state["episodes"])
