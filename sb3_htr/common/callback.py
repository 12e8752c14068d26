"""Callbacks of an algorithm beside those of its user."""

from collections.abc import Iterator

from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback
from stable_baselines3.common.type_aliases import MaybeCallback


def followed_by(callback: MaybeCallback, last: BaseCallback) -> CallbackList:
    """
    :param callback: of a user, in any form that ``learn`` takes
    :param last: called after it
    :return: both, not initialized yet: what a callback sets up is to be set up once
    """
    if isinstance(callback, list):
        callback = CallbackList(callback)
    return CallbackList([callback if isinstance(callback, BaseCallback) else ConvertCallback(callback), last])


def parts_of(callback: BaseCallback) -> Iterator[BaseCallback]:
    """
    :param callback: may have others in it
    :return: itself and all of these
    """
    yield callback
    others = (getattr(callback, name, None) for name in ("callback", "callback_on_new_best"))
    for part in (*getattr(callback, "callbacks", ()), *others):
        if isinstance(part, BaseCallback):
            yield from parts_of(part)
