"""Drawing a meta-batch: against PEARL's reference implementation, and with relabelling against without."""

from functools import partial
from typing import Any

import torch as th
from _common import Figure, by_turns, faster, make_model, seconds, write

# katerakelly/oyster, recorded: 2.5 to 3.0 ms
REFERENCE_SECONDS = 2.75e-3


def main() -> None:
    """One thread."""
    th.set_num_threads(1)
    models = {k: make_model(relabel_probability=k) for k in (0.0, 0.5, 1.0)}
    buffers = {k: model.replay_buffer for k, model in models.items() if model.replay_buffer is not None}
    sizes: dict[str, Any] = {
        "16 x (1024 + 256) rows": {"batch_size": 256, "meta_batch_size": 16, "context_size": 1024},
        "64 x (20 + 20) rows, the fast profile": {"batch_size": 20, "meta_batch_size": 64, "context_size": 20},
    }
    figures = []
    for size, kwargs in sizes.items():
        times = by_turns({str(k): partial(seconds, partial(buffer.sample, **kwargs), 100) for k, buffer in buffers.items()})
        medians = {k: float(th.tensor(times[str(k)]).median()) * 1e3 for k in buffers}
        paper = kwargs["meta_batch_size"] == 16
        plain = Figure(f"{size}, K = 0", "ms", medians[0.0])
        if paper:
            plain.reference, plain.against = REFERENCE_SECONDS * 1e3, "katerakelly/oyster, recorded"
            plain.ratio, plain.goal = REFERENCE_SECONDS * 1e3 / medians[0.0], 2.0
        figures.append(plain)
        for k in (0.5, 1.0):
            goal = 1 / 1.3 if paper and k == 1 else None
            ratio = faster(times[str(k)], times["0.0"])
            figures.append(Figure(f"{size}, K = {k:g}", "ms", medians[k], medians[0.0], ratio, goal, "K = 0"))
    write("sampling", figures)


if __name__ == "__main__":
    main()
