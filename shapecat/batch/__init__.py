"""Batches of recordings: plan, process, and record the state of each."""

from shapecat.batch.ledger import Outcome
from shapecat.batch.plans import Batch, Shard, Task, plan_batch
from shapecat.batch.runs import exit_code, process_here, process_on

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
