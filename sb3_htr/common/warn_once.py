"""Warnings that once is enough of."""

import warnings


class WarnOnce:
    """Remembers what it has warned of."""

    def __init__(self) -> None:
        self._warned: set[str] = set()

    def __call__(self, what: str, message: str, stacklevel: int) -> None:
        """
        :param what: is warned of once
        :param message: of the first time
        :param stacklevel: as of ``warnings.warn`` in place of this call
        """
        if what not in self._warned:
            self._warned.add(what)
            warnings.warn(message, stacklevel=stacklevel + 1)
