"""Many recordings: what is to be done, what has been done, and none that stops the others."""

from shapecat.batch.plans import Batch, Shard, Task, plan_batch
from shapecat.batch.runs import Outcome, exit_code, process_here, process_on

__all__ = [
    "Batch",
    "Outcome",
    "Shard",
    "Task",
    "exit_code",
    "plan_batch",
    "process_here",
    "process_on",
]
