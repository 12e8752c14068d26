"""What random actions return, and scripts that are told the task: ``python examples/floor_and_ceiling.py [validation]``.

Each row is the mean over 100 tasks (20 for validation), five episodes and five seeds, with its standard error over tasks.
Random actions have fifty seeds, as they solve one episode in thousands.
"""

import sys

import gymnasium
import numpy as np

import htr_envs  # noqa: F401 registers the envs
from sb3_htr import evaluate_adaptation
from sb3_htr.rivals.scripted import Script, ScriptedAgent

N_EPISODES, SEEDS, RANDOM_SEEDS = 5, range(5), range(50)


def straight(observations: np.ndarray, tasks: np.ndarray) -> np.ndarray:
    """
    :param observations: (n, 2) positions of point robots
    :param tasks: (n, 2) goals
    :return: (n, 2) actions, towards the goals as fast as it goes
    """
    return np.clip((tasks - observations) / 0.1, -1, 1)


def drive(observations: np.ndarray, tasks: np.ndarray) -> np.ndarray:
    """
    :param observations: (n, 9) of wheeled robots
    :param tasks: (n, 2) goals
    :return: (n, 2) actions: turn to the goal, drive there and brake, backwards if that is nearer. Gains are the best of 72
        on the validation tasks
    """
    x, y, cos, sin, speed, _, turn_rate = observations.T[:7]
    ahead = cos * (tasks[:, 0] - x) + sin * (tasks[:, 1] - y)
    aside = cos * (tasks[:, 1] - y) - sin * (tasks[:, 0] - x)
    angle = np.arctan2(aside * np.sign(ahead), np.abs(ahead))
    far = np.hypot(ahead, aside) > 0.03  # there, it stands
    # As fast as it can still brake from, and no faster than it has turned
    wanted = np.sign(ahead) * np.sqrt(24 * np.abs(ahead)) * np.maximum(np.cos(angle), 0) ** 4
    forwards = 3 * (np.where(far, wanted, 0) - speed)
    turning = 0.2 * (np.where(far, 14 * angle, 0) - turn_rate)
    return np.clip(np.stack((forwards - turning, forwards + turning), axis=1), -1, 1)


def thrust(observations: np.ndarray, tasks: np.ndarray) -> np.ndarray:
    """
    :param observations: (n, 2) velocities of sledges
    :param tasks: (n, 1) target speeds, which it does not look at
    :return: (n, 2) actions: full thrust along one axis, which passes every speed
    """
    return np.tile([1.0, 0.0], (len(observations), 1))


def hold(observations: np.ndarray, tasks: np.ndarray) -> np.ndarray:
    """
    :param observations: (n, 2) velocities of sledges
    :param tasks: (n, 1) target speeds
    :return: (n, 2) actions: to the speed along both axes, as fast as it goes, and no further
    """
    return np.clip((tasks / np.sqrt(2) - 0.95 * observations) / 0.2, -1, 1)


SCRIPTS: dict[str, dict[str, Script | None]] = {
    "SparsePointRobot-v0": {"random actions": None, "straight": straight},
    "SparseWheeled-v0": {"random actions": None, "drive": drive},
    "SparseAnt-v0": {"random actions": None},
    "SparseTargetSpeed-v0": {"random actions": None, "thrust": thrust, "hold": hold},
}


def main(tasks: str = "test") -> None:
    """A line for each script."""
    print("| env | actions | return of an episode | episodes that solve |\n| --- | --- | --- | --- |")
    for env_id, scripts in SCRIPTS.items():
        space = gymnasium.make(env_id).action_space
        for name, script in scripts.items():
            agent = ScriptedAgent(space, script)
            seeds = RANDOM_SEEDS if script is None else SEEDS
            runs = [evaluate_adaptation(agent, env_id, tasks, N_EPISODES, seed=seed) for seed in seeds]
            returns, successes = (np.stack(arrays).mean(axis=(0, 2)) for arrays in zip(*runs, strict=True))
            error = returns.std(ddof=1) / len(returns) ** 0.5
            print(f"| {env_id} | {name} | {returns.mean():.2f} ± {error:.2f} | {successes.mean():.4f} |", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
