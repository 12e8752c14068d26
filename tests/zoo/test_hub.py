"""Agents that are shared: exported, uploaded, downloaded, and used as their model card says."""

import locale
import re
import shutil
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml
from huggingface_sb3 import EnvironmentName, ModelName

from helpers import ENV_ID, MakePEARL, with_policy
from helpers.hub import Hub
from helpers.runs import make_run, run_folder
from sb3_htr import evaluate_adaptation
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.run.agents import agent_for
from sb3_htr.zoo.run.hub import files, model_name

MODEL = f"pearl-{ENV_ID}.zip"
# Goals that a random agent comes across, and few of them
NEAR = {"goal_distance": 0.3, "n_test_tasks": 3}


def names(folder: Path | str) -> list[str]:
    return sorted(path.name for path in Path(folder).iterdir())


@pytest.mark.parametrize("env_id", [ENV_ID, "HiddenGoal/FetchReach-v4", "my_package:Mine-v3"])
def test_names_are_those_of_huggingface_sb3(env_id: str) -> None:
    assert files(model_name(env_id))[0] == ModelName("pearl", EnvironmentName(env_id)).filename


def test_a_model_card_has_its_letters_whatever_the_locale(tmp_path: Path, tiny_pearl: MakePEARL) -> None:
    run = make_run(tmp_path / "runs", tiny_pearl())
    before = locale.setlocale(locale.LC_CTYPE, None)
    locale.setlocale(locale.LC_CTYPE, "C")
    try:
        assert main(["export", str(run), "--n-episodes", "1", "-o", str(tmp_path / "agent")]) == 0
    finally:
        locale.setlocale(locale.LC_CTYPE, before)
    assert "±" in (tmp_path / "agent" / "README.md").read_text(encoding="utf-8")


def test_an_agent_goes_to_the_hub_and_comes_back(
    hub: Hub, tmp_path: Path, tiny_pearl: MakePEARL, capsys: pytest.CaptureFixture[str]
) -> None:
    model = tiny_pearl()
    run = make_run(tmp_path / "runs", model, method="htr-ec", env_kwargs=NEAR)
    assert main(["export", str(run), "--n-episodes", "2", "-o", "shared", "--push-to-hub", "me", "--private"]) == 0
    assert hub.log == [f"me/pearl-{ENV_ID}, private: True"] and names(hub.folder) == ["README.md", MODEL]
    assert f"Uploaded to https://hub/me/pearl-{ENV_ID}" in capsys.readouterr().out
    assert (
        f"$ sb3-htr load_from_hub --env {ENV_ID} -orga me\n$ sb3-htr enjoy --env {ENV_ID}\n"
        in Path("shared/README.md").read_text()
    )
    for number in (1, 2):
        assert main(["load_from_hub", "--env", ENV_ID, "-orga", "me"]) == 0
        pulled = run_folder(Path("logs"), "htr-ec", number)
        assert names(pulled) == [f"{ENV_ID}.zip", "run.json"] and f"sb3-htr enjoy {pulled}" in capsys.readouterr().out
    agent = agent_for(ENV_ID, "logs")
    assert agent.folder == pulled and agent.method == "htr-ec" and agent.record["env_kwargs"] == NEAR
    ours, theirs = (evaluate_adaptation(own, agent.make_vec_env(3), n_episodes=2)[0] for own in (model, agent.load()))
    np.testing.assert_array_equal(ours, theirs)
    with pytest.raises(ValueError, match="is no run of sb3-htr train, so there is nothing to go on with"):
        main(["train", "--resume", str(pulled)])


