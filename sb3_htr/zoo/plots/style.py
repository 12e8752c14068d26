"""What all pictures share."""

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_htr.common.atomic import atomic_path
from sb3_htr.zoo.run.method import PRIOR, methods

# Okabe and Ito's colours, told apart by all kinds of colour vision, and three dark ones; grey is the last to be taken, as its
# bands are those of black, and so dark that it is not their pink to those who see no green
COLOURS = ["#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#882255", "#000000", "#332288", "#707070"]
BLUE, ORANGE, GREEN, GREY = *COLOURS[:3], COLOURS[-1]
LINES = ("-", "--", ":")


def curve_styles(names: Sequence[str]) -> list[tuple[str, str]]:
    """
    :param names: what the curves of a picture are of
    :return: colour and line of each. A method has one colour in all pictures, dashed under PEARL's own protocol; what is no
        method, or is there already, takes what is left
    """
    own = dict(zip((name for name in methods() if not name.endswith(PRIOR)), COLOURS, strict=False))
    own_styles = {f"{name}{end}": (colour, line) for name, colour in own.items() for end, line in (("", "-"), (PRIOR, "--"))}
    taken = {own_styles[name] for name in names if name in own_styles}
    every = [(colour, line) for line in LINES for colour in COLOURS]
    left = cycle([style for style in every if style not in taken] or every)
    first = [name in own_styles and name not in names[:i] for i, name in enumerate(names)]
    return [own_styles[name] if is_first else next(left) for name, is_first in zip(names, first, strict=True)]


def curve_colours(names: Sequence[str]) -> list[str]:
    """
    :param names: what the curves of a picture are of, whose lines tell something else
    :return: colour of each: that of its method, but no two alike as long as there are colours
    """
    styles = curve_styles(names)
    taken = [colour for colour, line in styles if line == "-"]
    colours = []
    for colour, line in styles:
        if line != "-":
            if colour in taken:
                colour = next((free for free in COLOURS if free not in taken), colour)
            taken.append(colour)
        colours.append(colour)
    return colours


def save(figure: Figure, path: Path) -> None:
    """
    :param figure: to save
    :param path: picture to write; its suffix says which kind, ``.png``, ``.svg`` or ``.pdf``
    """
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=120, bbox_inches="tight")


def span_unit_if_flat(axes: Axes) -> None:
    """
    :param axes: whose values may be all the same, as of an agent that has found nothing; a tiny range would show noise
    """
    low, high = axes.dataLim.intervaly
    if low == high:
        axes.set_ylim(min(low, 0.0) - 0.04, max(high, 1.0) + 0.04)
