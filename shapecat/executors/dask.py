"""Adapter for Dask: its client behind the interface of `concurrent.futures`."""

import logging
from concurrent.futures import Future
from concurrent.futures import wait as wait_for
from contextlib import suppress
from typing import Any

from shapecat.errors import ConfigError, ShapecatError
from shapecat.executors.cores import single_threaded
from shapecat.executors.interface import WorkerExecutor

__all__ = ["open_dask"]

_ANSWER_S = 30
_CLOSE_S = 10
"""Longest waits for the scheduler to answer, and for the client and its cluster to close."""


class _DaskExecutor(WorkerExecutor):
    """Runs calls through a Dask client; closes the client, and the cluster started here.

    The client's own executor is not used: if the scheduler is lost while it fetches a result, the
    future of that result never ends.
    """

    def __init__(self, client: Any, cluster: Any) -> None:
        self._client, self._cluster = client, cluster
        self._futures: set[Future[Any]] = set()

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit a call; raise `ShapecatError` if the scheduler was lost and did not come back."""
        if self._is_cut_off():
            msg = "the Dask scheduler is gone: start it again, and run the same command again"
            raise ShapecatError(msg)
        # Not pure: a second attempt must not return the result of the first.
        task = self._client.submit(fn, *args, pure=False, **kwargs)
        future: Future[Any] = Future()
        self._futures.add(future)
        future.add_done_callback(self._futures.discard)
        self._client.loop.add_callback(_deliver, task, future)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: FBT001, FBT002  as in the base class
        """Wait for the calls if asked to, and close the client, which cancels unfinished calls."""
        if wait and not cancel_futures:
            wait_for(self._futures.copy())
        self._close(_CLOSE_S)

    def lacks_workers(self) -> bool:
        """Return whether the scheduler has no worker yet, as in an adaptive cluster."""
        return not self._client.nthreads()

    def terminate(self) -> None:
        """Cancel waiting tasks, and end the workers started here."""
        self._close(1)

    def _is_cut_off(self) -> bool:
        """Return whether the client lost the scheduler for good; calls would fail or never run."""
        return self._client.status in {"closing", "closed"}

    def _close(self, timeout_s: float) -> None:
        for each in (self._client, self._cluster):
            if each is not None:
                with suppress(TimeoutError):
                    each.close(timeout=timeout_s)


async def _deliver(task: Any, future: Future[Any]) -> None:
    """Wait for a task of Dask, and give its result or error to ``future``."""
    try:
        result = await task
    except BaseException as error:  # noqa: BLE001  also a cancellation, which is a lost scheduler
        future.set_exception(error)
    else:
        future.set_result(result)


def open_dask(workers: int, address: str | None) -> WorkerExecutor:
    """Connect to a scheduler, or start one with processes on this machine.

    The parameters are as for `open_executor`.

    Raises
    ------
    ConfigError : Dask is not installed, or the scheduler does not answer.
    """
    try:
        from distributed import Client, LocalCluster  # noqa: PLC0415  an extra
    except ImportError as error:
        msg = "--executor dask needs Dask: in a clone of shapecat, pip install '.[cluster]'"
        raise ConfigError(msg) from error
    logging.getLogger("distributed").setLevel(logging.WARNING)  # its log would bury our progress
    if address is None:
        with single_threaded():
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",  # None means port 8787, which may be taken
                memory_limit=0,
            )
        return _DaskExecutor(Client(cluster), cluster)
    try:
        return _DaskExecutor(Client(address, timeout=_ANSWER_S), None)
    except (OSError, TimeoutError, ValueError) as error:
        msg = f"--scheduler {address}: no Dask scheduler answers: {error}"
        raise ConfigError(msg) from error
