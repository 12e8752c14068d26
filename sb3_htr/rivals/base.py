"""What the rivals share: they train on the envs of PEARL, are evaluated as PEARL is, and go on from the same checkpoints."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_htr.adaptation.callbacks import MetaEvalCallback
from sb3_htr.adaptation.loop import Adapting
from sb3_htr.common.callback import followed_by, parts_of
from sb3_htr.common.checks import (
    check_device,
    check_env_is_given,
    check_finite,
    check_has_env,
    check_is_env,
    check_is_not_normalized,
    get_task_family,
)
from sb3_htr.common.divergence import check_not_diverged
from sb3_htr.common.random_state import checked_seed
from sb3_htr.common.saving import CheckedFiles
from sb3_htr.common.settings import check_keywords, check_layers, check_mappings, check_numbers
from sb3_htr.common.training_state import Resumable
from sb3_htr.common.vec_env import N_ENVS, make_task_vec_env, set_tasks
from sb3_htr.common.vec_wrappers import in_float32, seed_envs
from sb3_htr.rivals.adaptation import OwnWay, check_explores_in_own_way

SelfRival = TypeVar("SelfRival", bound="Rival")
# Settings of SB3's algorithms and policies which these do not check: smallest and largest value
RANGES: dict[str, tuple[float] | tuple[float, float]] = {
    "learning_rate": (0.0,),
    "gamma": (0.0, 1.0),
    "tau": (0.0, 1.0),
    "gae_lambda": (0.0, 1.0),
    "clip_range": (0.0,),
    "clip_range_vf": (0.0,),
    "target_kl": (0.0,),
    "ent_coef": (0.0,),
    "vf_coef": (0.0,),
    "max_grad_norm": (0.0,),
    "batch_size": (1,),
    "buffer_size": (1,),
    "learning_starts": (0,),
    "n_epochs": (1,),
    "n_steps": (1,),
    "policy_delay": (1,),
    "target_update_interval": (1,),
    "n_critics": (1,),
    "lstm_hidden_size": (1,),
    "n_lstm_layers": (1,),
}
# Of these, 0 keeps networks from learning: target networks, that of values, or all
ABOVE_ZERO = ("tau", "clip_range_vf", "target_kl")
OF_SDE = "it is of use_sde, which is none either"


class ResetCallback(BaseCallback):
    """Resets all envs where a rollout begins, after other callbacks had a look: so that nothing of an env need be saved."""

    model: "Rival"

    def _on_rollout_start(self) -> None:
        self.model.begin_rollout()

    def _on_step(self) -> bool:
        return True


class CheckedStepsCallback(BaseCallback):
    """
    Ends a training where the env returns NaN or infinity, of which the libraries learn until all networks are NaN; and where
    it is on no training task, as an evaluation in it leaves it.
    """

    def _on_step(self) -> bool:
        for i, info in enumerate(self.locals["infos"]):
            if info.get("task_id") == -1:
                raise ValueError(
                    f"info['task_id'] of env {i} is -1, expected a training task: the env chose another task, or a callback "
                    "stepped the envs of training, as one that evaluates in them within a rollout does; give it envs of its "
                    "own."
                )
        check_finite("reward", self.locals["rewards"])
        self._check(self.locals["new_obs"])
        for env in np.flatnonzero(self.locals["dones"]):
            final = self.locals["infos"][env]["terminal_observation"]
            one = {key: value[None] for key, value in final.items()} if isinstance(final, dict) else final[None]
            self._check(one, [int(env)])
        return True

    @staticmethod
    def _check(observations: Any, envs: Sequence[int] | None = None) -> None:
        for values in observations.values() if isinstance(observations, dict) else (observations,):
            check_finite("observation", values, envs)


class Rival(CheckedFiles, Resumable):
    """
    What :class:`~sb3_htr.rivals.on_policy.OnPolicyRival` and :class:`~sb3_htr.rivals.off_policy.OffPolicyRival` share, mixins
    for algorithms of Stable-Baselines3. It is made as :class:`sb3_htr.PEARL` is: of a policy and an env of a task
    family. What the algorithm needs around the env is put there by its ``_wrap_env``, see :attr:`WRAPPERS`.

    A rollout begins with a reset of all envs, as PEARL's do, so that a training that goes on from a checkpoint is the same as
    one that was never interrupted, bit for bit.
    """

    #: Policy of a file that does not say its own
    DEFAULT_POLICY: ClassVar[str]
    #: What its ``_wrap_env`` puts around an env, to show the agent more than the env's observations. It must leave an env of
    #: this kind as it is, and widen ``terminal_observation``, too. At meta-test the env is not wrapped: what it shows more,
    #: the adaptation adds itself, from the steps that it observes
    WRAPPERS: ClassVar[tuple[type[VecEnv], ...]] = ()
    #: Settings of its policy, whole numbers, beside those of SB3 and sb3-contrib, with the largest that a file may ask for
    POLICY_SIZES: ClassVar[dict[str, int]] = {}
    #: Settings, whole numbers, that an agent which is loaded to act has of its training
    ACTS_BY: ClassVar[tuple[str, ...]] = ()
    FOLLOWS: ClassVar[dict[str, str]] = {
        "use_sde": "its noise is drawn before a rollout, and in no checkpoint",
        "sde_sample_freq": OF_SDE,
        "use_sde_at_warmup": OF_SDE,
    }
    explorer = OwnWay()

    def __init__(self, policy: Any, env: GymEnv | str | None, seed: int | None = None, **kwargs: Any) -> None:
        """
        :param policy: name or class
        :param env: env of a task family, VecEnv of such envs, or registered id
        :param seed: seed of all random generators
        :param kwargs: arguments of the library's class but those in :attr:`FOLLOWS`
        :raises ValueError: for a setting that is unknown, or an env that is missing or without tasks or time limit
        """
        if kwargs.get("_init_setup_model", True):  # as always but in load
            check_env_is_given(type(self), env)
        seed = self._check_settings(policy, seed, kwargs)
        if kwargs.get("policy_kwargs") is not None:
            # SB3 adds to it, and what was given is the caller's, and in records
            kwargs["policy_kwargs"] = dict(kwargs["policy_kwargs"])
        if isinstance(env, str):
            env = make_task_vec_env(env, N_ENVS, seed)
        super().__init__(policy=policy, env=env, seed=seed, **kwargs)

    def _check_settings(self, policy: Any, seed: int | None, settings: dict[str, Any]) -> int | None:
        """
        :param policy: name or class
        :param seed: of the model
        :param settings: that are handed on to the library
        :return: the seed
        :raises ValueError: for what the library would refuse in words of its own, or not at all
        """
        check_device(settings.get("device", "auto"))
        self.check_names(settings)
        self._check_ranges(settings)
        policy_class = self.policy_aliases.get(policy) if isinstance(policy, str) else policy
        check_mappings(policy_kwargs=settings.get("policy_kwargs"))
        of_policy = settings.get("policy_kwargs") or {}
        if policy_class is not None:
            check_keywords("policy_kwargs", of_policy, policy_class)
        self._check_ranges(of_policy)
        if (layers := of_policy.get("net_arch")) is not None:
            layers = layers if isinstance(layers, dict) else {"net_arch": layers}
            check_layers(**{str(network): units for network, units in layers.items()})
        return checked_seed(seed)

    def _check_ranges(self, settings: dict[str, Any]) -> None:
        for name, value in settings.items():
            # Schedules are the library's to read
            if name in RANGES and value is not None and not callable(value):
                check_numbers(**{name: (value, *RANGES[name])})
                if name in ABOVE_ZERO and value == 0:
                    raise ValueError(f"{name} is {value}, which keeps networks from learning: expected a number above 0.")

    def _setup_model(self) -> None:
        # Not in the constructor alone: settings can be given to load, too, in place of those of the file
        self._check_ranges(vars(self))
        super()._setup_model()

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        check_is_env(env)
        vec_env = in_float32(BaseAlgorithm._wrap_env(env, verbose, monitor_wrapper))
        check_is_not_normalized(vec_env)
        get_task_family(vec_env)
        return vec_env

    def set_random_seed(self, seed: int | None = None) -> None:
        """
        :param seed: seed of python, numpy, torch and envs
        :raises ValueError: if some generator does not take it
        """
        seed = checked_seed(seed)
        super().set_random_seed(seed)
        if self.env is not None and seed is not None:
            seed_envs(self.env, seed)

    @abstractmethod
    def _adaptation(self, n_envs: int, generator: th.Generator | None) -> Adapting:
        """An adaptation to so many tasks, side by side."""

    def start_adaptation(self, n_envs: int, explorer: Any = None, generator: th.Generator | None = None) -> Adapting:
        """
        :param n_envs: number of tasks to adapt to side by side
        :param explorer: None or ``"own"``: it explores in its own way
        :param generator: source of randomness; torch's global one by default
        :return: acts, and takes in what happens
        :raises ValueError: for an explorer, or no task; if the rival's own code makes something else than an adaptation
        """
        check_explores_in_own_way(self, explorer)
        check_numbers(n_envs=(n_envs, 1))
        adaptation = self._adaptation(n_envs, generator)
        if not isinstance(adaptation, Adapting):
            raise ValueError(
                f"_adaptation of {type(self).__name__} returned {adaptation!r}, expected act, observe, exploring and "
                "deviation: derive it from RivalAdaptation."
            )
        return adaptation

    def check_env(self, env: VecEnv) -> None:
        """
        :param env: to adapt in. It may be the one that the model was made with, where a rollout begins, which resets it; a
            rollout that was broken off ends with ValueError at its next step
        :raises ValueError: if its spaces are not those of training, it normalizes, or it is wrapped as in training, to show
            more than its observations
        """
        check_is_not_normalized(env)
        if isinstance(env, self.WRAPPERS):
            raise ValueError(
                f"This env shows more than its observations, as {type(self).__name__} sees them in training: pass another, "
                "or its id."
            )
        check_for_correct_spaces(self._wrap_env(env), self.observation_space, self.action_space)

    def predict(self, observation: Any, *args: Any, **kwargs: Any) -> Any:
        """
        As the library's, for who wraps an env as training does. In an env as it is, an adaptation acts.

        :param observation: what the wrapped env shows
        :param args: see Stable-Baselines3's
        :param kwargs: likewise
        :return: actions, and memory
        :raises ValueError: for the observation of an env that is not wrapped
        """
        space = self.observation_space
        is_dict = isinstance(space, spaces.Dict)
        if isinstance(observation, dict) != is_dict or not (is_dict or np.shape(observation)[-1:] == space.shape):
            raise ValueError(
                f"{type(self).__name__} acts on {space}, and this observation has "
                + ("names" if isinstance(observation, dict) else f"shape {np.shape(observation)}")
                + ". In an env, call evaluate_adaptation(model, env), or act and observe of model.start_adaptation(n_envs)."
            )
        return super().predict(observation, *args, **kwargs)

    def begin_rollout(self) -> None:
        """Begin new episodes in all envs, on training tasks: an evaluation may have left others."""
        assert self.env is not None
        set_tasks(self.env, None, np.arange(self.env.num_envs))
        self._last_obs = self.env.reset()  # type: ignore[assignment]
        self._last_episode_starts = np.ones(self.env.num_envs, dtype=bool)

    def learn(
        self: SelfRival,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 1,
        *args: Any,
        **kwargs: Any,
    ) -> SelfRival:
        """
        :param total_timesteps: env steps
        :param callback: called at each step
        :param log_interval: rollouts between two logs, None for no logs; those before a training was resumed count, too
        :param args: see Stable-Baselines3's
        :param kwargs: likewise
        :return: the model
        :raises ValueError: for a model that was loaded without an env, numbers out of their ranges, and SB3's EvalCallback
        """
        check_has_env(self.env)
        check_numbers(total_timesteps=(total_timesteps, 0.0))
        if log_interval is not None:
            check_numbers(log_interval=(log_interval, 1))
        self._log_interval = log_interval
        # The library counts from where a training was resumed; a rival asks :attr:`logs_now`
        return super().learn(total_timesteps, callback, 1, *args, **kwargs)  # type: ignore[safe-super]

    def train(self, *args: Any, **kwargs: Any) -> None:
        """
        As the library's, of what was collected.

        :param args: see Stable-Baselines3's
        :param kwargs: likewise
        :raises DivergedError: if a weight is not finite afterwards
        """
        try:
            super().train(*args, **kwargs)  # type: ignore[misc]
        finally:  # also where the library stumbles over such weights, in words of its own
            check_not_diverged(self.policy, {}, self._n_updates, self.num_timesteps)

    @property
    @abstractmethod
    def n_steps_per_rollout(self) -> int:
        """Env steps of all envs together."""

    @property
    def n_rollouts(self) -> int:
        """Since the beginning of the training, which may have been resumed."""
        return self.num_timesteps // self.n_steps_per_rollout

    def logs_now(self) -> bool:
        """
        :return: whether a log is due after this rollout
        """
        return self._log_interval is not None and self.n_rollouts % self._log_interval == 0

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_log_interval"]

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        result = followed_by(callback, CallbackList([CheckedStepsCallback(), ResetCallback()]))
        for part in parts_of(result):
            if not isinstance(part, EvalCallback) or isinstance(part, MetaEvalCallback):
                continue
            if part.eval_env.observation_space != self.observation_space:
                raise ValueError(
                    f"{type(self).__name__} does not act on the observations that {type(part).__name__} shows it: pass "
                    "sb3_htr.adaptation.callbacks.MetaEvalCallback in its place."
                )
        return super()._init_callback(result, progress_bar)
