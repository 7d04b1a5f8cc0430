"""Adapter for Ray: its remote functions behind the interface of `concurrent.futures`."""

from concurrent.futures import Future
from typing import Any

from shapecat.errors import ConfigError
from shapecat.executors.cores import THREAD_LIMITS
from shapecat.executors.interface import WorkerExecutor

__all__ = ["RayExecutor"]

_STORE_BYTES = 100 * 2**20
"""Shared memory for arguments and results, which are small; Ray's default is 30 % of the memory."""


class RayExecutor(WorkerExecutor):
    """Runs each call as a Ray task on one core."""

    def __init__(self, workers: int, address: str | None) -> None:
        """Connect to a cluster, or start one with ``workers`` cores on this machine.

        The parameters are as for `open_executor`.

        Raises
        ------
        ConfigError : Ray is not installed or does not start, or no cluster answers.
        """
        try:
            import ray  # noqa: PLC0415  an extra
        except ImportError as error:
            msg = "--executor ray needs Ray: in a clone of shapecat, pip install '.[ray]'"
            raise ConfigError(msg) from error
        self._ray = ray
        variables = dict.fromkeys(THREAD_LIMITS, "1")
        local_cluster = {
            "num_cpus": workers,
            "include_dashboard": False,
            "object_store_memory": _STORE_BYTES,
        }
        cluster = {"address": address} if address else local_cluster
        try:
            ray.init(**cluster, runtime_env={"env_vars": variables}, log_to_driver=False)
        except (ConnectionError, RuntimeError, ValueError) as error:
            problem = f"--scheduler {address}: no Ray cluster answers"
            msg = f"{problem if address else '--executor ray: Ray does not start'}: {error}"
            raise ConfigError(msg) from error
        self._call = ray.remote(max_retries=0)(_call)  # once: the cluster keeps every copy
        self._running: set[Any] = set()

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Queue a call on the cluster; if its worker dies, the future raises without a retry."""
        reference = self._call.options(name=fn.__name__).remote(fn, *args, **kwargs)
        self._running.add(reference)
        future: Future[Any] = reference.future()
        future.add_done_callback(lambda _: self._running.discard(reference))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: FBT001, FBT002  as in the base class
        """Wait for running calls, or cancel them, and disconnect."""
        if cancel_futures:
            for reference in list(self._running):
                self._ray.cancel(reference, force=True)
        elif wait and self._running:
            self._ray.wait(list(self._running), num_returns=len(self._running))
        self._ray.shutdown()

    def terminate(self) -> None:
        """Cancel running calls and disconnect."""
        self.shutdown(wait=False, cancel_futures=True)


def _call(fn: Any, /, *args: Any, **kwargs: Any) -> Any:
    """Call a function on a worker."""
    return fn(*args, **kwargs)
