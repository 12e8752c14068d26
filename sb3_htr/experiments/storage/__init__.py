"""Where the runs of experiments are, for all nodes that run their cells."""

from sb3_htr.experiments.storage.storage import Storage, storage_at

__all__ = ["Storage", "storage_at"]
