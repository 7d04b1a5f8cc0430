"""The interface of all executors."""

from abc import abstractmethod
from concurrent.futures import Executor
from types import TracebackType

from shapecat.system.stopping import Stopped

__all__ = ["WorkerExecutor"]


class WorkerExecutor(Executor):
    """An executor as in `concurrent.futures`, which can also be ended early.

    A ``with`` block ends by waiting for the tasks. If `Stopped` ends the block, the tasks may save
    their results and stop; any other error ends the workers at once.
    """

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if error is None:
            self.shutdown()
        elif isinstance(error, Stopped):
            self.stop()
        else:
            self.terminate()

    @abstractmethod
    def terminate(self) -> None:
        """End the workers in the middle of their tasks."""

    def stop(self) -> None:
        """Ask running tasks to stop, and wait for them; end the workers if that is impossible."""
        self.terminate()

    def lacks_workers(self) -> bool:
        """Return whether there is no worker yet."""
        return False
