"""Where tasks run: every executor is a `WorkerExecutor`.

Executors do not depend on the tasks. `local` needs no other package; `dask` and `ray`
are thin adapters for libraries in the extras ``cluster`` and ``ray``.
"""

from shapecat.errors import ConfigError
from shapecat.executors.cores import share_cores, single_threaded, usable_cores
from shapecat.executors.interface import WorkerExecutor
from shapecat.executors.local import LocalExecutor
from shapecat.executors.progress_receiver import ProgressReceiver, send_progress
from shapecat.executors.worker import WorkerLostError

__all__ = [
    "LocalExecutor",
    "ProgressReceiver",
    "WorkerExecutor",
    "WorkerLostError",
    "is_dropped",
    "is_lost",
    "open_executor",
    "send_progress",
    "share_cores",
    "single_threaded",
    "usable_cores",
]

_LOST = {
    *("WorkerLostError", "BrokenProcessPool"),
    "KilledWorker",  # Dask
    *("WorkerCrashedError", "NodeDiedError", "OutOfMemoryError"),  # Ray
}
_DROPPED = {"CancelledError", "FutureCancelledError", "CommClosedError"}
"""Names of the errors that mean a lost worker, and of those that mean a lost scheduler.

They are compared by name, since Dask and Ray may not be installed.
"""


def open_executor(name: str, *, workers: int, address: str | None = None) -> WorkerExecutor:
    """Start worker processes, or connect to running ones.

    Parameters
    ----------
    name : ``local``, ``dask`` or ``ray``.
    workers : number of processes to start on this machine if no ``address`` is given.
    address : address of a running Dask scheduler or Ray cluster; not for ``local``.

    Raises
    ------
    ConfigError : the library is not installed or does not start, nothing answers at the address,
        or ``local`` is given an address.
    """
    if name == "dask":
        from shapecat.executors.dask import open_dask  # noqa: PLC0415  an extra

        return open_dask(workers, address)
    if name == "ray":
        from shapecat.executors.ray import RayExecutor  # noqa: PLC0415  an extra

        return RayExecutor(workers, address)
    if address is not None:
        msg = "--scheduler needs --executor dask or ray"
        raise ConfigError(msg)
    return LocalExecutor(workers)


def is_lost(error: BaseException) -> bool:
    """Return whether an error means a lost worker or scheduler rather than a failed task."""
    return type(error).__name__ in _LOST | _DROPPED


def is_dropped(error: BaseException) -> bool:
    """Return whether an error means that the scheduler is lost; the task may not have started."""
    return type(error).__name__ in _DROPPED
