"""Where others add something of their own: a toy one of each kind, from outside of the package, in a few lines."""

import inspect
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch as th
import yaml
from gymnasium import spaces
from torch import nn
from torch.nn import functional as F

from helpers import ENV_ID, ROLLOUT, TINY, MakePEARL, parameters, with_policy
from helpers.experience import by_task
from helpers.runs import run_folder, train_arguments
from htr_envs import Dynamics, DynamicsEnv, DynamicsVectorEnv, TaskFamily, at_step, check_reward_type, check_task_env
from sb3_htr import PEARL, evaluate_adaptation, load_untrusted
from sb3_htr.adaptation import Explorer, Step, register_explorer
from sb3_htr.adaptation.explorers import EXPLORERS, to_explorer
from sb3_htr.common.segments import segment_sum
from sb3_htr.common.vec_env import BatchedTaskVecEnv, make_task_vec_env
from sb3_htr.experiments import grid
from sb3_htr.htr import Relabeller, register_relabeller
from sb3_htr.htr.relabel import RELABELLERS, HindsightDraw
from sb3_htr.pearl import register_encoder
from sb3_htr.pearl.encoder import ENCODERS, ContextEncoder
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.run import method
from sb3_htr.zoo.run.agents import agent_at
from sb3_htr.zoo.run.algorithm import ALGORITHMS
from sb3_htr.zoo.run.record import RECORD
from sb3_htr.zoo.run.shipped import hyperparams_file

# Annotations here are wide on purpose: these are somebody's own few lines.


class RandomTrainingTask(Relabeller):
    """A task's own episodes, under any training task but one."""

    def __init__(self, never: int = -1) -> None:
        self.never, self.n_episodes = never, 0

    def on_episode(self, task: int, episode: Any) -> None:
        self.n_episodes += 1

    def draw(self, tasks: Any) -> HindsightDraw:
        buffer = self.buffer
        index, train = buffer.episodes.index(), buffer.task_family.train_tasks
        allowed = np.delete(np.arange(len(train)), self.never) if self.never >= 0 else np.arange(len(train))
        chosen = train[buffer.relabel_rng.choice(allowed, len(tasks))]
        context = index.latest_episodes(tasks, buffer.context_episodes)
        return HindsightDraw(buffer.episodes, context, index.all_episodes(tasks), chosen, is_relabelled=False)

    def stats(self) -> dict[str, float]:
        return {"replay/n_seen": self.n_episodes}

    def state_dict(self) -> dict[str, Any]:
        return {"n_episodes": self.n_episodes}

    def load_state_dict(self, state: Any) -> None:
        self.n_episodes = state["n_episodes"]


@dataclass
class Lattice(Explorer):
    """z from a lattice, one point after the other, until an episode is rewarded; then what was best."""

    width: float = 1.0

    def start(self) -> None:
        n_envs, latent_dim = self.adaptation.n_envs, self.adaptation.policy.latent_dim
        places = np.array([-self.width, 0.0, self.width], dtype=np.float32)
        self.points = np.stack(np.meshgrid(*[places] * latent_dim), axis=-1).reshape(-1, latent_dim)
        self.z = np.tile(self.points[0], (n_envs, 1))
        self.best = np.zeros(n_envs)

    def observe(self, step: Step) -> None:
        for env in np.flatnonzero(step.dones):
            if self.adaptation.episode_return[env] > self.best[env]:
                self.best[env] = self.adaptation.episode_return[env]
                self.adaptation.infer(np.array([env]), keep=False)
            elif self.best[env] == 0:
                self.z[env] = self.points[self.adaptation.n_episodes[env] % len(self.points)]

    def exploring(self) -> Any:
        return self.best == 0


