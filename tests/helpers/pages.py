"""Code that is there to be read, made one that runs in a moment."""

import re

SMALL = "n_episodes_per_task=2, learning_starts=800, gradient_steps=5, policy_kwargs={'net_arch': [16], 'encoder_arch': [16]}"


def of_a_moment(code: str) -> str:
    """
    :param code: which trains for seconds or minutes
    :return: the same with small networks and two small rollouts in each training of the point robot
    """
    code = re.sub(r'(\w+\(\s*"MlpPolicy",\s*"SparsePointRobot-v0")', rf"\1, {SMALL}", code)
    return re.sub(r"model\.learn\([\d_]*", "model.learn(1600", code).replace("gradient_steps=100", "gradient_steps=5")
