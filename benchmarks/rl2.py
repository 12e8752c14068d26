"""RL2's policy, which goes through a trial in one call of the LSTM, against sb3-contrib's, which steps through it."""

from functools import partial
from typing import Any

import numpy as np
import torch as th
from _common import ENV_ID, Figure, by_turns, faster, seconds, write
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy

from sb3_htr.rivals.rl2 import N_TRIALS_PER_BATCH, RL2


def main() -> None:
    """One thread; a minibatch forwards and backwards, as an update of RL2 does it."""
    th.set_num_threads(1)
    kwargs: dict[str, Any] = {"env": ENV_ID, "n_trials_per_rollout": 1, "n_epochs": 1, "seed": 0}
    model = RL2("MlpLstmPolicy", **kwargs)
    spaces = model.observation_space, model.action_space
    library = RecurrentActorCriticPolicy(*spaces, model.lr_schedule, use_sde=False, **model.policy_kwargs)
    model.learn(1)
    data: Any = next(model.rollout_buffer.get(model.batch_size))

    def forward_and_backward(policy: RecurrentActorCriticPolicy) -> None:
        values, log_prob, _ = policy.evaluate_actions(data.observations, data.actions, data.lstm_states, data.episode_starts)
        (values.mean() + log_prob.mean()).backward()

    policies = {"ours": model.policy, "theirs": library}
    times = by_turns({key: partial(seconds, partial(forward_and_backward, policy), 5) for key, policy in policies.items()})
    ours, theirs = (1 / float(np.median(times[key])) for key in policies)
    name, ratio = f"{N_TRIALS_PER_BATCH} trials, {model.batch_size} steps", faster(times["ours"], times["theirs"])
    write("rl2", [Figure(name, "minibatches/s", ours, theirs, ratio, None, "sb3-contrib's policy")])


if __name__ == "__main__":
    main()
