"""Where cells run: a ``concurrent.futures.Executor``, in which each call has a process, with one thread, to itself."""

import os
import signal
import socket
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import suppress
from multiprocessing import get_context, parent_process
from threading import Lock, Thread
from typing import Any, TypeVar
from urllib.parse import urlsplit

from sb3_htr.common.divergence import DivergedError

T = TypeVar("T")
# Of a GPU, for a run: five were trained side by side on one, docs/performance.md
GPU_SHARE = 0.2
# Seconds: a node on which calls fail sooner, as where a disk is full, is kept busy so long, or it would take the whole queue
FAST = 60.0
# Failures of the cell, which come again, bit for bit, on a CPU of the kind. A ValueError, as of a wrong setting, may be of the
# node alone: a GPU that is busy, a file that is torn there, another version of a package
HOPELESS = (DivergedError,)


class SerialExecutor(Executor):
    """Each call at once, in this process: for one cell, where something else sees to processes, as Slurm does."""

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class Processes(ThreadPoolExecutor):
    """
    Each call in a new process of this machine: one that is killed takes no other with it.

    :param n: processes at a time, each with one thread
    """

    def __init__(self, n: int) -> None:
        super().__init__(n)
        # They get the environment of this one; torch and BLAS would take all cores each
        self._omp_num_threads = os.environ.get("OMP_NUM_THREADS")
        os.environ["OMP_NUM_THREADS"] = "1"
        self._running: set[int] = set()
        self._ends, self._lock = False, Lock()

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        return super().submit(self._in_a_process, fn, *args, **kwargs)

    def _in_a_process(self, fn: Callable[..., T], *args: Any, **kwargs: Any) -> T:
        with ProcessPoolExecutor(1, get_context("spawn"), initializer=_begin_in_a_process) as process:
            pid = process.submit(os.getpid).result()
            with self._lock:
                if self._ends:
                    raise KeyboardInterrupt
                self._running.add(pid)
            try:
                return process.submit(fn, *args, **kwargs).result()
            finally:
                with self._lock:
                    self._running.discard(pid)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """
        :param wait: for what runs
        :param cancel_futures: end what runs, too: it has the same interrupt as this process, and stops with a checkpoint
        """
        super().shutdown(wait=False, cancel_futures=cancel_futures)
        try:
            while cancel_futures:
                with self._lock:
                    self._ends = True
                    # On Windows, the terminal's Ctrl-C has reached them, and os.kill would end them without a checkpoint
                    for pid in self._running if os.name == "posix" else ():
                        with suppress(OSError):
                            os.kill(pid, signal.SIGINT)
                try:
                    return super().shutdown(wait)
                except KeyboardInterrupt:  # a second one: at once
                    continue
            super().shutdown(wait)
        finally:
            if self._omp_num_threads is None:
                os.environ.pop("OMP_NUM_THREADS", None)
            else:
                os.environ["OMP_NUM_THREADS"] = self._omp_num_threads


def _begin_in_a_process() -> None:
    """
    The terminal's Ctrl-C is for the driver, which hands it on once. End this process when that one was killed: the next driver
    lets its cell go on from a checkpoint.
    """
    if os.name == "posix":
        os.setpgrp()
    for signal_ in (signal.SIGINT, signal.SIGTERM):  # a script's background commands ignore the one
        signal.signal(signal_, signal.default_int_handler)

    def watch() -> None:
        parent = parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    Thread(target=watch, daemon=True).start()


class Ray(Executor):
    """
    Each call as a task of one CPU on a Ray cluster, and a fifth of a GPU where it is for one, in a worker process of its own.
    What fails is not tried again by Ray: the driver does, and says so.

    :param address: of the cluster's head, or ``"auto"``
    :param device: torch device of the calls
    :raises ConnectionError: if no cluster answers there
    :raises ValueError: if it has no GPU, and the device is one
    """

    def __init__(self, address: str, device: str = "cpu") -> None:
        import ray

        self._ray = ray
        try:
            if address != "auto":
                # Ray waits for minutes where nobody answers
                parts = urlsplit(address if "://" in address else f"//{address}")
                socket.create_connection((parts.hostname or "", parts.port or 0), timeout=5).close()
            ray.init(address, log_to_driver=False)
        except (OSError, ValueError, RuntimeError) as error:
            raise ConnectionError(
                f"No Ray cluster answers at {address} ({error}): start one with `ray start --head`, or leave --ray out."
            ) from None
        n_gpus = 0 if device == "cpu" else GPU_SHARE
        if n_gpus and not ray.cluster_resources().get("GPU"):
            ray.shutdown()
            # Ray would wait for one, without a word
            raise ValueError(f"The Ray cluster at {address} has no GPU: start a node with one, or leave --device out.")
        self._call = ray.remote(num_cpus=1, num_gpus=n_gpus, max_calls=1, max_retries=0)(_call)

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        future: Future[T] = self._call.remote(fn, *args, **kwargs).future()
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """
        :param wait: not used
        :param cancel_futures: not used: what runs ends when the driver leaves the cluster
        """
        self._ray.shutdown()


def _call(fn: Callable[..., T], *args: Any, **kwargs: Any) -> T:
    start = time.monotonic()
    try:
        return fn(*args, **kwargs)
    except HOPELESS:
        raise
    except Exception:
        time.sleep(max(FAST - (time.monotonic() - start), 0))
        raise
