"""What the C library does with memory that is freed."""

import ctypes

# Parameters of mallopt, see malloc.h
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3


def keep_freed_memory() -> bool:
    """
    Ask the C library not to give freed memory back to the operating system.

    At the paper's sizes every update allocates and frees the same large arrays. Given back in between, each of their pages is
    fetched anew: thousands of them in an update, for 4 % of its time, measured once. For processes that train and do little
    else; only glibc can be asked.

    :return: whether it will
    """
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return False
    # The largest value that glibc accepts, and any large one
    return bool(mallopt(M_MMAP_THRESHOLD, 2**25)) and bool(mallopt(M_TRIM_THRESHOLD, 2**30))
