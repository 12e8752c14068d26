"""Updates on meta-batches of one shape, in the same memory each time, and recorded once; captured, where there is a GPU."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st

from helpers import ROLLOUT, MakePEARL, parameters, with_policy
from helpers.recording import capture
from sb3_htr import PEARL
from sb3_htr.common.checkpoint import load_latest
from sb3_htr.common.checkpoint_callback import CheckpointCallback
from sb3_htr.common.type_aliases import MultiTaskSamples
from sb3_htr.pearl import graphed_update
from sb3_htr.pearl.graphed_update import FixedUpdate, GraphedUpdate, capturable
from sb3_htr.pearl.packed import Packed, tensors_of
from sb3_htr.pearl.padding import padded

SETTINGS: dict[str, Any] = {
    "meta_batch_size": 6,
    "context_size": 9,
    "batch_size": 5,
    "ent_coef": "auto_0.3",
    "n_steps": 2,
    "learning_starts": 10**9,
    "target_update_interval": 2,
}


def uneven(model: PEARL) -> Callable[..., MultiTaskSamples]:
    """``sample`` of the model, with tasks that have other numbers of rows each time, as where episodes end early."""
    assert model.replay_buffer is not None
    sample, rng = model.replay_buffer.sample, np.random.default_rng(0)

    def cut(*args: Any, **sizes: Any) -> MultiTaskSamples:
        data = sample(*args, **sizes)
        labels, n = data.labels, len(data.rewards)
        lengths, device = data.lengths.cpu().numpy(), data.rewards.device
        keep = np.sort(rng.choice(n, size=int(rng.integers(n // 2, n)), replace=False))
        keep = np.union1d(keep, np.cumsum(lengths) - 1)  # one of each task
        task = np.repeat(np.arange(len(lengths)), lengths)
        rows = ("observations", "actions", "next_observations", "rewards", "dones", "discounts")
        data = data._replace(
            **{name: getattr(data, name)[th.from_numpy(keep).to(device)] for name in rows},
            lengths=th.from_numpy(np.bincount(task[keep])).to(device),
        )
        assert labels is not None
        n_labelled = int(rng.integers(3, len(keep)))
        few = {name: getattr(labels, name)[:n_labelled] for name in ("next_observations", "reward", "task_free")}
        weights = th.full((n_labelled,), 1 / n_labelled, device=device)
        return data._replace(labels=labels._replace(**few, rows=th.arange(n_labelled, device=device), weights=weights))

    return cut


@pytest.fixture
def device() -> str:
    """Of the pair."""
    return "cpu"


@pytest.fixture
def pair(tiny_pearl: MakePEARL, device: str, monkeypatch: pytest.MonkeyPatch) -> tuple[PEARL, PEARL]:
    """
    Models alike with the same experience, the second of which fills its meta-batches up. Noise is a number: of what is drawn,
    more rows get other numbers.
    """
    models = [tiny_pearl(**SETTINGS, cuda_graph=graph, device=device) for graph in (False, True)]
    for model in models:
        with pytest.warns(UserWarning, match="Nothing was learnt"):
            model.learn(2 * ROLLOUT)
        monkeypatch.setattr(model.replay_buffer, "sample", uneven(model))
    monkeypatch.setattr(th, "randn_like", lambda tensor: th.full_like(tensor, 0.4))
    return models[0], models[1]


def optimizers_of(model: PEARL) -> list[th.optim.Optimizer]:
    assert model.ent_coef_optimizer is not None
    networks = (model.actor, model.critic, model.encoder, model.reward_model)
    return [*(network.optimizer for network in networks), model.ent_coef_optimizer]


def graphed(model: PEARL) -> GraphedUpdate:
    """Its update, recorded."""
    return GraphedUpdate(model._gradient_step, model.device, optimizers_of(model))


@contextmanager
def fused(optimizers: Sequence[th.optim.Optimizer]) -> Iterator[None]:
    """On a CPU, Adam counts its steps in memory if it is fused."""
    for optimizer in optimizers:
        optimizer.param_groups[0]["fused"] = True
    yield


@pytest.mark.parametrize("is_recorded", [False, True], ids=["filled up", "recorded and repeated"])
def test_losses_of_a_hundred_updates_are_the_same(
    pair: tuple[PEARL, PEARL], is_recorded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = Mock(side_effect=capture)
    monkeypatch.setattr(graphed_update, "capture", recording)
    monkeypatch.setattr(graphed_update, "aside", lambda function, device: function())
    monkeypatch.setattr(graphed_update, "capturable", fused)
    eager, fixed = pair
    learn = graphed(fixed) if is_recorded else FixedUpdate(fixed._gradient_step, fixed.device)
    for _ in range(100):
        (mean, log), (own_mean, own_log) = eager._update(5), fixed._update(5, learn)
        assert list(own_log) == list(log)
        for name, value in log.items():
            th.testing.assert_close(own_log[name], value, rtol=1e-5, atol=1e-5, msg=partial("{}: {}".format, name))
        th.testing.assert_close(own_mean, mean, rtol=1e-5, atol=1e-5)
    assert log["relabelled_fraction"] > 0 and fixed.reward_model.scale > 0
    assert recording.call_count == 2 * is_recorded, "with and without the target critics"
    for pair_of_weights in zip(eager.critic_target.parameters(), fixed.critic_target.parameters(), strict=True):
        th.testing.assert_close(*pair_of_weights, rtol=1e-4, atol=1e-5)


@pytest.mark.gpu
@pytest.mark.parametrize("device", ["cuda"])
def test_a_captured_update_learns_what_operations_learn_and_waits_for_nothing(pair: tuple[PEARL, PEARL]) -> None:
    eager, fixed = pair
    assert fixed.replay_buffer is not None
    learn, fixed.replay_buffer.device = graphed(fixed), th.device("cpu")
    for _ in range(100):
        mean, log = eager._update(5)
        is_captured = len(learn._replays) == 2  # to capture, optimizers get their counts of steps from the CPU
        th.cuda.set_sync_debug_mode("error" if is_captured else "default")
        try:
            own_mean, own_log = fixed._update(5, learn)
        finally:
            th.cuda.set_sync_debug_mode("default")
        for name, value in log.items():
            th.testing.assert_close(own_log[name], value, rtol=1e-4, atol=1e-4, msg=partial("{}: {}".format, name))
        th.testing.assert_close(own_mean, mean, rtol=1e-4, atol=1e-4)
    assert len(learn._replays) == 2, "with and without the target critics"
    for pair_of_weights in zip(eager.critic_target.parameters(), fixed.critic_target.parameters(), strict=True):
        th.testing.assert_close(*pair_of_weights, rtol=1e-3, atol=1e-4)


@pytest.mark.gpu
def test_a_captured_update_draws_other_noise_each_time(tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    """All else stays as it is: rates are zero, and the target critics are the critics."""
    with pytest.warns(UserWarning, match="Nothing was learnt"):
        model = tiny_pearl(**SETTINGS, cuda_graph=True, device="cuda").learn(2 * ROLLOUT)
    assert model.replay_buffer is not None
    model.replay_buffer.device = th.device("cpu")
    data = model.replay_buffer.sample(5, meta_batch_size=6, context_size=9, n_labelled=256)
    monkeypatch.setattr(model.replay_buffer, "sample", lambda *_, **__: data)
    for optimizer in optimizers_of(model):
        optimizer.param_groups[0]["lr"] = 0.0
    learn = graphed(model)
    losses = {model._update(5, learn)[1]["critic_loss"].item() for _ in range(20)}
    assert len(losses) == 20 and max(losses) < 2 * min(losses)


@pytest.mark.parametrize(
    ("device", "cuda_graph", "optimizer", "kind"),
    [
        ("cpu", None, "Adam", None),
        ("cpu", True, "Adam", FixedUpdate),
        ("cuda", None, "Adam", GraphedUpdate),
        ("cuda", None, "AdamW", GraphedUpdate),
        ("cuda", None, "Adagrad", None),
        ("cuda", True, "Adagrad", GraphedUpdate),
        ("cuda", False, "Adam", None),
    ],
)
def test_on_a_gpu_updates_are_captured_unless_they_cannot_be(
    device: str, cuda_graph: bool | None, optimizer: str, kind: Any, tiny_pearl: MakePEARL
) -> None:
    policy_kwargs = with_policy(optimizer_class=getattr(th.optim, optimizer))
    model = tiny_pearl(cuda_graph=cuda_graph, ent_coef="auto", policy_kwargs=policy_kwargs)
    model.device = th.device(device)  # which nothing is put on
    fixed = model._fixed_update(optimizers_of(model))
    assert type(fixed) is (type(None) if kind is None else kind)


def test_what_cannot_be_captured_says_what_to_do(pair: tuple[PEARL, PEARL], monkeypatch: pytest.MonkeyPatch) -> None:
    _, fixed = pair
    refused = Mock(side_effect=RuntimeError("operation not permitted when stream is capturing"))
    monkeypatch.setattr(graphed_update, "capture", refused)
    monkeypatch.setattr(graphed_update, "aside", lambda function, device: function())
    learn = graphed(fixed)
    fixed._update(5, learn)
    with pytest.raises(RuntimeError, match=r"CUDA graph \(operation not permitted .*\): give cuda_graph=False"):
        fixed._update(5, learn)


def test_what_a_recording_repeats_is_what_it_saw() -> None:
    """So the test before finds what is a constant of a recording, and should not be."""
    x, y, count = th.zeros(3), th.zeros(3), [0]

    def function() -> None:
        count[0] += 1
        y.add_(x * count[0])

    replay = capture(function, th.device("cpu"))
    assert not y.any()
    x.fill_(2.0)
    replay()
    x.fill_(3.0)
    replay()
    assert y.tolist() == [5.0] * 3 and count == [1]


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_training_with_filled_meta_batches_learns_and_is_saved(device: str, tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    model = tiny_pearl(cuda_graph=True, meta_batch_size=64, device=device)  # 256 rows and more have labels
    before = parameters(model)
    model.learn(2 * ROLLOUT)
    after = parameters(model)
    assert model._n_updates == 6
    for network in ("actor.", "critic.", "critic_target.", "encoder.", "reward_model.", "knowledge."):
        assert any(not th.equal(before[name], after[name]) for name in before if name.startswith(network)), network
    model.save(tmp_path / "model")
    loaded = PEARL.load(tmp_path / "model", env=model.get_env(), device="cpu")
    assert loaded.cuda_graph
    for name, value in parameters(loaded).items():
        assert th.equal(value, after[name].cpu()), name
    loaded.learn(ROLLOUT, reset_num_timesteps=False)
    assert loaded._n_updates == 9


@pytest.mark.gpu
@pytest.mark.parametrize("cuda_graph", [False, True])
def test_a_training_on_a_gpu_goes_on(cuda_graph: bool, tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    ends = []
    for parts in ((4,), (2, 2)):
        for i, n_rollouts in enumerate(parts):
            model = tiny_pearl(cuda_graph=cuda_graph, device="cuda", learning_rate=1e-3)
            callback = CheckpointCallback(1, str(tmp_path / str(parts)))
            if i > 0:
                callback.restore(model, load_latest(tmp_path / str(parts))[1])
            model.learn(n_rollouts * ROLLOUT, callback, reset_num_timesteps=i == 0)
        ends.append(parameters(model))
    for name, value in ends[0].items():
        assert th.equal(ends[1][name], value), name


@given(shapes=st.lists(st.lists(st.integers(0, 5), max_size=3), max_size=6), seed=st.integers(0, 99))
def test_packed_tensors_are_those_that_came(shapes: list[list[int]], seed: int) -> None:
    generator = th.Generator().manual_seed(seed)
    dtypes = (th.float32, th.int64, th.bool, th.float64)
    tensors = [th.randint(0, 2, shape, generator=generator).to(dtypes[i % 4]) for i, shape in enumerate(shapes)]
    here, there = Packed(tensors, "cpu"), Packed(tensors, "cpu")
    for own, tensor in zip(here.tensors, tensors, strict=True):
        own.copy_(tensor)
    there.block.copy_(here.block)
    for own, tensor in zip(there.tensors, tensors, strict=True):
        assert own.dtype == tensor.dtype and own.shape == tensor.shape and th.equal(own, tensor)
        assert own.data_ptr() % own.element_size() == 0 and own.is_contiguous()


def test_filling_a_meta_batch_changes_none_of_its_rows(tiny_pearl: MakePEARL) -> None:
    with pytest.warns(UserWarning, match="Nothing was learnt"):
        model = tiny_pearl(**SETTINGS).learn(2 * ROLLOUT)
    assert model.replay_buffer is not None
    data = uneven(model)(5, meta_batch_size=6, context_size=9, n_labelled=256)
    full = padded(data, 6 * 9 + 1, 6 * 5 + 1, 30)
    assert full.lengths.sum() == 31 and full.context.lengths.sum() == 55 and len(full.lengths) == 7
    assert full.task_weights.sum().item() == pytest.approx(1.0) and full.task_weights[-1] == 0
    for own, before in zip(tensors_of(full), tensors_of(data), strict=True):
        part = own[tuple(slice(n) for n in before.shape)]
        assert th.equal(part, before)
        rest = own.clone()
        rest[tuple(slice(n) for n in before.shape)] = 0
        assert own is full.lengths or own is full.context.lengths or not rest.any()
    with pytest.raises(AssertionError):
        padded(data, 6 * 9 + 1, len(data.rewards) - 1, 30)


def test_adam_is_capturable_while_it_is_captured_and_files_do_not_know() -> None:
    parameter = th.nn.Parameter(th.ones(2))
    adam, sgd = th.optim.Adam([parameter]), th.optim.SGD([parameter], 0.1)
    parameter.grad = th.ones(2)
    adam.step()
    with pytest.raises(KeyboardInterrupt), capturable([adam, sgd]):
        assert adam.param_groups[0]["capturable"] and "capturable" not in sgd.param_groups[0]
        raise KeyboardInterrupt
    assert not adam.param_groups[0]["capturable"] and adam.state[parameter]["step"] == 1
    adagrad = th.optim.Adagrad([parameter])
    adagrad.step()
    with (
        pytest.raises(ValueError, match="Adagrad cannot be captured as a CUDA graph: take Adam or AdamW"),
        capturable([adagrad]),
    ):
        pass
