"""Where the time of a training goes: the fast profile on SparsePointRobot-v0, one thread."""

from collections import defaultdict
from collections.abc import Callable
from typing import Any

import torch as th
from _common import ENV_ID, write_content
from torch.profiler import ProfilerActivity, profile, record_function

from sb3_htr import PEARL
from sb3_htr.common.vec_env import make_task_vec_env

PRODUCTS = {"aten::mm", "aten::addmm", "mkldnn::_linear_pointwise"}
# What the profiler cannot see into, by the name that it gets here
PARTS = {
    "drawing meta-batches": "replay_buffer.sample",
    "storing steps": "replay_buffer.add",
    "stepping the envs": "env.step",
    "choosing actions": "policy.act",
    "best episodes of training tasks": "task_bank.update",
    "what explorers start from": "knowledge.learn",
    "Python between the operations of updates": "_update",
}


def named(function: Callable[..., Any], name: str) -> Callable[..., Any]:
    """
    :param function: to be seen by the profiler
    :param name: as what
    :return: does the same
    """

    def wrapped(*args: Any, **kwargs: Any) -> Any:
        with record_function(name):
            return function(*args, **kwargs)

    return wrapped


def main() -> None:
    """Two rollouts of 4,000 steps with their 200 updates each, after those of random actions."""
    th.set_num_threads(1)
    model = PEARL("MlpPolicy", make_task_vec_env(ENV_ID, 20, seed=0), seed=0, device="cpu").learn(8_000)
    for name, where in PARTS.items():
        *owners, attribute = where.split(".")
        owner: Any = model
        for part in owners:
            owner = getattr(owner, part)
        setattr(owner, attribute, named(getattr(owner, attribute), name))
    with profile(activities=[ProfilerActivity.CPU]) as profiler, record_function("everything else"):
        model.learn(8_000, reset_num_timesteps=False)
    shares: defaultdict[str, float] = defaultdict(float)
    for event in profiler.key_averages():
        name = event.key
        if name in PRODUCTS:
            name = "matrix products"
        elif "Backward" in name or name.startswith(("autograd::", "_Stack")):
            name = "autograd"
        elif name.startswith("Optimizer"):
            name = "Adam"
        shares[name] += event.self_cpu_time_total
    total = sum(shares.values())
    rows = sorted(((round(share / total, 4), name) for name, share in shares.items()), reverse=True)
    rows.append((round(sum(share for share, _ in rows if share < 0.01), 4), "all else"))
    write_content("profile_training", {"shares": [{"name": name, "share": share} for share, name in rows if share >= 0.01]})


if __name__ == "__main__":
    main()
