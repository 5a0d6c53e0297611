"""Calls in other processes, whose results come back into the loop of the session, and tasks in this one."""

import asyncio
from collections.abc import Callable, Coroutine
from concurrent.futures import BrokenExecutor, Executor, Future
from typing import Any

from calgraph.errors import Rejected

Post = Callable[[Callable[[], None]], object]
"""Has a function called soon in the thread of the session, from any thread."""


class JobQueue:
    """Runs no more calls at a time than there are processes: the most urgent one is chosen when one is free.

    Args:
        executor: runs the calls.
        workers: number of its processes.
        post: has results handled in the thread of the session.
        after: called there after each of them.
    """

    def __init__(self, executor: Executor, workers: int, post: Post, after: Callable[[], object]) -> None:
        self._executor, self._workers, self._post, self._after = executor, workers, post, after
        self.running = 0
        """Number of calls under way."""
        self.closed = False
        """Whether results are discarded."""
        self.problem = ""
        """Why nothing is computed any more; empty if it is."""

    @property
    def idle(self) -> bool:
        """Whether a process is free."""
        return self.running < self._workers and not self.closed

    def run(self, done: Callable[[Any], object], function: Callable[..., Any], *arguments: Any) -> None:
        """Starts a call.

        Args:
            done: called with its result, or with its error as :class:`Rejected`; not if a process was killed.
            function: defined at module level.
            arguments: of the call.
        """
        try:
            future: Future[Any] = self._executor.submit(function, *arguments)
        except RuntimeError as error:  # a process was killed, or the pool is shut down
            self._break(error)
            return
        self.running += 1
        future.add_done_callback(lambda one: self._post(lambda: self._finish(one, done)))

    def _finish(self, future: Future[Any], done: Callable[[Any], object]) -> None:
        self.running -= 1
        if self.closed or future.cancelled():
            return
        error = future.exception()
        if isinstance(error, BrokenExecutor):
            self._break(error)
        else:
            done(Rejected(str(error)) if error else future.result())
        self._after()

    def _break(self, error: BaseException) -> None:
        self.closed = True
        self.problem = f"a process was killed, perhaps because memory ran out ({error})"


async def run_until_one_ends(*coroutines: Coroutine[Any, Any, object]) -> None:
    """Runs all until the first ends, whose exception is raised, and cancels the others."""
    tasks = [asyncio.create_task(one) for one in coroutines]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
