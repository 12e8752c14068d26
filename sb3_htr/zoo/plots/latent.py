"""What the posteriors of the adapted tasks look like: a map of the latent space."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from sb3_htr.zoo.plots.style import GREY, save


def principal_axes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    :param points: (n, dim)
    :return: their centre (dim,), the two directions of largest variance (2, dim) and the share of the variance along each
    """
    centre = points.mean(axis=0)
    _, scale, directions = np.linalg.svd(points - centre, full_matrices=False)
    n = min(2, len(directions))
    axes, shares = np.zeros((2, points.shape[1])), np.zeros(2)
    axes[:n], shares[:n] = directions[:n], (scale**2 / max((scale**2).sum(), 1e-12))[:n]
    return centre, axes, shares


def task_colours(tasks: np.ndarray) -> tuple[np.ndarray, str]:
    """
    :param tasks: (n, task_dim)
    :return: a number for each task, and what it is
    """
    if tasks.shape[1] == 2:
        return np.degrees(np.arctan2(tasks[:, 1], tasks[:, 0])), "angle of the goal (degrees)"
    return tasks[:, 0], "task" if tasks.shape[1] == 1 else "first component of the task"


def plot_latent_space(
    tasks: np.ndarray, mean: np.ndarray, deviation: np.ndarray, known_z: np.ndarray, path: Path, title: str
) -> None:
    """
    Posteriors of tasks after their adaptation, in the plane of the largest differences between their means.

    :param tasks: (n, task_dim), n >= 2
    :param mean: (n, latent_dim), posterior means
    :param deviation: (n, latent_dim), posterior standard deviations
    :param known_z: (m, latent_dim), z of training tasks, drawn behind
    :param path: picture to write
    :param title: of the figure
    """
    centre, directions, shares = principal_axes(mean)
    points = (mean - centre) @ directions.T
    colours, meaning = task_colours(tasks)
    figure = Figure(figsize=(6.4, 5), layout="constrained")
    axes = figure.subplots()
    if len(known_z):
        known = (known_z - centre) @ directions.T
        axes.plot(known[:, 0], known[:, 1], "x", color=GREY, markersize=5, label="training tasks, z that solves them best")
    label = f"adapted tasks, posterior mean (standard deviation {deviation.mean():.2g})"
    dots = axes.scatter(
        points[:, 0], points[:, 1], c=colours, cmap="viridis", s=45, edgecolors="black", linewidths=0.5, zorder=3, label=label
    )
    figure.colorbar(dots, label=meaning)
    axes.set_xlabel(f"first principal component of z ({shares[0]:.0%} of the variance)")
    axes.set_ylabel(f"second principal component of z ({shares[1]:.0%} of the variance)")
    axes.set_title(title)
    axes.set_aspect("equal", adjustable="datalim")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.12))
    save(figure, path)
