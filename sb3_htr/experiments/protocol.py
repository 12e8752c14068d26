"""How every final model is judged: on test tasks that decided nothing, with several seeds, by each explorer alike."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from sb3_htr.adaptation.evaluation import evaluate_adaptation, first_success
from sb3_htr.adaptation.explorers import Explorer, Prior, to_explorer
from sb3_htr.common.settings import name_of
from sb3_htr.common.vec_env import family_of, make_task_vec_env
from sb3_htr.experiments.ablations import ABLATIONS
from sb3_htr.experiments.calibration import calibration
from sb3_htr.experiments.cell import Cell, Evaluation, KwArgs
from sb3_htr.zoo.run.algorithm import Model
from sb3_htr.zoo.run.method import OWN

# A final model adapts to all test tasks once for each: of starting states, and of all that an explorer draws
EVAL_SEEDS = (1, 2, 3, 4, 5)
# Explorers that only experiments have a name for
EXPERIMENTAL: dict[str, Explorer] = {**ABLATIONS, "prior, 10 exploration episodes": Prior(n_exploration_episodes=10)}
# A table of fewer says so
MIN_RUNS = 5
# Of the validation tasks, when a family counts as learned
SOLVED_SHARE = 0.8

Raw = Mapping[str, np.ndarray]


def evaluate(cell: Cell, model: Model, trained_with: Any, keep: Callable[[str, Callable[[], KwArgs]], KwArgs]) -> KwArgs:
    """
    :param cell: says which evaluations
    :param model: at the end of its training
    :param trained_with: explorer in the hyperparameters of its training, whose settings are used where an evaluation is by the
        explorer of that name. All others are the defaults of this version, whatever they were when the model was trained
    :param keep: of the name of an evaluation and what makes its arrays to these arrays, which may be there already
    :return: ``returns_<evaluation>`` float32 and ``successes_<evaluation>`` bool, (n_eval_seeds, n_tasks, n_episodes); and
        ``calibration``, see :func:`sb3_htr.experiments.calibration.calibration`
    """
    arrays: KwArgs = {}
    for evaluation in cell.evaluations:
        arrays |= keep(evaluation.name, partial(_evaluate_by, evaluation, cell, model, trained_with))
    return {**arrays, "calibration": calibration(model, cell.env_id, cell.env_kwargs, cell.n_episodes)}


def check_evaluations(cell: Cell, trained_with: Any = None) -> None:
    """
    Before a training, at whose end it would be said hours later.

    :param cell: says which evaluations
    :param trained_with: explorer as the hyperparameters of its training give it
    :raises ValueError: for an explorer or arguments of the env that there are not
    """
    for evaluation in cell.evaluations:
        try:
            _explorer(evaluation.explorer, trained_with)
            if evaluation.tested_on:  # else it is the env of the training, which says more of it
                make_task_vec_env(cell.env_id, env_kwargs={**cell.env_kwargs, **evaluation.tested_on}).close()
        except (ValueError, TypeError) as error:
            raise ValueError(f"{cell.label} could not be evaluated by {evaluation.name!r}: {error}") from error


def _evaluate_by(evaluation: Evaluation, cell: Cell, model: Model, trained_with: Any) -> KwArgs:
    env_kwargs = {**cell.env_kwargs, **evaluation.tested_on}
    env = make_task_vec_env(cell.env_id, len(family_of(cell.env_id, env_kwargs).test_tasks), env_kwargs=env_kwargs)
    explorer = _explorer(evaluation.explorer, trained_with)
    records = [
        evaluate_adaptation(model, env, n_episodes=cell.n_episodes, explorer=explorer, seed=seed) for seed in EVAL_SEEDS
    ]
    env.close()
    returns, successes = map(np.stack, zip(*records, strict=True))
    return {f"returns_{evaluation.name}": returns.astype(np.float32), f"successes_{evaluation.name}": successes}


def _explorer(name: str, trained_with: Any) -> Any:
    if name in EXPERIMENTAL or name == OWN:
        return EXPERIMENTAL.get(name, name)
    return to_explorer(trained_with if name_of(trained_with) == name else name)


def last_episode_return(raw: Raw, evaluation: str) -> np.ndarray:
    """(n_eval_seeds, n_tasks), return of the last adaptation episode."""
    return raw[f"returns_{evaluation}"][..., -1]


def success_rate(raw: Raw, evaluation: str) -> np.ndarray:
    """(n_eval_seeds, n_tasks), whether the last adaptation episode solved the task."""
    return raw[f"successes_{evaluation}"][..., -1].astype(np.float64)


def episodes_to_first_success(raw: Raw, evaluation: str) -> np.ndarray:
    """(n_eval_seeds, n_tasks), the first episode that solved the task; one more than there are if none did."""
    return first_success(raw[f"successes_{evaluation}"])


def env_steps_to_solved(raw: Raw, evaluation: str) -> np.ndarray:
    """(1, 1), env steps of the first evaluation with enough validation tasks solved; of one more than were made if never."""
    return _when_solved(raw, raw["timesteps"])


def seconds_to_solved(raw: Raw, evaluation: str) -> np.ndarray:
    """(1, 1), the same in seconds of training, evaluations included."""
    return _when_solved(raw, raw["elapsed_s"])


def is_solved(raw: Raw) -> np.ndarray:
    """(n_evaluations,) bool, whether enough validation tasks were."""
    return np.asarray(raw["solved"].mean(axis=1) >= SOLVED_SHARE)


def _when_solved(raw: Raw, clock: np.ndarray) -> np.ndarray:
    """What the clock (n_evaluations,) shows."""
    enough = is_solved(raw)
    return np.atleast_2d(float(clock[enough.argmax()] if enough.any() else clock[-1] * (len(clock) + 1) / len(clock)))


_ALL = (
    last_episode_return,
    success_rate,
    episodes_to_first_success,
    env_steps_to_solved,
    seconds_to_solved,
)
METRICS: dict[str, Callable[[Raw, str], np.ndarray]] = {metric.__name__: metric for metric in _ALL}
# Of the evaluations within a training, which are by the explorer of the method
OF_TRAINING = (env_steps_to_solved.__name__, seconds_to_solved.__name__)
# Of a run that was never solved, they are known to be larger than what they are counted as
TIMES = (env_steps_to_solved.__name__, seconds_to_solved.__name__)


def scores(raws: list[Any], metric: str, evaluation: str) -> np.ndarray:
    """
    :param raws: raw results of runs
    :param metric: name
    :param evaluation: name
    :return: (n_runs, n_eval_seeds, n_tasks)
    """
    return np.stack([METRICS[metric](raw, evaluation) for raw in raws])