class GRUEncoder(nn.Module):
    """Reads the context in the order of time. Its state is how many rows it has read, and what it remembers of them."""

    optimizer: th.optim.Optimizer

    def __init__(self, context_dim: int, latent_dim: int, net_arch: list[int], activation_fn: Any = nn.ReLU) -> None:
        super().__init__()
        self.hidden = net_arch[0]
        self.gru = nn.GRU(context_dim, self.hidden, batch_first=True)
        self.head = nn.Linear(self.hidden, 2 * latent_dim)

    def empty(self, n_tasks: int) -> th.Tensor:
        return self.head.weight.new_zeros(n_tasks, 1 + self.hidden)

    def extend(self, state: th.Tensor, rows: th.Tensor, lengths: th.Tensor) -> th.Tensor:
        read = state[:, :1] + lengths[:, None]
        remembered = [
            self.gru(task[None], before[None, None])[1][0, 0] if len(task) else before
            for task, before in zip(rows.split(lengths.tolist()), state[:, 1:].contiguous(), strict=True)
        ]
        return th.cat([read, th.stack(remembered)], dim=1)

    def posterior(self, state: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        mean, raw = self.head(state[:, 1:]).chunk(2, dim=-1)
        nothing = state[:, :1] == 0
        return mean.masked_fill(nothing, 0.0), (F.softplus(raw) + 1e-3).masked_fill(nothing, 1.0)


class Forgetful(ContextEncoder):
    """With dropout, which is for learning alone."""

    def extend(self, state: th.Tensor, rows: th.Tensor, lengths: th.Tensor) -> th.Tensor:
        return super().extend(state, F.dropout(rows, 0.3, self.training), lengths)


class DecodingEncoder(ContextEncoder):
    """With a network that tells from z how much of a context was rewarded."""

    def __init__(self, context_dim: int, latent_dim: int, *args: Any, **kwargs: Any) -> None:
        super().__init__(context_dim, latent_dim, *args, **kwargs)
        self.decoder = nn.Linear(latent_dim, 1)


class DecodingPEARL(PEARL):
    def auxiliary_losses(self, data: Any, obs: th.Tensor, z: th.Tensor, *posterior: th.Tensor) -> dict[str, th.Tensor]:
        rewarded = segment_sum((data.context.rewards > 0).float(), data.context.lengths) / data.context.lengths
        loss = ((self.encoder.decoder(z)[:, 0] - rewarded).square() * data.task_weights).sum()  # type: ignore[operator]
        return {**super().auxiliary_losses(data, obs, z, *posterior), "decoder_loss": loss}


class Heights(TaskFamily):
    """Hold a height."""

    def __init__(self) -> None:
        heights = np.random.RandomState(0).uniform(0.3, 2.0, (60, 1)).astype(np.float32)
        super().__init__(spaces.Box(-9.0, 9.0, (1,), np.float32), heights[:40], heights[40:50], heights[50:])

    def sample_tasks(self, n: int, rng: Any) -> Any:
        return rng.uniform(0.3, 2.0, (n, 1)).astype(np.float32)

    def distance(self, traj: Any, task: Any) -> Any:
        return np.abs(traj.next_observations[..., 0] - np.asarray(task, np.float32)[..., None, 0])

    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        check_reward_type(reward_type)
        distance = self.distance(traj, task)
        goal = -distance if reward_type == "dense" else np.where(distance < 0.1, 1 - distance, np.float32(0))
        return (goal + traj.task_free_reward).astype(np.float32)

    def is_success(self, traj: Any, task: Any) -> Any:
        return self.distance(traj, task) < 0.1

    def hindsight_task(self, traj: Any, index: Any) -> Any:
        return at_step(traj.next_observations, index)[..., :1]


class Balloons(Dynamics[Heights]):
    """Rise and sink, against the wind."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs, spaces.Box(-9.0, 9.0, (1,), np.float32), spaces.Box(-1.0, 1.0, (1,), np.float32))
        self.states = np.zeros((num_envs, 1), dtype=np.float32)

    def reset(self, indices: Any, rng: Any) -> Any:
        self.states[indices] = rng.uniform(-0.05, 0.05, (len(indices), 1))
        return self.states[indices]

    def step(self, actions: Any) -> Any:
        lift = np.clip(actions, -1.0, 1.0)
        self.states = np.clip(self.states + np.float32(0.15) * lift - np.float32(0.02), -9.0, 9.0)
        return self.states, np.float32(-0.01) * lift[:, 0] ** 2, np.zeros(self.num_envs, dtype=np.bool_)


TOYS = [(RandomTrainingTask,), (Lattice,), (GRUEncoder,), (DecodingEncoder, DecodingPEARL), (Heights, Balloons)]


@pytest.mark.parametrize("toy", TOYS, ids=lambda toy: toy[0].__name__)
def test_it_takes_less_than_40_lines(toy: tuple[type, ...]) -> None:
    assert sum(bool(line.strip()) for part in toy for line in inspect.getsource(part).splitlines()) < 40


def z_acted_with(model: PEARL, monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """Of everything that the model does from now on."""
    seen: list[np.ndarray] = []
    act = model.policy.act

    def noting(obs: np.ndarray, z: np.ndarray, deterministic: bool = False) -> np.ndarray:
        seen.append(z.copy())
        return act(obs, z, deterministic)

    monkeypatch.setattr(model.policy, "act", noting)
    return seen


# --- a relabeller


@pytest.mark.parametrize("by_name", [False, True])
def test_a_relabeller(tiny_pearl: MakePEARL, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, by_name: bool) -> None:
    """As an object; or by a name, as YAML files have it."""
    monkeypatch.setitem(RELABELLERS, "RandomTrainingTask", RandomTrainingTask)
    relabeller: Any = {"name": "RandomTrainingTask", "never": 3} if by_name else RandomTrainingTask(never=3)
    settings = {"replay_buffer_kwargs": {"relabel_probability": 1.0, "relabeller": relabeller}}
    env_kwargs = {"goal_distance": 0.2, "n_train_tasks": 8}
    model = tiny_pearl(make_task_vec_env(ENV_ID, 4, env_kwargs=env_kwargs), **settings).learn(3 * ROLLOUT, log_interval=None)
    buffer = model.replay_buffer
    assert buffer is not None and isinstance(buffer.relabeller, RandomTrainingTask)
    assert buffer.relabeller.policy is model.policy, "for strategies that ask for values"
    assert model.logger.name_to_value["replay/n_seen"] == buffer.relabeller.n_episodes == 36
    # Each row has the rewards of one training task, whatever its own is, and never those of the one that is left out
    data = buffer.sample(16, meta_batch_size=200)
    assert data.relabelled.all()
    family, columns = buffer.task_family, (by_task(x, data.lengths) for x in (data.next_observations, data.rewards))
    named = np.zeros(8, dtype=int)
    for place, reward in zip(*columns, strict=True):
        distance = np.linalg.norm(place[:, None] - family.train_tasks, axis=-1)
        matches = np.isclose(np.where(distance < 0.2, 1 - distance, 0), reward[:, None], atol=1e-5).all(axis=0)
        assert matches.any()
        if matches.sum() == 1:
            named[matches.argmax()] += 1
    assert named[3] == 0 and (np.delete(named, 3) > 0).sum() > 4
    # Its state is saved with the replay
    model.save_replay_buffer(tmp_path / "replay")
    other = tiny_pearl(make_task_vec_env(ENV_ID, 4, env_kwargs=env_kwargs), **settings)
    other.load_replay_buffer(tmp_path / "replay")
    assert other.replay_buffer is not None and isinstance(other.replay_buffer.relabeller, RandomTrainingTask)
    assert other.replay_buffer.relabeller.n_episodes == 36
    returns, _ = evaluate_adaptation(model, ENV_ID, n_episodes=2)
    assert np.isfinite(returns).all()


# --- an explorer


def test_an_explorer(tiny_pearl: MakePEARL, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = tiny_pearl(explorer=Lattice(width=2.0), train_explorer=Lattice())
    seen = z_acted_with(model, monkeypatch)
    model.learn(2 * ROLLOUT)
    visited = np.unique(np.concatenate(seen), axis=0)
    assert visited.tolist() == [[-1, -1, -1], [-1, -1, 0], [-1, -1, 1]], "one of 27 points in each episode"
    seen.clear()
    expected = evaluate_adaptation(model, ENV_ID, "validation", n_episodes=5)
    assert set(np.concatenate(seen).ravel()) <= {-2.0, 0.0, 2.0} and len(np.unique(np.concatenate(seen), axis=0)) == 5
    agent = model.adapt(ENV_ID, n_episodes=2, task=np.zeros(2))
    np.testing.assert_array_equal(agent.z, [-2.0, -2.0, -2.0], err_msg="the start solves it, and the first z was best")
    # It is saved with the model, and can be given to another
    model.save(tmp_path / "model")
    loaded = PEARL.load(tmp_path / "model")
    assert loaded.explorer == Lattice(width=2.0) and loaded.explorer.name == "lattice"
    other, learnt = tiny_pearl(), dict[str, Any](model.get_parameters())
    other.set_parameters(learnt)
    for results in (
        evaluate_adaptation(loaded, ENV_ID, "validation", n_episodes=5),
        evaluate_adaptation(other, ENV_ID, "validation", 5, Lattice(2.0)),
    ):
        for ours, theirs in zip(results, expected, strict=True):
            np.testing.assert_array_equal(ours, theirs)


# --- an encoder


def test_what_an_encoder_does_in_training_alone_is_not_done_at_meta_test(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl(policy_kwargs=with_policy(encoder_class=Forgetful)).learn(2 * ROLLOUT)
    model.policy.set_training_mode(True)
    before = th.get_rng_state()
    explorer = {"name": "prior", "n_exploration_episodes": 1}
    records = [evaluate_adaptation(model, ENV_ID, "validation", n_episodes=3, explorer=explorer) for _ in range(2)]
    np.testing.assert_array_equal(records[0], records[1])
    assert th.equal(before, th.get_rng_state())

    class Watched(Forgetful):
        def extend(self, state: th.Tensor, rows: th.Tensor, lengths: th.Tensor) -> th.Tensor:
            seen.append(self.training)
            return super().extend(state, rows, lengths)

    seen: list[bool] = []
    model = tiny_pearl(policy_kwargs=with_policy(encoder_class=Watched))
    learnt, model.knowledge.learn = model.knowledge.learn, lambda *args: (seen.clear(), learnt(*args))  # type: ignore
    model.learn(2 * ROLLOUT)
    assert seen and not any(seen), "nor where particles are inferred"


def test_an_encoder(tiny_pearl: MakePEARL, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = tiny_pearl(policy_kwargs=with_policy(encoder_class=GRUEncoder), explorer="aggregate", gradient_steps=10)
    before = parameters(model)
    model.learn(3 * ROLLOUT)
    assert isinstance(model.policy.encoder, GRUEncoder)
    learnt = [name for name, value in parameters(model).items() if not th.equal(value, before[name])]
    assert {"encoder.gru.weight_hh_l0", "encoder.head.weight"} <= set(learnt)
    # The posterior that is acted with is that of this encoder, for which the order of steps matters
    assert model.replay_buffer is not None
    context = model.replay_buffer.sample(4, meta_batch_size=1, context_size=20).context
    backwards = context._replace(observations=context.observations.flip(0), actions=context.actions.flip(0))
    with th.no_grad():
        assert not th.allclose(model.policy.infer(context)[0], model.policy.infer(backwards)[0])
    seen = z_acted_with(model, monkeypatch)
    monkeypatch.setattr(
        GRUEncoder, "posterior", lambda self, state: (th.full((len(state), 3), 7.0), th.full((len(state), 3), 1e-12))
    )
    evaluate_adaptation(model, ENV_ID, np.zeros((1, 2), np.float32), n_episodes=2)
    np.testing.assert_allclose(seen[-1], 7.0, atol=1e-4)
    monkeypatch.undo()
    model.save(tmp_path / "model")
    loaded = PEARL.load(tmp_path / "model")
    ours, theirs = (evaluate_adaptation(each, ENV_ID, "validation", n_episodes=3) for each in (model, loaded))
    np.testing.assert_array_equal(ours, theirs)


def test_what_a_recurrent_encoder_takes_in_later_is_taken_in_as_if_at_once(tiny_pearl: MakePEARL) -> None:
    encoder = GRUEncoder(5, 3, [16])
    rows, lengths = th.randn(12, 5), th.tensor([4, 0, 8])
    early, late = th.cat([rows[:1], rows[4:7]]), th.cat([rows[1:4], rows[7:]])
    state = encoder.extend(encoder.extend(encoder.empty(3), early, th.tensor([1, 0, 3])), late, th.tensor([3, 0, 5]))
    th.testing.assert_close(state, encoder.extend(encoder.empty(3), rows, lengths))
    mean, variance = encoder.posterior(state)
    assert (mean[1] == 0).all() and (variance[1] == 1).all()


# --- a loss


@pytest.mark.parametrize("cuda_graph", [False, True])
def test_a_loss(tmp_path: Path, cuda_graph: bool) -> None:
    """Its networks learn, the encoder learns from it, and both are saved."""
    networks = with_policy(encoder_class=DecodingEncoder)
    settings = {**TINY, "policy_kwargs": networks, "cuda_graph": cuda_graph, "seed": 3}
    model, plain = (kind("MlpPolicy", ENV_ID, **settings) for kind in (DecodingPEARL, PEARL))
    before = parameters(model)
    for each in (model, plain):
        each.learn(3 * ROLLOUT)
    after, without = parameters(model), parameters(plain)
    assert "train/decoder_loss" not in plain.logger.name_to_value
    assert 0 < model.logger.name_to_value["train/decoder_loss"] < np.inf
    assert not th.equal(after["encoder.decoder.weight"], before["encoder.decoder.weight"])
    assert th.equal(without["encoder.decoder.weight"], before["encoder.decoder.weight"])
    assert not th.equal(after["encoder.factors.0.weight"], without["encoder.factors.0.weight"])
    model.save(tmp_path / "model")
    loaded = DecodingPEARL.load(tmp_path / "model")
    assert all(th.equal(value, after[name]) for name, value in parameters(loaded).items())
    loaded.set_env(model.get_env())  # type: ignore[arg-type]
    loaded.learn(ROLLOUT, reset_num_timesteps=False)
    assert "train/decoder_loss" in loaded.logger.name_to_value


def test_a_loss_has_a_name_of_its_own() -> None:
    """Whatever a training logs, but for what the method itself returns."""

    class Nameless(PEARL):
        taken = ""

        def auxiliary_losses(self, data: Any, obs: th.Tensor, z: th.Tensor, *posterior: th.Tensor) -> dict[str, th.Tensor]:
            own = super().auxiliary_losses(data, obs, z, *posterior)
            return own | ({self.taken: z.square().mean()} if self.taken else {})

    model = Nameless("MlpPolicy", ENV_ID, **TINY).learn(2 * ROLLOUT)
    logged = {name.removeprefix("train/") for name in model.logger.name_to_value if name.startswith("train/")}
    names = logged - {"success_loss", "reward_loss", "task_free_loss"}
    assert {"critic_loss", "relabelled_fraction", "learning_rate"} < names
    for name in names:
        model.taken = name
        with pytest.raises(ValueError, match=f"auxiliary_losses has a loss named {name}, which is logged already"):
            model.train(1)


# --- an env family


@pytest.fixture
def heights() -> Iterator[str]:
    """Id of an env of one's own, single and batched."""
    gym.register(
        "SparseHeights-v0",
        entry_point=lambda **kwargs: DynamicsEnv(Heights(), Balloons(1), **kwargs),
        vector_entry_point=lambda num_envs, max_episode_steps, **kwargs: DynamicsVectorEnv(  # type: ignore[arg-type]
            Heights(), Balloons(num_envs), max_episode_steps, **kwargs
        ),
        max_episode_steps=25,
    )
    yield "SparseHeights-v0"
    del gym.registry["SparseHeights-v0"]


# Enough for a family of one's own
LEARNS: dict[str, Any] = {
    "gradient_steps": 100,
    "meta_batch_size": 32,
    "batch_size": 16,
    "policy_kwargs": {"net_arch": [64, 64], "encoder_arch": [64, 64], "latent_dim": 3},
}


def test_an_env_family(heights: str, tiny_pearl: MakePEARL) -> None:
    check_task_env(gym.make(heights))
    model = tiny_pearl(heights, seed=1, **LEARNS).learn(8 * 4 * 3 * 25)
    assert model.env is not None and isinstance(model.env.unwrapped, BatchedTaskVecEnv), "its batched env is used"
    buffer = model.replay_buffer
    assert buffer is not None and isinstance(buffer.task_family, Heights) and buffer.max_episode_steps == 25
    assert model.task_bank is not None and int(model.knowledge.n_particles) > 10, "random flights, rewarded in hindsight"
    data = buffer.sample(16, meta_batch_size=100)
    assert data.rewards.min() < 0 and (~data.unrewarded[data.relabelled]).mean() > (~data.unrewarded[~data.relabelled]).mean()
    returns, successes = evaluate_adaptation(model, heights, n_episodes=6)
    assert returns.shape == (10, 6) and successes.any(axis=1).sum() > 2, "heights that it was never told of"
    single, _ = evaluate_adaptation(model, gym.make(heights), n_episodes=1)
    assert single.shape == (10, 1)


# --- a method, and an experiment with it

# A module of somebody's own
OWN = """
from dataclasses import dataclass

import matplotlib.pyplot as plt
from sb3_htr import PEARL
from sb3_htr.adaptation import Aggregate, register_explorer
from sb3_htr.experiments.grid import EXPERIMENTS, Experiment, Variant, by
from sb3_htr.htr import SingleEpisodeRelabelling, register_relabeller
from sb3_htr.pearl import register_encoder
from sb3_htr.pearl.encoder import ContextEncoder
from sb3_htr.zoo.run.algorithm import register_algorithm
from sb3_htr.zoo.run.method import register_method

@register_explorer
@dataclass
class Wide(Aggregate):
    width: float = 1.0

    def start(self):
        super().start()
        self.z = self.width * self.z

@register_relabeller
class Again(SingleEpisodeRelabelling):
    pass

@register_encoder
class Doubtful(ContextEncoder):
    def posterior(self, state):
        mean, variance = super().posterior(state)
        return mean, 2 * variance

class Mild(PEARL):
    def __init__(self, *args, mildness=1.0, **kwargs):
        self.mildness = mildness
        super().__init__(*args, **kwargs)

register_algorithm("mild-pearl", Mild, "pearl.yml", "It is milder.")
of_one = {"relabeller": "Again", "relabel_probability": 0.5, "rl_reward_type": "sparse"}
register_method("mild", about="Mild.", algorithm="mild-pearl", **of_one, train_explorer="wide", explorer="wide")
register_method(
    "half-half",
    about="PEARL that relabels every other time",
    relabeller="EpisodeClustering",
    relabel_probability=0.5,
    rl_reward_type="dense",
    train_explorer="belief",
    explorer="aggregate",
)
small = {"n_envs": 4, "n_tasks_per_rollout": 4, "n_episodes_per_task": 3, "learning_starts": 240, "gradient_steps": 2}
networks = {"policy_kwargs": {"net_arch": [16], "encoder_arch": [16]}}
row = Variant("half-half", "half", {**small, **networks})

def draw(results, path):
    plt.figure(figsize=(1, 1)).savefig(path, dpi=len(results))

EXPERIMENTS["toy"] = Experiment(
    "toy", "A toy.", "SparsePointRobot-v0", 480, (row,), 1, evaluations=by(("aggregate",)), figure=draw
)
settings = {"mildness": 0.5, "explorer": {"width": 2.0}}
networks = {"policy_kwargs": {**networks["policy_kwargs"], "encoder_class": "Doubtful"}}
mild = Variant("mild", "mild", {**small, **settings, **networks})
EXPERIMENTS["mild"] = Experiment("mild", "Mild.", "SparsePointRobot-v0", 480, (mild,), 1, evaluations=by(("wide",)))
"""


@pytest.fixture
def own_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A module to be named on the command line, and forgotten afterwards."""
    (tmp_path / "half_half.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    registries: list[dict[str, Any]] = [grid.EXPERIMENTS, EXPLORERS, RELABELLERS, ENCODERS, ALGORITHMS]
    before = [dict(registry) for registry in registries]
    monkeypatch.setattr("sb3_htr.experiments.protocol.EVAL_SEEDS", (1,))
    yield "half_half"
    sys.modules.pop("half_half", None)
    method.methods.cache_clear()
    for registry, content in zip(registries, before, strict=True):
        registry.clear()
        registry.update(content)


def test_a_method(own_module: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of the command line, which names the module."""
    packages = ["--gym-packages", own_module]
    assert main(train_arguments(tmp_path, 480, *packages, "--method", "half-half")) == 0
    run = run_folder(tmp_path, "half-half")
    model = replace(agent_at(run, "last"), trusted=True).load()
    assert isinstance(model, PEARL)
    assert json.loads((run / RECORD).read_text())["method"] == "half-half"
    assert (model.explorer.name, model.train_explorer.name) == ("aggregate", "belief")
    buffer: Any = model.replay_buffer_kwargs
    assert (buffer["relabel_probability"], buffer["rl_reward_type"]) == (0.5, "dense")
    assert buffer["relabeller"]["name"] == "EpisodeClustering"
    capsys.readouterr()
    few = ["--no-render", "--n-tasks", "1", "--n-episodes", "1"]
    assert main(["enjoy", "--env", ENV_ID, "-f", str(tmp_path), *packages, "--method", "half-half", *few]) == 0
    assert f"{run}" in capsys.readouterr().out
    assert main(train_arguments(tmp_path, 240, *packages, "--method", "half-half-prior")) == 0
    assert agent_at(run_folder(tmp_path, "half-half-prior"), "last").load().explorer.name == "prior"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"name": "htr-ser"}, "There is a method 'htr-ser' already"),
        ({"explorer": "believe"}, "The explorer of the method 'mine' is 'believe', expected one of"),
        ({"algorithm": "maml"}, "'mine' is not whole"),
        ({"relabelled": 1}, "'mine' is not whole"),
    ],
)
def test_a_method_that_is_not_whole(settings: dict[str, Any], message: str) -> None:
    block = yaml.safe_load(hyperparams_file("methods.yml").read_text())["htr-ser"]
    before = dict(method.methods())
    with pytest.raises(ValueError, match=message):
        method.register_method(**{"name": "mine", **block, **settings})
    assert method.methods() == before


