"""What all pictures share."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt

from sb3_htr.common.atomic import atomic_path

# Okabe and Ito's colours, told apart by all kinds of colour vision
COLOURS = ["#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#999999"]
BLUE, ORANGE, GREEN, GREY = *COLOURS[:3], COLOURS[6]


def save(figure: plt.Figure, path: Path) -> None:
    """
    :param figure: to save and close
    :param path: picture to write
    """
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=120, bbox_inches="tight")
    plt.close(figure)


def span_unit_if_flat(axes: plt.Axes) -> None:
    """
    :param axes: whose values may be all the same, as of an agent that has found nothing; a tiny range would show noise
    """
    low, high = axes.dataLim.intervaly
    if low == high:
        axes.set_ylim(min(low, 0.0) - 0.04, max(high, 1.0) + 0.04)
