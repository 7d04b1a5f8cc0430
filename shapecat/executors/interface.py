"""The interface of all executors."""

from abc import abstractmethod
from concurrent.futures import Executor

__all__ = ["WorkerExecutor"]


class WorkerExecutor(Executor):
    """An executor as in `concurrent.futures`, which can also be ended early."""

    @abstractmethod
    def terminate(self) -> None:
        """End the workers in the middle of their tasks."""

    def stop(self) -> None:
        """Ask running tasks to stop, and wait until they have; end them if they cannot be asked."""
        self.terminate()

    def lacks_workers(self) -> bool:
        """Return whether there is no worker yet."""
        return False
