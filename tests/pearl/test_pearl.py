"""PEARL behaves as an SB3 algorithm: learn, callbacks, several envs, schedules, determinism, save and load."""

import inspect
import warnings
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import SubprocVecEnv
from torch.utils._python_dispatch import TorchDispatchMode

from helpers import ENV_ID, PRIOR, ROLLOUT, TINY, MakePEARL, parameters, with_policy
from helpers.experience import assert_same
from sb3_htr import PEARL, evaluate_adaptation
from sb3_htr.common.type_aliases import MultiTaskSamples
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.htr import EpisodeClustering


class Counter(BaseCallback):
    """Counts calls, and stops when told to."""

    def __init__(self, stop_after: int = 10**9) -> None:
        super().__init__()
        self.calls, self.rollouts, self.stop_after = 0, 0, stop_after

    def _on_step(self) -> bool:
        self.calls += 1
        assert {"infos", "dones", "rewards"} <= self.locals.keys()
        return self.calls < self.stop_after

    def _on_rollout_end(self) -> None:
        self.rollouts += 1


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"ent_coef": "auto"},
        {"learning_rate": lambda remaining: 1e-3 * remaining},
        {"target_update_interval": 2, "explorer": PRIOR, "train_explorer": PRIOR},
        {"train_explorer": "belief"},
        {"policy_kwargs": with_policy(normalize_observations=False)},
        {"policy_kwargs": with_policy(use_next_obs_in_context=True)},
        {"reward_coef": 0.0},
        {"n_steps": 5},
        {"final_kl_coef": 0.1, "policy_kwargs": with_policy(encoder_class="PriorFactorEncoder")},
        {"replay_buffer_kwargs": {"relabel_probability": 0.0, "rl_reward_type": "dense"}},
        {"replay_buffer_kwargs": {"relabeller": {"name": "SingleEpisodeRelabelling", "hindsight_task_strategy": "final"}}},
        {"replay_buffer_kwargs": {"relabel_probability": 1.0, "relabeller": EpisodeClustering()}},
    ],
)
def test_learn_changes_every_network(tiny_pearl: MakePEARL, kwargs: dict[str, Any]) -> None:
    model = tiny_pearl(**kwargs)
    before = parameters(model)
    model.learn(2 * ROLLOUT)
    assert model.num_timesteps == 2 * ROLLOUT
    assert model._n_updates == 2 * 3
    after = parameters(model)
    for network in ("actor.", "critic.", "critic_target.", "encoder.", "reward_model.", "knowledge."):
        assert any(not th.equal(before[name], after[name]) for name in before if name.startswith(network)), network


def test_the_actor_does_not_shape_z(tiny_pearl: MakePEARL) -> None:
    """It sees z detached: where neither critics nor reward model ask for it and the KL term is off, there is no gradient."""
    model = tiny_pearl(kl_coef=0.0, reward_coef=0.0, learning_rate=1e-3).learn(2 * ROLLOUT)
    obs_dim, latent_dim = 2, model.policy.latent_dim
    with th.no_grad():
        for network in (*model.critic.networks, *model.critic_target.networks):
            network[0].weight[:, obs_dim : obs_dim + latent_dim] = 0
    before = parameters(model)
    model._update(4)
    assert all(p.grad is not None and not p.grad.any() for p in model.encoder.parameters())
    assert all(p.grad is not None and p.grad.any() for p in (*model.actor.parameters(), *model.critic.parameters()))
    assert any(not th.equal(before[name], value) for name, value in parameters(model).items() if name.startswith("actor."))


