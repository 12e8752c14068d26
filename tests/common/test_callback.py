"""A callback of a user is set up once, whatever an algorithm puts beside it."""

from typing import Any

import pytest
from stable_baselines3.common.callbacks import BaseCallback

from helpers import ENV_ID, MakePEARL
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.rivals.sac_her import SACHER


class Counting(BaseCallback):
    n_set_up = 0

    def _init_callback(self) -> None:
        self.n_set_up += 1

    def _on_step(self) -> bool:
        return False


@pytest.mark.parametrize("form", [lambda counting: counting, lambda counting: [counting]], ids=["one", "list"])
def test_callbacks_are_set_up_once(form: Any, tiny_pearl: MakePEARL) -> None:
    rival = SACHER("MultiInputPolicy", make_task_vec_env(ENV_ID, 4), policy_kwargs={"net_arch": [4]}, buffer_size=200)
    for model in (tiny_pearl(), rival):
        callback = Counting()
        model.learn(1, form(callback), progress_bar=True)
        assert callback.n_set_up == 1 and callback.n_calls == 1
    rival.learn(1, lambda *_: False)
    assert rival.num_timesteps == 4, "a function is a callback, too"
