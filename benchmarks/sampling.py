"""Drawing a meta-batch: against PEARL's reference implementation, and with relabelling against without."""

from functools import partial
from typing import Any

import numpy as np
import torch as th
from _common import Figure, by_turns, faster, make_model, seconds, write

from sb3_htr.pearl.pearl import N_LABELLED

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
        draws = {f"K = {k:g}": partial(buffer.sample, **kwargs, n_labelled=N_LABELLED) for k, buffer in buffers.items()}
        plain, as_theirs = "K = 0", "K = 0, without steps for the model of rewards"
        paper = kwargs["meta_batch_size"] == 16
        if paper:
            draws[as_theirs] = partial(buffers[0.0].sample, **kwargs)
        times = by_turns({name: partial(seconds, draw, 100) for name, draw in draws.items()})
        for name, durations in times.items():
            figure = Figure(f"{size}, {name}", "ms", 1e3 * float(np.median(durations)))
            if name == as_theirs:
                figure.reference, figure.against = REFERENCE_SECONDS * 1e3, "katerakelly/oyster, recorded"
                figure.ratio, figure.goal = figure.reference / figure.ours, 2.0
            elif name != plain:
                figure.reference, figure.against = 1e3 * float(np.median(times[plain])), plain
                figure.ratio, figure.goal = faster(durations, times[plain]), 1 / 1.3 if paper and name == "K = 1" else None
            figures.append(figure)
    write("sampling", figures)


if __name__ == "__main__":
    main()
