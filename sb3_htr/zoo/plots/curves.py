"""Curves over several runs: interquartile mean and interval."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import offset_copy

from sb3_htr.zoo.plots.intervals import iqm_interval
from sb3_htr.zoo.plots.style import COLOURS, curve_styles, save, span_unit_if_flat

# On a curve of more points, on some of them
N_MARKERS = 12
# Hollow and each of another shape, so that of curves that coincide, as where nothing is solved, all are seen
MARKERS = dict(zip(COLOURS, "oXD^vxs<>*", strict=True))


def marked_line(axes: Axes, x: np.ndarray, y: np.ndarray, colour: str, style: str, label: str) -> None:
    """
    Draw a line with the marker of its colour.

    :param axes: where
    :param x: (n,)
    :param y: (n,)
    :param colour: one of :data:`~sb3_htr.zoo.plots.style.COLOURS`
    :param style: of the line, matplotlib's
    :param label: for the legend
    """
    (line,) = axes.plot(x, y, style, color=colour, label=label, markersize=5, markerfacecolor="none")
    line.set(marker=MARKERS[colour], markevery=-(-len(x) // N_MARKERS))


def band(axes: Axes, x: np.ndarray, scores: np.ndarray, colour: str, style: str, label: str, alpha: float = 0.2) -> None:
    """
    Draw the IQM over runs at each x, with its interval.

    :param axes: where
    :param x: (n,)
    :param scores: (n_runs, n) or (n_runs, n_eval_seeds, n_tasks, n)
    :param colour: of line and band, one of :data:`~sb3_htr.zoo.plots.style.COLOURS`
    :param style: of the line, matplotlib's
    :param label: for the legend
    :param alpha: of the interval: less where many lie above each other
    """
    points = np.array([iqm_interval(scores[..., i]) for i in range(len(x))])
    marked_line(axes, x, points[:, 0], colour, style, label)
    axes.fill_between(x, points[:, 1], points[:, 2], color=colour, alpha=alpha, linewidth=0)


def finish(figure: Figure, path: Path, title: str, legend_columns: int = 2) -> None:
    """
    :param figure: to make alike all others, and to save
    :param path: picture to write
    :param title: of the figure
    :param legend_columns: one for labels so long that two beside each other would narrow the axes
    """
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25)
        if axes.get_legend_handles_labels()[0]:
            # As far below as the axis needs for its ticks and its label, however high the axes are
            place = offset_copy(axes.transAxes, figure, y=-0.42, units="inches")
            below: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, 0), "bbox_transform": place}
            # Handles so long that dashes are seen beside the marker
            axes.legend(ncols=legend_columns, frameon=False, fontsize=8, handlelength=4, **below)
    figure.suptitle(title, fontsize=11)
    save(figure, path)


class Curve(NamedTuple):
    """
    What several runs did, at each of n points.

    :param x: (n,)
    :param returns: (n_runs, n)
    :param successes: (n_runs, n), share of tasks solved
    :param method: of the runs, which gives the curve its colour
    """

    x: np.ndarray
    returns: np.ndarray
    successes: np.ndarray
    method: str


def plot_curves(curves: dict[str, Curve], path: Path, title: str, x_label: str, y_label: str) -> None:
    """
    Left: returns. Right: tasks solved.

    :param curves: label and curve
    :param path: picture to write
    :param title: of the figure
    :param x_label: of both axes
    :param y_label: of returns
    """
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    styles = curve_styles([curve.method for curve in curves.values()])
    for (colour, style), (label, curve) in zip(styles, curves.items(), strict=True):
        # matplotlib leaves out those that begin with _
        label = f"{' ' * label.startswith('_')}{label} ({len(curve.returns)} seed{'s' * (len(curve.returns) > 1)})"
        band(left, curve.x, curve.returns, colour, style, label)
        band(right, curve.x, 100 * curve.successes, colour, style, label)
    right.set_ylim(-4, 104)
    left.set_ylabel(y_label)
    right.set_ylabel("share of tasks solved (%)")
    for axes in (left, right):
        axes.set_xlabel(x_label)
        axes.xaxis.get_major_locator().set_params(integer=True)
    span_unit_if_flat(left)
    # Of three seeds and fewer, the IQM is the mean, and its bootstrap interval their range
    seeds = {min(len(curve.returns), 4) for curve in curves.values()}
    shown = {4: "IQM over seeds, 95 % interval", 3: "mean and range of 3 seeds", 2: "mean and range of 2 seeds"}
    finish(figure, path, "; ".join([title, *(text for n, text in shown.items() if n in seeds)]))
