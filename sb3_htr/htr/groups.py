"""Groups of rows one after another, as the transitions of a list of episodes."""

import numpy as np


def first_rows(lengths: np.ndarray) -> np.ndarray:
    """
    :param lengths: (n,) int, rows of each group
    :return: (n,) int, the first row of each
    """
    return np.cumsum(lengths) - lengths


def positions(lengths: np.ndarray) -> np.ndarray:
    """
    :param lengths: (n,) int, rows of each group
    :return: (sum of the lengths,) int, of each row the place in its group: 0, 1, ... for each of them
    """
    return np.arange(lengths.sum()) - np.repeat(first_rows(lengths), lengths)


def ascending(values: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """
    :param values: (sum of the lengths,) int, 0 or more, those of the first group first
    :param lengths: (n,) int, values of each group
    :return: the same, ordered within each group
    """
    group = np.repeat(np.arange(len(lengths)) * (values.max(initial=0) + 1), lengths)
    return np.sort(values + group) - group


def evenly_spread(lengths: np.ndarray, size: int, rewards: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """
    What of an episode becomes its context: steps at equal distances, the last one among them, which may be all that counts.

    :param lengths: (n,) int, number of steps of each episode, at least 1
    :param size: number of steps to take of each, at most
    :param rewards: (sum of the lengths,), those of the first episode first, 0 where a step earns nothing beside what is
        task-free. Where none of the steps taken earns something and others do, the one that earns most takes the place of
        the step next to it: a goal that was passed between two of them would be no evidence
    :return: the steps taken, those of the first episode first, and (n,) int, how many are of each
    """
    taken = np.minimum(lengths, size)
    steps = (positions(taken) + 1) * np.repeat(lengths, taken) // np.repeat(taken, taken) - 1
    if rewards is None or len(lengths) == 0:
        return steps, taken
    first, first_taken = first_rows(lengths), first_rows(taken)
    seen = np.maximum.reduceat(rewards[steps + np.repeat(first, taken)], first_taken) > 0
    # There are few
    for i in np.flatnonzero(~seen & (np.maximum.reduceat(rewards, first) > 0)):
        best = rewards[first[i] : first[i] + lengths[i]].argmax()
        own = steps[first_taken[i] : first_taken[i] + taken[i]]
        own[np.abs(own - best).argmin()] = best
    return steps, taken


def stratified_draw(rng: np.random.Generator, ranges: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """
    Draw up to ``width`` integers from each of several ranges, evenly spread: one from each of as many parts of the range.

    Every integer of a range has the same chance to be drawn, and none is drawn twice: a product of Gaussians would count a
    duplicate in the context as evidence, and a loss that is a mean gains nothing from one.

    :param rng: source of randomness
    :param ranges: (n, 2) int, first and last + 1 of each range
    :param width: how many to draw from each range; all of it, where it holds fewer
    :return: the integers, one range after another, and (n,) int, how many of them are of each range
    """
    length = ranges[:, 1] - ranges[:, 0]
    size = np.minimum(length, width)
    # Parts differ in size by one, which a random rotation of the range makes up for
    rotation = (rng.random(len(ranges)) * length).astype(np.int64)
    # As many random numbers for each range, so that what is drawn from one does not depend on the others
    uniform = rng.random((len(ranges), width))[np.arange(width) < size[:, None]]
    n = np.repeat(size, size)
    part = positions(size)
    range_length = np.repeat(length, size)
    first = part * range_length // n
    end = (part + 1) * range_length // n
    position = first + (uniform * (end - first)).astype(np.int64) + np.repeat(rotation, size)
    position -= np.where(position >= range_length, range_length, 0)
    return position + np.repeat(ranges[:, 0], size), size
