"""Fixtures, where tests run, and how hard hypothesis looks."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch as th
from hypothesis import settings

import htr_envs  # noqa: F401 registers the envs
from helpers import ENV_ID, TINY, MakePEARL
from sb3_htr import PEARL

th.set_num_threads(1)
# Timings on a shared machine say nothing; `--hypothesis-profile nightly` looks harder
settings.register_profile("ci", deadline=None, max_examples=50)
settings.register_profile("nightly", deadline=None, max_examples=2000)
settings.load_profile("ci")


def pytest_configure(config: pytest.Config) -> None:
    """What tests expect are tensors and bits of a CPU, also where there is a GPU; what needs one is tested by ``-m gpu``."""
    if config.option.markexpr != "gpu":
        os.environ["CUDA_VISIBLE_DEVICES"] = ""


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Whether it can run here."""
    if item.get_closest_marker("gpu") is not None and not th.cuda.is_available():
        pytest.skip("needs a GPU, and -m gpu")


@pytest.fixture(scope="session", autouse=True)
def logs_of_sb3(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Each training would leave an empty folder among the temporary files of the machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SB3_LOGDIR", str(tmp_path_factory.mktemp("logs_of_sb3")))
        yield


@pytest.fixture
def tiny_pearl() -> MakePEARL:
    """A PEARL that trains in a moment; keyword arguments change its settings."""

    def make(env: Any = ENV_ID, **kwargs: Any) -> PEARL:
        return PEARL("MlpPolicy", env, **{**TINY, **kwargs})

    return make


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trials of a hyperparameter search take a moment."""

    def sample_little(space: Any, trial: Any, *_: Any) -> dict[str, Any]:
        rate = trial.suggest_float("learning_rate", 1e-4, 1e-3)
        return {"learning_rate": rate, "gradient_steps": 2, "policy_kwargs": TINY["policy_kwargs"]}

    monkeypatch.setattr("sb3_htr.zoo.run.search_space.SearchSpace.sample", sample_little)
    monkeypatch.setattr("sb3_htr.zoo.run.search_space.SearchSpace.convert", lambda space, params: params)
    monkeypatch.setattr("sb3_htr.zoo.commands.optimize.PAUSE", 0.05)


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A :class:`helpers.hub.Hub` in the place of Hugging Face's."""
    from helpers.hub import Hub  # which only its tests need packages for

    hub = Hub(tmp_path / "hub")
    monkeypatch.setattr("huggingface_hub.HfApi", lambda: hub)
    monkeypatch.setattr("huggingface_hub.hf_hub_download", hub.download)
    monkeypatch.chdir(tmp_path)
    return hub