def test_an_experiment(own_module: str, tmp_path: Path) -> None:
    """A row of the grid, with a method of the same module."""
    runs = ["--runs", str(tmp_path / "runs"), "-o", str(tmp_path / "results")]
    (tmp_path / "runs").mkdir()
    assert main(["experiment", "toy", "--gym-packages", own_module, "--cell", "0", *runs]) == 0
    assert agent_at(tmp_path / "runs" / "toy" / "half-seed1").method == "half-half"
    assert main(["experiment", "toy", "--gym-packages", own_module, *runs, "--jobs", "1"]) == 0, "nothing is left to run"
    summary = json.loads((tmp_path / "results" / "summary.json").read_text())
    assert {row["variant"] for row in summary["rows"]} == {"half"}
    assert plt.imread(tmp_path / "results" / "toy.png").shape[:2] == (1, 1), "by its own figure, of one result"


def test_a_method_all_of_whose_parts_are_ones_own(own_module: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Algorithm, explorer, relabeller and encoder: commands read its models without --trust, as the user has imported them."""
    packages, runs = ["--gym-packages", own_module], tmp_path / "runs"
    where = ["--runs", str(runs), "-o", str(tmp_path / "results")]
    assert main(["experiment", "mild", *packages, *where, "--jobs", "1"]) == 0
    agent = agent_at(runs / "mild" / "mild-seed1", "last")
    model = agent.load()
    assert isinstance(model, PEARL) and type(model).__name__ == "Mild" and model.mildness == 0.5  # type: ignore[attr-defined]
    assert (type(model.explorer).__name__, model.explorer.width) == ("Wide", 2.0)  # type: ignore[attr-defined]
    assert type(model.policy.encoder).__name__ == "Doubtful"
    assert type(model.replay_buffer.relabeller).__name__ == "Again"  # type: ignore[union-attr]
    few = ["--n-tasks", "1", "--n-episodes", "1", "--no-render"]
    assert main(["enjoy", str(agent.path), *packages, *few]) == 0
    cards = tmp_path / "cards"
    export = ["export", str(agent.path), *packages, "--n-episodes", "1"]
    assert main([*export, "-o", str(cards / "plain")]) == 0
    card = (cards / "plain" / "README.md").read_text()
    assert "from half_half import Mild\n" in card and "It is milder." in card and "--trust" not in card
    more = type("More", (type(model),), {"_get_torch_save_params": lambda self: ([], [])})
    with pytest.raises(ValueError, match=r"More has weights that PEARL has not, which only More\.load restores"):
        load_untrusted(agent.path, ENV_ID, model_class=more)
    with pytest.raises(ValueError, match="its class More has weights that PEARL has not"):  # before it is trained in a grid
        replace(agent.algorithm, model_class=more).check_loadable({})
    del EXPLORERS["wide"]
    with pytest.raises(ValueError, match=r"its explorer is a class of its own that is not registered \(sb3_htr"):
        agent.load()
    assert main([*export, "--trust", "-o", str(cards / "trusted")]) == 0
    assert "--gym-packages half_half --trust\n" in (cards / "trusted" / "README.md").read_text()


def test_a_name_is_of_one_class() -> None:
    @dataclass
    class Prior(Lattice):
        pass

    for use in (register_explorer, lambda kind: to_explorer(kind())):
        with pytest.raises(
            ValueError, match=r"explorer tests\.test_joints\..*Prior has the name 'prior', which is that of sb3"
        ):
            use(Prior)
    with pytest.raises(ValueError, match=r"What is registered as relabeller is <class .*, expected a class derived from"):
        register_relabeller(Prior)  # type: ignore[type-var]
    with pytest.raises(ValueError, match="expected a class derived from torch"):
        register_encoder(Prior)  # type: ignore[type-var]


def test_a_class_derived_from_an_explorer_of_the_package_has_its_own_name() -> None:
    for kind in EXPLORERS.values():
        assert to_explorer(type("Mine", (kind,), {})()).name == "mine"


class Quiet(Lattice):
    """Does not call what it is derived from."""

    def __init__(self) -> None:
        self.width = 1.0


def test_an_explorer_with_a_constructor_of_its_own(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl(explorer=Quiet(), train_explorer=Quiet()).learn(ROLLOUT)
    assert model.explorer.name == "quiet"


def test_rows_of_elsewhere_need_rewards(tiny_pearl: MakePEARL) -> None:
    buffer = tiny_pearl().learn(ROLLOUT).replay_buffer
    assert buffer is not None
    ranges, tasks = np.array([[0, 20]]), np.zeros((1, 2), dtype=np.float32)
    draw = HindsightDraw(buffer.episodes, ranges, ranges, tasks, is_relabelled=False, elsewhere=0.5)
    draw.check(1, 2)
    draw._replace(context=ranges.astype(np.uint64)).check(1, 2)
    with pytest.raises(ValueError, match=r"elsewhere of a HindsightDraw is 0.5, and what is drawn there has the rewards of"):
        draw._replace(is_relabelled=True).check(1, 2)


class Idle(RandomTrainingTask):
    """Draws nothing."""

    def draw(self, tasks: Any) -> HindsightDraw:
        super().draw(tasks)
        return None  # type: ignore[return-value]


class Unbound(RandomTrainingTask):
    """Does not call what it is derived from."""

    def bind(self, buffer: Any) -> None:
        self.mine = buffer


class Hoarder(RandomTrainingTask):
    """Keeps episodes, and all that it knows in arrays."""

    def __init__(self) -> None:
        super().__init__()
        self.kept: list[Any] = []

    def on_episode(self, task: int, episode: Any) -> None:
        self.kept.append((episode, episode.copy()))

    def state_dict(self) -> dict[str, Any]:
        return {"n": {"episodes": np.zeros(1)}}


def test_a_relabeller_that_draws_nothing_or_is_not_bound_is_told_of(tiny_pearl: MakePEARL) -> None:
    with pytest.raises(ValueError, match="draw of Idle returned a NoneType, expected a HindsightDraw"):
        tiny_pearl(replay_buffer_kwargs={"relabeller": Idle()}).learn(ROLLOUT)
    with pytest.raises(ValueError, match=r"bind of Unbound does not call super\(\).bind\(buffer\)"):
        tiny_pearl(replay_buffer_kwargs={"relabeller": Unbound()})


def test_a_relabeller_may_keep_episodes_and_not_change_them(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    model = tiny_pearl(replay_buffer_kwargs={"relabeller": Hoarder()}).learn(2 * ROLLOUT)
    assert model.replay_buffer is not None
    kept = model.replay_buffer.relabeller.kept  # type: ignore[attr-defined]
    assert len(kept) > 10 and all((episode == copied).all() for episode, copied in kept)
    with pytest.raises(ValueError, match="read-only"):
        kept[0][0][:] = 0
    with pytest.raises(
        ValueError, match=r"state_dict\(\) of Hoarder cannot be saved: \['n'\]\['episodes'\] is a numpy.ndarray"
    ):
        model.save_replay_buffer(tmp_path / "replay")