def test_the_weight_of_the_kl_term_grows_by_the_same_factor_in_equal_times(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl(kl_coef=0.001, final_kl_coef=0.1).learn(2 * ROLLOUT)
    logged = []
    for remaining in (1.0, 0.5, 0.0):
        model._current_progress_remaining = remaining
        model.train(1)
        logged.append(model.logger.name_to_value["train/kl_coef"])
    assert logged == pytest.approx([0.001, 0.01, 0.1])


def test_critics_discount_what_follows_by_the_steps_before_it(tiny_pearl: MakePEARL, monkeypatch: Any) -> None:
    """And SB3 does not warn of a buffer that has no n-step returns, as this one has."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = tiny_pearl(n_steps=3)
    model.learn(ROLLOUT)
    assert model.replay_buffer is not None
    sample = model.replay_buffer.sample
    asked: list[dict[str, Any]] = []

    def without_what_follows(*args: Any, **sizes: Any) -> MultiTaskSamples:
        asked.append(sizes)
        data = sample(*args, **sizes)
        return data._replace(discounts=th.zeros_like(data.discounts))

    with th.no_grad():
        for parameter in model.critic_target.parameters():
            parameter.add_(1e3)
    monkeypatch.setattr(model.replay_buffer, "sample", without_what_follows)
    model.train(1)
    assert asked[0]["n_steps"] == 3 and asked[0]["gamma"] == model.gamma
    assert model.logger.name_to_value["train/critic_loss"] < 100, "no value of the target critics is in it"


def test_the_precision_of_matrix_products_is_that_of_updates_only(tiny_pearl: MakePEARL, monkeypatch: Any) -> None:
    model = tiny_pearl(matmul_precision="medium")
    seen = set()
    update = model._update

    def watched(*given: Any) -> Any:
        seen.add(th.get_float32_matmul_precision())
        return update(*given)

    monkeypatch.setattr(model, "_update", watched)
    model.learn(ROLLOUT)
    assert seen == {"medium"} and th.get_float32_matmul_precision() == "highest"


def test_an_update_waits_for_no_value(tiny_pearl: MakePEARL) -> None:
    """What a GPU computes is asked for once in ``train``, not in each update: operations that need a value on the CPU."""
    model = tiny_pearl().learn(2 * ROLLOUT)
    seen: set[str] = set()

    class Watch(TorchDispatchMode):
        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            seen.add(func.overloadpacket.__name__)
            return func(*args, **(kwargs or {}))

    with Watch():
        model._update(model.batch_size)
    assert {"native_layer_norm", "_fused_adam_", "_foreach_lerp_"} <= seen
    assert not seen & {"_local_scalar_dense", "nonzero", "masked_select", "_unique2", "equal", "is_nonzero"}
    with Watch():
        float(th.ones(1))
    assert "_local_scalar_dense" in seen


def test_sampled_actions_are_those_of_the_distribution_of_sac(tiny_pearl: MakePEARL) -> None:
    policy = tiny_pearl().policy
    obs_z = th.randn(1000, 2 + policy.latent_dim)
    actions, log_prob = policy.sample_actions(obs_z)
    mean, log_std, _ = policy.actor.get_action_dist_params(obs_z)
    distribution = SquashedDiagGaussianDistribution(2).proba_distribution(mean, log_std)
    inside = (actions.abs() < 0.99).all(dim=1)  # at the edges, tanh cannot be undone in float32
    assert inside.sum() > 500
    th.testing.assert_close(log_prob[inside], distribution.log_prob(actions)[inside], rtol=1e-3, atol=1e-3)
    th.testing.assert_close(policy._act(obs_z, deterministic=True), distribution.mode())


@pytest.mark.parametrize("n_envs", [1, 3, 5])
def test_any_number_of_envs(tiny_pearl: MakePEARL, n_envs: int) -> None:
    """4 tasks on n envs take ceil(4 / n) rounds of 3 episodes each."""
    for env in (make_task_vec_env(ENV_ID, n_envs), make_vec_env(ENV_ID, n_envs)):
        model = tiny_pearl(env)
        model.learn(1)
        assert model.num_timesteps == -(-4 // n_envs) * n_envs * 3 * 20
        assert model.replay_buffer is not None and model.replay_buffer.size() == model.num_timesteps


def test_envs_in_processes_teach_the_same(tiny_pearl: MakePEARL) -> None:
    env = make_vec_env(f"htr_envs:{ENV_ID}", 2, vec_env_cls=SubprocVecEnv)
    try:
        apart = parameters(tiny_pearl(env).learn(1))
    finally:
        env.close()
    together = parameters(tiny_pearl(make_vec_env(ENV_ID, 2)).learn(1))
    assert all(th.equal(together[name], value) for name, value in apart.items())


def test_every_training_task_has_its_turn(tiny_pearl: MakePEARL) -> None:
    """Every training task once, then every task once in another order, whatever the number of envs."""
    for n_envs in (2, 3):
        env = make_task_vec_env(ENV_ID, n_envs, env_kwargs={"n_train_tasks": 6, "n_test_tasks": 1})
        model = tiny_pearl(env, n_tasks_per_rollout=6, n_episodes_per_task=1)
        tasks: list[list[int]] = []

        def note(names: dict[str, Any], _: Any, tasks: list[list[int]] = tasks) -> bool:
            tasks.append([info["task_id"] for info in names["infos"]])
            return True

        model.learn(2 * 6 * 20, callback=note)
        # Each env stays on its task for the 20 steps of an episode
        rounds = np.array(tasks).reshape(-1, 20, n_envs)
        assert (rounds == rounds[:, :1]).all()
        first, second = rounds[:, 0].reshape(2, 6).tolist()
        assert sorted(first) == sorted(second) == list(range(6)) and first != second


def test_a_single_env_a_batch_and_an_id_are_the_same_to_pearl(tiny_pearl: MakePEARL) -> None:
    runs = [
        parameters(tiny_pearl(env, n_tasks_per_rollout=1).learn(2 * ROLLOUT))
        for env in (gym.make(ENV_ID), make_task_vec_env(ENV_ID, 1), ENV_ID)
    ]
    for run in runs[1:]:
        assert all(th.equal(run[name], runs[0][name]) for name in run)


def test_callbacks_see_every_step_and_can_stop(tiny_pearl: MakePEARL) -> None:
    counter = Counter()
    tiny_pearl().learn(2 * ROLLOUT, callback=counter)
    assert counter.calls == 2 * ROLLOUT / 4 and counter.rollouts == 2
    counter = Counter(stop_after=7)
    model = tiny_pearl().learn(10 * ROLLOUT, callback=counter)
    assert counter.calls == 7 and model.num_timesteps == 28


def test_a_training_that_was_stopped_within_an_episode_goes_on_with_whole_ones(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl().learn(ROLLOUT, callback=Counter(stop_after=7))
    model.learn(2 * ROLLOUT, reset_num_timesteps=False)
    assert model.replay_buffer is not None
    assert np.diff(model.replay_buffer.episodes.index().episode_row).tolist() == [20] * 2 * 12


def test_usual_arguments_of_learn(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    model = tiny_pearl(tensorboard_log=str(tmp_path))
    model.learn(ROLLOUT, tb_log_name="name", log_interval=1, progress_bar=True)
    model.learn(ROLLOUT, reset_num_timesteps=False, log_interval=None, tb_log_name="name")
    assert model.num_timesteps == 2 * ROLLOUT
    assert list(tmp_path.glob("name_1/events*"))
    model.learn(ROLLOUT)
    assert model.num_timesteps == ROLLOUT


def test_what_is_logged_is_the_mean_over_updates(tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    model = tiny_pearl().learn(2 * ROLLOUT)
    update, logs = model._update, list[dict[str, th.Tensor]]()

    def noting(*given: Any) -> Any:
        mean, log = update(*given)
        logs.append(log)
        return mean, log

    monkeypatch.setattr(model, "_update", noting)
    model.train(3)
    values = model.logger.name_to_value
    assert values["train/n_updates"] == 9 and len(logs) == 3 and values["train/kl_divergence"] > 0
    for key in logs[0]:
        assert values[f"train/{key}"] == pytest.approx(np.mean([log[key].item() for log in logs]), rel=1e-5), key


@pytest.mark.parametrize("cuda_graph", [False, True, None])
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_the_same_seed_gives_the_same_bits(device: str, cuda_graph: bool | None, tiny_pearl: MakePEARL) -> None:
    settings: dict[str, Any] = {"device": device, "cuda_graph": cuda_graph, "batch_size": 64}
    runs = [parameters(tiny_pearl(seed=3, **settings).learn(4 * ROLLOUT)) for _ in range(2)]
    other = parameters(tiny_pearl(seed=4, **settings).learn(4 * ROLLOUT))
    assert all(th.equal(runs[0][name], runs[1][name]) for name in runs[0])
    assert not all(th.equal(runs[0][name], other[name]) for name in other)


def test_set_random_seed_makes_what_follows_repeatable(tiny_pearl: MakePEARL) -> None:
    results = []
    for start in (0, 1):
        model = tiny_pearl(seed=start)
        model.policy.load_state_dict(tiny_pearl(seed=9).policy.state_dict())
        model.set_random_seed(5)
        results.append(parameters(model.learn(ROLLOUT)))
    assert all(th.equal(results[0][name], results[1][name]) for name in results[0])


def test_evaluation_leaves_training_alone(tiny_pearl: MakePEARL) -> None:
    """Evaluations in between must not change what is learnt."""

    class Evaluate(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls % 37 == 0:
                evaluate_adaptation(self.model, ENV_ID, np.eye(2, dtype=np.float32), n_episodes=2)  # type: ignore[arg-type]
            return True

    plain, evaluated = tiny_pearl().learn(2 * ROLLOUT), tiny_pearl().learn(2 * ROLLOUT, callback=Evaluate())
    for a, b in zip(parameters(plain).values(), parameters(evaluated).values(), strict=True):
        assert th.equal(a, b)


# --- save and load


def test_save_and_load(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    model = tiny_pearl().learn(2 * ROLLOUT)
    model.save(tmp_path / "model")
    obs, z = np.random.default_rng(0).normal(size=(7, 2)).astype(np.float32), np.ones((7, 3), dtype=np.float32)
    expected, _ = model.predict(obs, state=(z,), deterministic=True)
    evaluated = evaluate_adaptation(model, ENV_ID, "validation", n_episodes=3)
    for env in (None, make_task_vec_env(ENV_ID, 2)):
        loaded = PEARL.load(tmp_path / "model", env=env)
        actions, _ = loaded.predict(obs, state=(z,), deterministic=True)
        np.testing.assert_array_equal(actions, expected)
        for (name, a), b in zip(parameters(model).items(), parameters(loaded).values(), strict=True):
            assert th.equal(a, b), name
        for optimizer in ("actor", "critic", "encoder"):
            a, b = (getattr(m, optimizer).optimizer.state_dict()["state"] for m in (model, loaded))
            assert a.keys() == b.keys() and len(a) > 0
            assert all(th.equal(a[key]["exp_avg"], b[key]["exp_avg"]) for key in a), optimizer
        # The same evaluation too: what is known about z is saved
        np.testing.assert_array_equal(evaluate_adaptation(loaded, ENV_ID, "validation", n_episodes=3), evaluated)
    loaded.learn(ROLLOUT, reset_num_timesteps=False)
    assert loaded.num_timesteps == 3 * ROLLOUT


def test_loading_for_prediction_stores_nothing_and_an_env_can_come_later(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl().learn(ROLLOUT).save(tmp_path / "model.zip")
    loaded = PEARL.load(tmp_path / "model.zip")
    assert loaded.replay_buffer is None
    with pytest.raises(ValueError, match=r"without an env.*set_env"):
        loaded.learn()
    loaded.set_env(make_task_vec_env(ENV_ID, 4))
    loaded.learn(ROLLOUT)


@pytest.mark.parametrize("n_train_tasks", [2, 300])
def test_a_loaded_model_collects_on_tasks_of_its_new_env(tiny_pearl: MakePEARL, tmp_path: Path, n_train_tasks: int) -> None:
    tiny_pearl().learn(ROLLOUT).save(tmp_path / "model.zip")
    env = make_task_vec_env(ENV_ID, 2, env_kwargs={"n_train_tasks": n_train_tasks})
    loaded = PEARL.load(tmp_path / "model.zip", env=env)
    assert set(loaded._next_tasks(n_train_tasks)) == set(range(n_train_tasks))
    loaded.learn(ROLLOUT)


def test_the_policy_can_be_saved_alone(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    model = tiny_pearl(policy_kwargs=with_policy(use_next_obs_in_context=True)).learn(ROLLOUT)
    model.policy.save(str(tmp_path / "policy"))
    policy = type(model.policy).load(str(tmp_path / "policy"))
    obs, z = np.ones((1, 2), dtype=np.float32), np.ones((1, 3), dtype=np.float32)
    np.testing.assert_array_equal(policy.predict(obs, (z,), deterministic=True)[0], model.predict(obs, (z,), None, True)[0])


def test_the_replay_buffer_is_saved_with_what_was_learnt_of_it(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    model = tiny_pearl().learn(2 * ROLLOUT)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = PEARL.load(tmp_path / "model", env=make_task_vec_env(ENV_ID, 4))
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is not None and loaded.replay_buffer is not None
    assert loaded.replay_buffer.size() == model.replay_buffer.size() > 0
    assert model.task_bank is not None and loaded.task_bank is not None
    np.testing.assert_array_equal(loaded.task_bank.best_return, model.task_bank.best_return)
    assert_same(model.replay_buffer.sample(4), loaded.replay_buffer.sample(4))


def test_schedules_end_where_they_should(tiny_pearl: MakePEARL) -> None:
    """The last rollout goes beyond the budget; a learning rate below 0 would undo what was learnt."""
    model = tiny_pearl(ent_coef="auto", learning_rate=LinearSchedule(1e-3, 0.0, 1.0))
    model.learn(int(1.5 * ROLLOUT))
    assert model.num_timesteps == 2 * ROLLOUT
    optimizers = [network.optimizer for network in (model.actor, model.critic, model.encoder, model.reward_model)]
    for optimizer in (*optimizers, model.ent_coef_optimizer):
        # Of the updates of the last rollout, which are those of its beginning
        assert optimizer is not None and optimizer.param_groups[0]["lr"] == pytest.approx(1e-3 / 3)


@pytest.mark.parametrize("n_rollouts", [1, 2])
def test_every_rollout_is_learnt_from(n_rollouts: int) -> None:
    """With the default learning rate, which falls to 0, however short the training is."""
    settings = {key: value for key, value in TINY.items() if key != "learning_starts"}
    model = PEARL("MlpPolicy", ENV_ID, **settings)
    for _ in range(n_rollouts):
        before = parameters(model)
        model.learn(ROLLOUT, reset_num_timesteps=False)
        assert all(not th.equal(value, before[name]) for name, value in parameters(model).items() if "actor" in name)


def test_a_rollout_is_of_as_many_tasks_as_its_envs_play(tiny_pearl: MakePEARL) -> None:
    settings = {"n_tasks_per_rollout": 4, "n_episodes_per_task": 2, "gradient_steps": None, "learning_starts": None}
    model = tiny_pearl(make_task_vec_env(ENV_ID, 3), **settings)
    assert model.n_tasks_per_rollout == 4, "the setting stays, as for other envs it means another number"
    model.learn(1)
    assert model.num_timesteps == 6 * 2 * 20 == 20 * model._n_updates


# --- prediction


def test_predict_takes_and_returns_z(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    obs = np.zeros((5, 2), dtype=np.float32)
    z = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        actions, state = model.predict(obs, state=(z,), deterministic=True)
    assert actions.shape == (5, 2) and state is not None and (state[0] == z).all()
    assert len(np.unique(actions, axis=0)) == 5, "actions must depend on z"
    assert model.predict(obs[0], state=(z[:1],), deterministic=True)[0].shape == (2,)


def test_an_agent_that_is_not_adapted_warns_once(tiny_pearl: MakePEARL) -> None:
    model, env = tiny_pearl(), make_vec_env(ENV_ID)
    with pytest.warns(UserWarning, match="not adapted to any task"):
        evaluate_policy(model, env, n_eval_episodes=2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        evaluate_policy(model, env, n_eval_episodes=1)


@pytest.mark.parametrize(("n_exploration", "warns"), [(5, True), (3, True), (2, False)])
def test_rollouts_that_never_act_by_what_they_inferred_are_warned_of(
    tiny_pearl: MakePEARL, n_exploration: int, warns: bool
) -> None:
    explorer = {"name": "learned-prior", "n_exploration_episodes": n_exploration}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        tiny_pearl(n_episodes_per_task=3, train_explorer=explorer).learn(240)
        tiny_pearl(n_episodes_per_task=3, train_explorer=explorer)  # as what is loaded to adapt
        tiny_pearl(n_episodes_per_task=3, explorer=explorer).learn(240)
    texts = [str(warning.message) for warning in caught if "none will act by what was inferred" in str(warning.message)]
    assert len(texts) == warns and all("{'name': 'learned-prior', 'n_exploration_episodes': 1}" in text for text in texts)


@pytest.mark.parametrize(("radius", "warns"), [(1e-4, True), (0.6, False)])
def test_a_training_that_reached_no_training_task_says_so(tiny_pearl: MakePEARL, radius: float, warns: bool) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        tiny_pearl(make_task_vec_env(ENV_ID, 4, env_kwargs={"goal_radius": radius})).learn(2 * ROLLOUT)
    assert any("so they were not learnt: train longer than" in str(warning.message) for warning in caught) == warns


def test_a_scalar_that_is_no_index_is_no_task(tiny_pearl: MakePEARL) -> None:
    """Where a task is one number, it is natural to write it so."""
    model = tiny_pearl("SparseTargetSpeed-v0")
    scalars: list[Any] = [2.7, np.float32(1.9)]
    for task in scalars:
        with pytest.raises(ValueError, match=r"pass the index of a training task, or a task as a vector"):
            model.adapt("SparseTargetSpeed-v0", n_episodes=1, task=task)
    with pytest.warns(UserWarning, match="No reward was found"):
        model.adapt("SparseTargetSpeed-v0", n_episodes=1, task=cast(Any, np.int64(3)))


def test_every_argument_is_documented() -> None:
    for name in inspect.signature(PEARL.__init__).parameters:
        assert name == "self" or f":param {name}:" in (PEARL.__doc__ or ""), name


def test_parts_that_draw_do_so_apart_from_each_other(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl(seed=3)
    assert model.replay_buffer is not None and model.task_bank is not None and model.env is not None
    buffer = model.replay_buffer
    model.env.seed(3)
    model.env.reset()
    generators = [model._rng, model.task_bank._rng, buffer._rng, buffer.relabel_rng, model.env.get_attr("np_random")[0]]
    assert len({generator.integers(2**60) for generator in generators}) == len(generators)
