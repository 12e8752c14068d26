"""The page that goes with a shared agent."""

import json
import re
import shlex
from pathlib import Path
from typing import Any

import yaml
from huggingface_hub import EvalResult, ModelCardData

from sb3_htr.adaptation.evaluation import AdaptationRecord
from sb3_htr.common.markdown import markdown_table
from sb3_htr.zoo.run.algorithm import Algorithm
from sb3_htr.zoo.run.hub import model_name
from sb3_htr.zoo.run.method import DEFAULT, PEARLMethod, get_method, merged, methods
from sb3_htr.zoo.run.record import OF_STUDY, TRIAL
from sb3_htr.zoo.run.shipped import block_of, hyperparams_file
from sb3_htr.zoo.run.train_arguments import given_arguments, value_of
from sb3_htr.zoo.run.trust import CONF, PACKAGES, WEIGHTS, check_arguments

TAGS = (
    "deep-reinforcement-learning",
    "reinforcement-learning",
    "stable-baselines3",
    "meta-reinforcement-learning",
    "sb3_htr",
)
# Adaptation episodes in the table, and the last one
SHOWN = (1, 2, 3, 5, 10)
PEARL = "PEARL (Rakelly et al., 2019)"
OF_EXPLORERS = """ The explorer says how z is chosen;
`prior` is the protocol of PEARL's paper."""
# Arguments of a training that change nothing of its result, or name what is on one machine alone, with the number of their
# values. What a study brought is among -params
LOCAL = {"-f": 1, "--log-folder": 1, "-tb": 1, "--tensorboard-log": 1, "-P": 0, "--progress": 0, "--verbose": 1, "--seed": 1}
LOCAL |= dict.fromkeys(OF_STUDY, 1)
# In JSON, what Python has no literal for: descriptions of objects, as <class 'torch.nn.modules.activation.Tanh'>, and numbers
NOT_WRITTEN = re.compile(r'"<|NaN|Infinity')
OF_COMMANDS = "The commands of `sb3-htr` read the weights and plain settings alone."
OF_TRUST = "By `--trust` the commands of `sb3-htr` load it so, too, as it has classes of its own."


def training_command(record: dict[str, Any]) -> str:
    """
    :param record: of a run
    :return: the command that trains the same agent on another machine, empty if there is none; of files it has the names alone
    """
    if "arguments" not in record:
        return _checked(record)
    arguments = given_arguments(record["arguments"])
    conf = value_of(arguments, *CONF)
    has_own_settings = not (conf is None or _is_of_package(conf)) or TRIAL in record or "--trial-id" in arguments
    words: list[str] = []
    while arguments:
        word = arguments.pop(0)
        if word in LOCAL:
            del arguments[: LOCAL[word]]
        elif word in (*CONF, *WEIGHTS):
            # Settings that come with the package are on any machine; of the weights that it began with, there is the name
            file = "".join(arguments[:1])
            del arguments[:1]
            if word in WEIGHTS or _is_of_package(file):
                words += [word, Path(file).name]
        elif word in ("-params", "--hyperparams") and has_own_settings:  # which have these among them
            while arguments and not arguments[0].startswith("-"):
                del arguments[0]
        else:
            words.append(word)
    words += ["--method", record["method"]]
    if has_own_settings:
        params = _params(record, words)
        if params is None:
            return ""
        words += params
    return _in_a_line(["sb3-htr", "train", *words, "--seed", str(record["seed"])])


def _checked(record: dict[str, Any]) -> str:
    """That of a file, which may be a stranger's, to be given to a shell: a training that runs no other code, or none."""
    try:
        words = shlex.split(str(record.get("command", "")))
        rest = list(words)
        if "--method" in rest:
            at = rest.index("--method")
            del rest[at : at + 2]
        check_arguments(rest[2:], record["gym_packages"], "the command", trust=False)
    except ValueError:  # an open quote is one, too
        return ""
    return _in_a_line(words) if words[:2] == ["sb3-htr", "train"] else ""


def _in_a_line(words: list[str]) -> str:
    """For a block of a page that a word must not end; empty if one would."""
    command = shlex.join(words)
    return "" if "`" in command or len(command.splitlines()) > 1 else command


def _is_of_package(conf: str) -> bool:
    """Whether a run was given a file of the package: those of one's own are whole paths in its record."""
    file = hyperparams_file(Path(conf).name)
    return file.is_file() and conf in (file.name, str(file.resolve()))


def _params(record: dict[str, Any], words: list[str]) -> list[str] | None:
    """What makes a run's settings of those that the other words have, None if that cannot be written."""
    method, had = methods().get(record["method"]), record.get("hyperparams", {})
    if method is None:
        return None
    of_words = method.settings(block_of(value_of(words, *CONF) or method.algorithm.settings, record["env_id"]))
    if value_of(words, "-n", "--n-timesteps") is not None:
        of_words["n_timesteps"] = had.get("n_timesteps")
    params = {key: value for key, value in had.items() if key not in of_words or of_words[key] != value}
    if merged(of_words, params) != had or NOT_WRITTEN.search(json.dumps(params)):
        return None
    return ["-params", *(f"{key}:{value!r}" for key, value in params.items())] if params else []


def table(scores: dict[str, AdaptationRecord]) -> str:
    """
    :param scores: explorer and adaptations
    :return: Markdown
    """
    n_episodes = next(iter(scores.values())).returns.shape[1]
    head = ["adaptation episode", *(f"{what}, explorer `{name}`" for name in scores for what in ("return", "tasks solved"))]
    lines: list[list[str]] = []
    for i in sorted({episode for episode in SHOWN if episode < n_episodes} | {n_episodes}):
        cells = [str(i)]
        for record in scores.values():
            returns = record.returns[:, i - 1]
            # An env may not say which tasks are solved
            solved = f"{record.successes[:, i - 1].mean():.0%}" if record.successes.any() else "none known"
            cells += [f"{returns.mean():.2f} ± {returns.std():.2f}", solved]
        lines.append(cells)
    return markdown_table(head, lines)