def test_what_fails_at_the_hub_is_one_sentence(
    hub: Hub, tmp_path: Path, tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_run(tmp_path / "runs", tiny_pearl(), env_kwargs=NEAR)
    with pytest.raises(
        OSError, match=rf"The download from me/x failed: 404 Client Error\. Entry Not Found for me/x/{MODEL}\.$"
    ):
        main(["load_from_hub", "--env", ENV_ID, "-orga", "me", "-name", "x"])
    monkeypatch.setattr(Hub, "upload_folder", lambda *_, **__: (_ for _ in ()).throw(ConnectionError("no\nnetwork")))
    with pytest.raises(OSError, match="The upload to me/x failed, the files are in shared: no network"):
        main(["export", "runs", "-o", "shared", "--n-episodes", "1", "--push-to-hub", "me/x"])
    hub.folder.joinpath("pearl-SparseTargetSpeed-v0.zip").write_bytes(Path("shared", MODEL).read_bytes())
    with pytest.raises(ValueError, match=f"The model in me/y was trained on {ENV_ID}, expected SparseTargetSpeed-v0"):
        main(["load_from_hub", "--env", "SparseTargetSpeed-v0", "-orga", "me", "-name", "y"])
    assert not Path("logs").exists()


def test_an_export_folder_is_this_model_and_nothing_else(hub: Hub, tmp_path: Path, tiny_pearl: MakePEARL) -> None:
    make_run(tmp_path / "runs", tiny_pearl(), env_kwargs=NEAR)
    Path("shared").mkdir()
    for name in ("README.md", ".gitattributes"):
        Path("shared", name).write_text("of a project")
    arguments = ["export", "runs", "--n-episodes", "1", "-o", "shared"]
    with pytest.raises(ValueError, match=r"shared holds other files, such as README.md: give a folder of its own"):
        main(arguments)
    for name in ("replay.mp4", MODEL):
        Path("shared", name).write_text("of another seed")
    assert main(arguments) == 0
    assert names("shared") == [".gitattributes", "README.md", MODEL]
    hub.folder.mkdir()
    (hub.folder / "replay.mp4").write_text("of another seed")
    assert main([*arguments, "--push-to-hub", "me"]) == 0
    assert names(hub.folder) == ["README.md", MODEL]
    Path("shared", "thesis.tex").write_text("precious")
    with pytest.raises(ValueError, match=r"shared holds other files, such as thesis.tex: give a folder of its own"):
        main(arguments)
    with pytest.raises(ValueError, match=r"holds other files"):
        main([*arguments[:-1], "."])
    Path("shared", "thesis.tex").unlink()
    with pytest.raises(ValueError, match="--n-episodes is 0"):
        main([*arguments, "--n-episodes", "0"])
    with pytest.raises(ValueError, match="Repo id must be in the form"):
        main([*arguments, "--push-to-hub", "a/b/c"])
    assert names("shared") == [".gitattributes", "README.md", MODEL], "nothing is lost by a slip"


def test_an_export_that_is_stopped_while_it_is_scored_leaves_the_one_before(
    tmp_path: Path, tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "runs", tiny_pearl(), env_kwargs=NEAR)
    arguments = ["export", "runs", "--n-episodes", "1", "-o", "shared"]
    assert main(arguments) == 0
    before = {path.name: path.read_bytes() for path in Path("shared").iterdir()}

    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sb3_htr.zoo.commands.export.record_adaptation", stopped)
    make_run(tmp_path / "runs", tiny_pearl(seed=1), 2, env_kwargs=NEAR)
    with pytest.raises(KeyboardInterrupt):
        main(arguments)
    assert {path.name: path.read_bytes() for path in Path("shared").iterdir()} == before


@pytest.mark.parametrize(("env_id", "normalized"), [(ENV_ID, False), ("SparseWheeled-v0", True)])
def test_the_snippet_of_a_model_card_gives_what_the_model_does(
    env_id: str, normalized: bool, hub: Hub, tmp_path: Path, tiny_pearl: MakePEARL
) -> None:
    kwargs: dict[str, Any] = {**NEAR, "max_episode_steps": 20}
    if env_id != ENV_ID:
        pytest.importorskip("mujoco")
        kwargs = {"n_test_tasks": 2, "max_episode_steps": 20}
    env = make_task_vec_env(env_id, 4, env_kwargs=kwargs)
    model = tiny_pearl(env, policy_kwargs=with_policy(normalize_observations=normalized)).learn(240)
    run = make_run(tmp_path / "runs", model, env_id=env_id, env_kwargs=kwargs)
    (run / f"{ENV_ID}.zip").rename(run / f"{env_id}.zip")
    assert main(["export", str(run), "--n-episodes", "4", "-o", "shared", "--push-to-hub", "me"]) == 0
    card = Path("shared/README.md").read_text()
    (snippet,) = re.findall(r"```python\n(.*?)```", card, re.DOTALL)
    assert f'hf_hub_download("me/{model_name(env_id)}", "{model_name(env_id)}.zip")' in snippet
    assert "unwrapped" not in snippet, "which mypy --strict refuses"
    used: dict[str, Any] = {}
    exec(snippet, used)
    same = gym.make(env_id, **kwargs)
    expected = model.adapt(same, n_episodes=4, task=same.get_wrapper_attr("test_tasks")[0])
    observations = np.stack([same.reset(seed=seed)[0] for seed in range(3)])
    ours, theirs = (
        policy.predict(observations, (expected.z[None],), deterministic=True)[0]
        for policy in (used["agent"].policy, expected.policy)
    )
    np.testing.assert_array_equal(ours, theirs)
    if env_id == ENV_ID:  # which begins where it begins; the other one is given some noise
        np.testing.assert_array_equal(used["agent"].returns, expected.returns)
    # Without an upload, the file beside the card
    assert main(["export", str(run), "--n-episodes", "4", "-o", "shared"]) == 0
    (snippet,) = re.findall(r"```python\n(.*?)```", Path("shared/README.md").read_text(), re.DOTALL)
    shutil.copy(Path("shared", f"{model_name(env_id)}.zip"), tmp_path)
    exec(snippet, used)
    # The scores are those of the test tasks
    metadata = yaml.safe_load(card.split("---")[1])
    assert metadata["library_name"] == "stable-baselines3" and env_id in metadata["tags"]
    value = metadata["model-index"][0]["results"][0]["metrics"][0]["value"]
    assert f"| {value.replace('+/-', '±')} |" in card
    if env_id == ENV_ID:
        returns = evaluate_adaptation(model, make_task_vec_env(env_id, 20, env_kwargs=kwargs), n_episodes=4)[0][:, -1]
        assert value == f"{returns.mean():.2f} +/- {returns.std():.2f}"
    assert f"$ sb3-htr train --env {ENV_ID} --method htr-ser --seed 1\n" in card
