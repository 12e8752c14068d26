"""Runs the cells of experiments on an executor: skips what is done, tries again what failed, waits for what others run."""

import sys
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from datetime import timedelta
from pathlib import Path

from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.executors import HOPELESS
from sb3_htr.experiments.storage import storage_at

# Failures of a cell without a new checkpoint in between, after which it is given up
ATTEMPTS = 3
# Seconds between two looks at the storage, and between two lines in a file; looks take at most a tenth of the time
PERIOD, LINES = 5.0, 60.0


class Driver:
    """
    Knows of the cells of experiments what is in the storage of the runs, and no more: others may run them, too.

    :param cells: of one experiment, or of several
    :param runs: folder of all experiments' runs, or URL of fsspec, which all nodes see under this name
    :param executor: where cells run
    """

    def __init__(self, cells: Sequence[Cell], runs: str | Path, executor: Executor) -> None:
        self.cells, self.runs, self.executor = cells, storage_at(runs), executor
        self.failed: dict[str, str] = {}
        self._futures: dict[Future[bool], Cell] = {}
        self._failures: Counter[tuple[str, int]] = Counter()
        self._start: tuple[float, int] | None = None
        self._next_look = self._next_line = 0.0

    def run(self) -> None:
        """
        Until there is a result of each cell, or a reason why there is none.

        :raises ValueError: if cells failed, once all others are done
        """
        self.runs.prepare()
        try:
            while todo := self._look():
                submitted = {cell.label for cell in self._futures.values()}
                for cell in todo:
                    if cell.label not in submitted and not self.runs.is_claimed(cell):
                        self._futures[self.executor.submit(*self.runs.call(cell))] = cell
                self._wait()
        except BaseException:
            # What runs on this machine stops before its next rollout, with a checkpoint
            self.executor.shutdown(wait=True, cancel_futures=True)
            raise
        self.executor.shutdown()
        # What was given up here may have been done elsewhere
        self.runs.look(self.cells)
        for cell in filter(self.runs.is_finished, self.cells):
            self.failed.pop(cell.label, None)
        if self.failed:
            reasons = " ".join(f"{name}: {reason}" for name, reason in self.failed.items())
            raise ValueError(
                f"{len(self.failed)} of {len(self.cells)} cells failed (see log.txt in {self.runs}; the same command tries "
                f"them again). {reasons}"
            )

    def todo(self) -> list[Cell]:
        """
        :return: cells that have no result, and were not given up
        """
        self.runs.look(self.cells)
        return [cell for cell in self.cells if not self.runs.is_finished(cell) and cell.label not in self.failed]

    def line(self, todo: Sequence[Cell]) -> str:
        """
        :param todo: cells that have no result
        :return: progress: done, running, time left. Env steps are what is counted, up to the latest checkpoints
        """
        total, now = sum(cell.n_timesteps for cell in self.cells), time.monotonic()
        left = self._n_steps_left(todo)
        given_up = self._n_steps_left([cell for cell in self.cells if cell.label in self.failed])
        done = total - left - given_up
        start, before = self._start = self._start or (now, done)
        n_running = sum(self.runs.is_claimed(cell) for cell in todo)
        parts = [f"{len(self.cells) - len(todo) - len(self.failed)} of {len(self.cells)} cells done", f"{n_running} running"]
        parts += [f"{len(self.failed)} failed"] if self.failed else []
        parts += [f"{100 * done // max(total, 1)} % of the env steps"]
        if done > before:
            parts += [f"{timedelta(seconds=round(left * (now - start) / (done - before)))} left"]
        return ", ".join(parts)

    def _n_steps_left(self, cells: Sequence[Cell]) -> int:
        return sum(max(cell.n_timesteps - self.runs.n_steps(cell), 0) for cell in cells)

    def _look(self) -> list[Cell]:
        start = time.monotonic()
        todo = self.todo()
        if start >= self._next_line or not todo:
            print(self.line(todo), flush=True)
            self._next_line = start + LINES
        self._next_look = time.monotonic() + max(PERIOD, 10 * (time.monotonic() - start))
        return todo

    def _wait(self) -> None:
        """Until nothing runs here, or it is time to look at what others did."""
        while (timeout := self._next_look - time.monotonic()) > 0:
            if not self._futures:
                time.sleep(timeout)
            for future in wait(self._futures, timeout, FIRST_COMPLETED).done:
                self._end(self._futures.pop(future), future)
                if not self._futures:
                    return

    def _end(self, cell: Cell, future: Future[bool]) -> None:
        error = future.exception()
        self.runs.look([cell])
        if isinstance(error, Exception):
            # Ray's text is a traceback, with the error at its end
            self._fail(
                cell,
                f"{type(error).__name__}: {error}".strip().splitlines()[-1],
                isinstance(error, HOPELESS) and cell.device == "cpu",
            )
        elif error is not None:  # of this process alone: it, or a callback of its training, was told to stop
            print(f"{cell.label} was interrupted, and is left where it is.", file=sys.stderr, flush=True)
            self.failed[cell.label] = "it was interrupted"
        elif future.result() and not (self.runs.is_finished(cell) or self.runs.is_claimed(cell)):
            self._fail(cell, f"its node has a result that is not in {self.runs} here: give --runs that all nodes see.")

    def _fail(self, cell: Cell, reason: str, hopeless: bool = False) -> None:
        at = cell.label, self.runs.n_steps(cell)
        self._failures[at] += 1
        n_failures = self._failures[at]
        given_up = hopeless or n_failures == ATTEMPTS
        what = "failed" + (f" {n_failures} times" * (n_failures > 1) if given_up else ", and is tried again")
        print(f"{cell.label} {what} at {at[1]:,} env steps: {reason}", file=sys.stderr, flush=True)
        if given_up:
            self.failed[cell.label] = f"{what}: {reason}"