def snippet(algorithm: Algorithm, path: str, env: str, n_episodes: int) -> str:
    """
    :param algorithm: of the agent
    :param path: of its file, in Python
    :param env: makes an env, in Python
    :param n_episodes: of an adaptation
    :return: Python that loads the agent and lets it adapt to a task
    """
    name, module = algorithm.model_class.__name__, algorithm.model_class.__module__
    if hasattr(algorithm.model_class, "adapt"):
        return f"""from {"sb3_htr" if module.startswith("sb3_htr.pearl.") else module} import {name}

model = {name}.load({path})
env = {env}
agent = model.adapt(env, n_episodes={n_episodes}, task=env.get_wrapper_attr("test_tasks")[0])
print(agent.returns)  # of the adaptation episodes; agent.predict(observation) acts on this task
"""
    return f"""from sb3_htr import evaluate_adaptation
from {module} import {name}

model = {name}.load({path})
env = {env}
returns, successes = evaluate_adaptation(model, env, env.get_wrapper_attr("test_tasks")[:1], n_episodes={n_episodes})
print(returns)  # of the episodes
"""


def model_card(
    record: dict[str, Any], scores: dict[str, AdaptationRecord], repo_id: str | None = None, needs_trust: bool = False
) -> str:
    """
    :param record: of an exported agent
    :param scores: explorer and its adaptations to the test tasks
    :param repo_id: where it will be on the Hugging Face Hub
    :param needs_trust: whether commands load it by ``--trust`` alone
    :return: content of ``README.md``
    """
    # A model file of one's own names no method
    env_id, name = record["env_id"], record.get("method", "PEARL")
    explorer, adapted = next(iter(scores.items()))
    n_tasks, n_episodes = adapted.returns.shape
    returns = adapted.returns[:, -1]
    result = EvalResult(
        task_type="reinforcement-learning",
        task_name="meta-reinforcement-learning",
        dataset_type=env_id,
        dataset_name=f"{env_id}, {n_tasks} test tasks",
        metric_type="mean_reward",
        metric_name=f"return of adaptation episode {n_episodes}, explorer {explorer}",
        metric_value=f"{returns.mean():.2f} +/- {returns.std():.2f}",
        verified=False,
    )
    # A method of another version says no more than its name
    method = methods().get(name)
    tags = [env_id, *TAGS]
    if isinstance(method, PEARLMethod) and method.is_htr:
        tags.append("hindsight-task-relabelling")
    data = ModelCardData(library_name="stable-baselines3", tags=tags, model_name=name, eval_results=[result])
    kwargs = "".join(f", {key}={value!r}" for key, value in record["env_kwargs"].items())
    is_hidden = env_id.startswith("HiddenGoal/")
    packages = dict.fromkeys([*(record["gym_packages"] or []), "htr_envs"])  # one's own may bring no env, but a method
    imports = "".join(f"import {package}  # registers the env\n" for package in packages)
    if is_hidden:
        imports += f'htr_envs.hide_goal("{env_id.partition("/")[2]}")  # registers the family\n'
    about = PEARL if method is None else method.about
    algorithm = (method or get_method(DEFAULT)).algorithm
    model = model_name(env_id, algorithm.name)
    file = f"{model}.zip"
    own = " ".join(package for package in record["gym_packages"] or () if package not in PACKAGES)
    own = (own and f" --gym-packages {own}") + " --trust" * needs_trust
    watch = f"sb3-htr enjoy {file}{own}"
    path = f'"{file}"'
    if repo_id is not None:
        imports += "from huggingface_hub import hf_hub_download\n"
        path = f'hf_hub_download("{repo_id}", {path})'
        user, _, repo_name = repo_id.partition("/")
        named = ("" if model == model_name(env_id) else f" --algo {algorithm.name}") + (
            "" if repo_name == model else f" -name {repo_name}"
        )
        watch = f"sb3-htr load_from_hub --env {env_id} -orga {user}{named}\n$ sb3-htr enjoy --env {env_id}{own}"
    use = snippet(algorithm, path, f'gymnasium.make("{env_id}"{kwargs})', min(n_episodes, 10))
    of_explorers = OF_EXPLORERS if algorithm.also_explores_by else ""
    command = record.get("command")
    training = f"```console\n$ {command}\n```\n\n" if command else ""
    versions = ", ".join(f"{package} {version}" for package, version in record.get("versions", {}).items())
    return f"""---
{data.to_yaml()}
---

# {name} on {env_id}

An agent of {about}, trained with `sb3_htr` on Stable-Baselines3. {algorithm.about}

## Scores

Undiscounted return (mean ± standard deviation over tasks) and share of tasks solved, on {n_tasks} test tasks that training
has not seen, with mean actions and seed 0.{of_explorers}

{table(scores)}

## Use

```console
$ pip install '.[zoo,video]'  # in a checkout of sb3_htr; and the extra of the env, as mujoco
$ {watch}
```

```python
import gymnasium

{imports}{use}```

A model file can run code when it is loaded like this. {OF_TRUST if needs_trust else OF_COMMANDS}

## Training

{training}The model after {record["num_timesteps"]:,} env steps ({record["model"]}). {versions}.

```yaml
{yaml.safe_dump(record.get("hyperparams", {}), sort_keys=True).strip()}
```
"""
