"""Draws docs/concept.svg, the idea of the library in three pictures: ``python tools/concept_figure.py``."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Arc, Circle

from sb3_htr.zoo.plots.style import BLUE, GREEN, GREY, ORANGE

CONCEPT = Path(__file__).parents[1] / "docs" / "concept.svg"
RADIUS = 0.2
INK = "#222222"


def goal(axes: plt.Axes, degrees: float, colour: str) -> tuple[float, float]:
    """A goal on the semicircle, and where its centre is."""
    centre = on_circle(degrees)
    axes.add_patch(Circle(centre, RADIUS, facecolor=colour, alpha=0.35, edgecolor=colour))
    return centre


def on_circle(degrees: float, radius: float = 1.0) -> tuple[float, float]:
    """A point as far from the start, in this direction."""
    return radius * float(np.cos(np.radians(degrees))), radius * float(np.sin(np.radians(degrees)))


def walk(end: tuple[float, float], bend: float) -> np.ndarray:
    """From the start to a point, not straight, in eight steps. Positions (9, 2)."""
    share = np.linspace(0, 1, 9)[:, None]
    return share * np.array(end) + bend * np.sin(np.pi * share) * np.array([-end[1], end[0]])


def draw(axes: plt.Axes, path: np.ndarray, colour: str, width: float = 2.0) -> None:
    """A path that ends where the robot is."""
    axes.plot(*path.T, color=colour, linewidth=width, marker="o", markersize=width + 0.5, markevery=range(1, len(path)))


def label(axes: plt.Axes, x: float, y: float, text: str, side: str = "center") -> None:
    """A word beside what it names."""
    axes.text(x, y, text, ha=side, va="center", fontsize=9.5, color=INK)


def say(axes: plt.Axes, title: str, first: str, second: str) -> None:
    """Title above, two lines below, the second one as the consequence."""
    axes.set_title(title, fontsize=12.5, color=INK, pad=8)
    axes.text(0, -0.36, first, ha="center", va="center", fontsize=10.5, color=INK)
    axes.text(0, -0.60, second, ha="center", va="center", fontsize=10.5, color=INK, weight="bold")


def main() -> None:
    """The three pictures, side by side."""
    figure, (miss, hindsight, adapt) = plt.subplots(1, 3, figsize=(12, 3.3))
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.0, top=0.9, wspace=0.03)
    for axes in (miss, hindsight, adapt):
        axes.add_patch(Arc((0, 0), 2, 2, theta1=0, theta2=180, color=GREY, linestyle=":", linewidth=1.2))
        axes.plot(0, 0, "x", color=INK, markersize=7, markeredgewidth=2, zorder=4)
        axes.set(xlim=(-1.5, 1.5), ylim=(-0.7, 1.34), aspect="equal")
        axes.axis("off")
    reached = 62.0
    path = walk(on_circle(reached, 1.04), 0.18)

    x, y = goal(miss, 140, GREEN)
    draw(miss, path, GREY)
    label(miss, x, y + 0.32, "hidden goal")
    say(miss, "1   Meta-training: an episode misses", "rewards  0  0  0  0  0  0  0  0", "nothing to infer, nothing to learn")

    x, y = goal(hindsight, reached, ORANGE)
    draw(hindsight, path, BLUE)
    label(hindsight, x + 0.28, y + 0.06, "hindsight task:\nwhat it did reach", "left")
    learnt = "z is learnt, and how to act with it"
    say(hindsight, "2   HTR: the same steps, another task", "rewards  0  0  0  0  0  0  0.9  1", learnt)

    hidden = goal(adapt, 105, GREEN)
    for number, (degrees, bend) in enumerate(((20.0, 0.1), (165.0, -0.1)), start=1):
        draw(adapt, walk(on_circle(degrees, 1.05), bend), GREY, 1.2)
        label(adapt, *on_circle(degrees, 1.18), str(number))
    draw(adapt, walk(hidden, -0.08), BLUE)
    label(adapt, hidden[0], hidden[1] + 0.26, "3, 4, 5 ...")
    tried = "episodes 1, 2 search; episode 3 is rewarded"
    say(adapt, "3   Meta-test: a new task, by trying", tried, "the posterior over z narrows")

    plt.rcParams["svg.hashsalt"] = "concept"  # the same file each time
    figure.savefig(CONCEPT, metadata={"Date": None}, facecolor="white")
    plt.close(figure)


if __name__ == "__main__":
    main()
