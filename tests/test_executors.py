"""Tests of executors: workers fail alone, end with their parent, and keep the order of items."""

import gc
import logging
import os
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from copy import deepcopy
from itertools import count
from multiprocessing import active_children
from pathlib import Path
from queue import SimpleQueue
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from shapecat.errors import ConfigError, ShapecatError
from shapecat.executors import (
    LocalExecutor,
    ProgressReceiver,
    WorkerLostError,
    is_lost,
    open_executor,
    send_progress,
    share_cores,
    single_threaded,
    usable_cores,
)
from shapecat.executors.dask import _DaskExecutor
from shapecat.executors.ordered_pool import _MOST_PENDING, OrderedPool
from shapecat.executors.ray import RayExecutor
from shapecat.system import stopping
from shapecat.types import Camera, Frame
from tests.processes import alive, wait_for
from tests.tasks import (
    Unreadable,
    frail,
    inverse_of_rest,
    kill_self,
    loads_pandas,
    process_and_ones,
    raise_error,
    raise_unreadable,
    slow_at_times,
    slow_elsewhere,
    work_until_asked,
    write_and_sleep,
)


@pytest.fixture(scope="module")
def executor() -> Iterator[Executor]:
    with LocalExecutor(2) as made:
        yield made


def test_results_errors_and_deaths_reach_their_futures(executor: Executor) -> None:
    """A dying worker fails only its own task; a broken pool would fail all."""
    dead = [executor.submit(kill_self) for _ in range(3)]
    powers = list(executor.map(pow, range(6), [2] * 6))
    wrong = executor.submit(raise_error)

    assert powers == [0, 1, 4, 9, 16, 25]
    assert isinstance(wrong.exception(), ValueError)
    for future in dead:
        error = future.exception()
        assert isinstance(error, WorkerLostError)
        assert is_lost(error)
        assert "SIGKILL" in str(error)


def test_workers_do_not_load_pandas(executor: Executor) -> None:
    """Arrow loads pandas with its first array, which takes half a second in each worker."""
    assert not executor.submit(loads_pandas).result()


def test_replaced_workers_leave_nothing_open() -> None:
    """In a batch of thousands of recordings, lost workers would use up descriptors and threads."""

    def kill() -> tuple[int, int]:
        assert isinstance(one.submit(kill_self).exception(), WorkerLostError)
        assert one.submit(abs, -3).result() == 3
        return len(os.listdir("/dev/fd")), threading.active_count()  # noqa: PTH208  no paths

    with LocalExecutor(1) as one:
        first = kill()
        wait_for(lambda: kill() == first, seconds=20)


def test_unpicklable_task_fails_alone() -> None:
    """The worker must take the next task, or a batch would wait forever."""
    one = LocalExecutor(1)
    assert one.submit(lambda: 1).exception() is not None
    assert [one.submit(abs, -k).result(20) for k in range(3)] == [0, 1, 2]
    one.shutdown()


def test_cancelled_task_leaves_its_worker_free() -> None:
    """If a cancelled task counts as sent, its worker gets no other, and the command never ends."""
    one = LocalExecutor(1)
    try:
        held = one.submit(time.sleep, 0.2)
        assert all(one.submit(abs, -k).cancel() for k in range(3))
        assert one.submit(abs, -7).result(20) == 7
        assert held.done()
    finally:
        one.terminate()


def test_busy_worker_receives_next_task() -> None:
    """Otherwise the worker would be idle while 20 MB of frames arrive."""
    one = LocalExecutor(1, ahead=1)
    held, sent, waiting = (one.submit(time.sleep, seconds) for seconds in (60, 0, 0))
    wait_for(sent.running)
    assert not waiting.running()

    one._workers[0].process.kill()

    assert isinstance(held.exception(), WorkerLostError)
    assert isinstance(sent.exception(), WorkerLostError)
    assert waiting.exception() is None
    one.shutdown()


def test_task_that_cannot_be_unpickled_loses_only_its_worker() -> None:
    with LocalExecutor(1) as one:
        assert isinstance(one.submit(Unreadable().method).exception(20), WorkerLostError)
        assert one.submit(abs, -1).result() == 1


def test_workers_have_one_thread_each(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two workers with two threads each would slow each other down on two cores."""
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    with LocalExecutor(1) as one:
        assert one.submit(os.getenv, "OMP_NUM_THREADS").result() == "1"


def test_thread_limits_are_restored(monkeypatch: pytest.MonkeyPatch) -> None:
    """Libraries loaded later would also be limited to one thread, and slow."""
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with single_threaded():
        assert (os.environ["OMP_NUM_THREADS"], os.environ["MKL_NUM_THREADS"]) == ("1", "1")

    assert (os.environ["OMP_NUM_THREADS"], "MKL_NUM_THREADS" in os.environ) == ("7", False)


def test_terminate_kills_running_tasks(tmp_path: Path) -> None:
    one = LocalExecutor(1)
    running = one.submit(write_and_sleep, str(tmp_path / "pid"))
    waiting = one.submit(abs, -1)
    wait_for(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text())

    one.terminate()

    assert isinstance(running.exception(timeout=5), WorkerLostError)
    assert waiting.cancelled()
    assert not alive(int((tmp_path / "pid").read_text()))
    with pytest.raises(RuntimeError):
        one.submit(abs, -1)


def _refuse_threads(monkeypatch: pytest.MonkeyPatch, target: str, *, allowed: int = 0) -> None:
    """Let only ``allowed`` threads run the method ``target``, as at a process limit."""
    start, started = threading.Thread.start, count()

    def limited(thread: threading.Thread) -> None:
        if target in repr(getattr(thread, "_target", "")) and next(started) >= allowed:
            msg = "can't start new thread"
            raise RuntimeError(msg)
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", limited)


def test_worker_without_listener_does_not_survive(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the process limit, the command would wait at its end for the idle worker."""
    others = {*active_children()}
    _refuse_threads(monkeypatch, "Worker._listen")

    with LocalExecutor(1) as executor:
        error = executor.submit(abs, -1).exception()

        assert isinstance(error, WorkerLostError)
        assert "no worker process can be started: can't start new thread" in str(error)
        assert {*active_children()} <= others


def test_fewer_threads_than_workers_do_all_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise, a batch would end with a traceback at the process limit."""
    _refuse_threads(monkeypatch, "LocalExecutor._dispatch", allowed=1)

    with LocalExecutor(2) as executor:
        assert list(executor.map(abs, [-1, -2])) == [1, 2]


def test_pool_without_threads_works_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the process limit, a recording would fail although this process can read it."""
    _refuse_threads(monkeypatch, "LocalExecutor._dispatch")

    alone: OrderedPool[int, int] = OrderedPool(abs, 2)
    with alone as pool:
        assert list(pool.in_order(enumerate([-5, -6, -7]))) == [(0, 5), (1, 6), (2, 7)]


def test_stopping_executor_interrupts_tasks(tmp_path: Path) -> None:
    executor = LocalExecutor(1)
    running = executor.submit(work_until_asked, str(tmp_path / "begun"))
    waiting = executor.submit(work_until_asked, str(tmp_path / "never"))
    wait_for((tmp_path / "begun").exists)

    executor.stop()

    assert isinstance(running.exception(timeout=0), stopping.Stopped)
    assert waiting.cancelled()
    assert not (tmp_path / "never").exists()


def test_workers_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    """Orphans would run for hours and keep the folders locked."""
    code = (
        "from tests.tasks import write_and_sleep\n"
        "from shapecat.executors import LocalExecutor\n"
        "if __name__ == '__main__':\n"
        f"    LocalExecutor(1).submit(write_and_sleep, {str(tmp_path / 'pid')!r}).result()\n"
    )
    (tmp_path / "main.py").write_text(code)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    parent = subprocess.Popen([sys.executable, str(tmp_path / "main.py")], env=environment)
    wait_for(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text())
    worker = int((tmp_path / "pid").read_text())
    assert alive(worker)

    parent.kill()
    parent.wait()

    wait_for(lambda: not alive(worker), 5)


def test_progress_arrives_and_missing_receivers_are_ignored(tmp_path: Path) -> None:
    """A name of 255 bytes can take six times as many in JSON; a cut message would be dropped."""
    received: SimpleQueue[Any] = SimpleQueue()
    longest = [os.fsdecode(b"\xff" * 255), "perceive", 10**12, 10**13]
    messages = [["kitchen", 3], longest, ["厨房" * 42, "track", 0, None], ["hall", 4]]
    with ProgressReceiver(received.put) as receiver:
        for message in messages:
            send_progress(receiver.address, message)
        assert [received.get(timeout=5) for _ in messages] == messages
    send_progress(receiver.address, "nobody listens")
    send_progress(str(tmp_path / "no such place"), "nor here")


@pytest.mark.parametrize("places", ["long", "none"])
def test_long_temporary_folder_costs_at_most_the_reports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, places: str
) -> None:
    """A socket's path has at most 107 bytes; clusters give each job a long temporary folder."""
    long = tmp_path / ("d" * 82)
    long.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(long))
    if places == "none":
        monkeypatch.setattr("shapecat.executors.progress_receiver._SHORT_FOLDER", str(long))
    received: SimpleQueue[Any] = SimpleQueue()
    with ProgressReceiver(received.put) as receiver:
        send_progress(receiver.address, ["kitchen", 3])
        if places == "long":
            assert received.get(timeout=5) == ["kitchen", 3]
    assert not [*long.iterdir()]
    assert not receiver.address or not Path(receiver.address).parent.exists()


@pytest.mark.parametrize(
    ("jobs", "recordings", "expected"),
    [
        (None, 0, (1, 8)),
        (None, 1, (1, 8)),
        (None, 3, (3, 2)),
        (None, 40, (8, 1)),
        (1, 40, (1, 1)),
        (5, 2, (2, 2)),
        (20, 3, (3, 2)),  # available cores count, not requested ones
        (20, 40, (20, 1)),
    ],
)
def test_cores_are_shared_between_recordings_and_their_frames(
    monkeypatch: pytest.MonkeyPatch, jobs: int | None, recordings: int, expected: tuple[int, int]
) -> None:
    """With more processes than cores, all of them are slower."""
    monkeypatch.setattr("shapecat.executors.cores.usable_cores", lambda: 8)

    assert share_cores(jobs, recordings) == expected


def test_only_cores_of_this_job_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a Slurm job with 3 of 64 cores, 64 processes would fill its memory."""
    monkeypatch.setattr("shapecat.executors.cores._QUOTA", Path("no quota"))
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {2, 5, 11}, raising=False)

    assert usable_cores() == 3


@pytest.mark.parametrize(
    ("quota", "cores"),
    [("250000 100000", 3), ("50000 100000", 1), ("max 100000", 64), (None, 64)],
)
def test_quota_of_container_limits_cores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quota: str | None, cores: int
) -> None:
    """`docker run --cpus 2.5` leaves all 64 cores visible: 64 processes would share 2.5 cores."""
    file = tmp_path / "cpu.max"
    if quota is not None:
        file.write_text(f"{quota}\n")
    monkeypatch.setattr("shapecat.executors.cores._QUOTA", file)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(64)), raising=False)

    assert usable_cores() == cores


def test_missing_or_invalid_executors_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match=r"\.\[ray\]"):
        open_executor("ray", workers=1)
    with pytest.raises(ConfigError, match=r"\.\[cluster\]"):
        open_executor("dask", workers=1)
    with pytest.raises(ConfigError, match="--executor"):
        open_executor("local", workers=1, address="tcp://127.0.0.1:1")
    with pytest.raises(ValueError, match="at least 1"):
        LocalExecutor(0)


def test_ray_that_does_not_start_is_not_blamed_on_a_scheduler(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Users who gave no address would look for ``--scheduler None``."""

    def fail(**_: Any) -> None:
        msg = "no space in /dev/shm"
        raise RuntimeError(msg)

    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(init=fail))
    with pytest.raises(ConfigError, match="Ray does not start: no space"):
        open_executor("ray", workers=1)
    with pytest.raises(ConfigError, match=r"ray://a:1: no Ray cluster answers: no space"):
        open_executor("ray", workers=1, address="ray://a:1")


def test_ray_keeps_no_result_of_a_finished_call(monkeypatch: pytest.MonkeyPatch) -> None:
    """A batch may have millions of calls, and shutdown would wait for each result again."""

    class Reference:
        def __init__(self, *_: Any) -> None:
            self.done: Future[int] = Future()

        def future(self) -> Future[int]:
            return self.done

    made: list[weakref.ref[Reference]] = []

    def remote(*arguments: Any) -> Reference:
        reference = Reference(*arguments)
        made.append(weakref.ref(reference))
        return reference

    waited: list[int] = []
    names: list[str] = []

    def options(*, name: str) -> SimpleNamespace:
        names.append(name)
        return SimpleNamespace(remote=remote)

    functions: list[Any] = []

    def as_remote(function: Any) -> SimpleNamespace:
        functions.append(function)
        return SimpleNamespace(options=options)

    ray = SimpleNamespace(
        init=lambda **_: None,
        remote=lambda **_: as_remote,
        wait=lambda references, **_: waited.append(len(references)),
        shutdown=lambda: None,
    )
    monkeypatch.setitem(sys.modules, "ray", ray)
    executor = RayExecutor(2, None)
    first, second = executor.submit(abs, -3), executor.submit(abs, -5)
    first.set_result(3)
    del first
    gc.collect()

    assert [reference() is not None for reference in made] == [False, True]
    assert len(functions) == 1  # a cluster keeps the code of every remote function
    assert functions[0](abs, -7) == 7
    assert names == ["abs", "abs"]
    executor.shutdown()
    assert waited == [1]
    assert not second.done()


def test_dask_logs_no_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dask's own log hid the progress of the command."""
    distributed = pytest.importorskip("distributed")

    def fail(*_args: object, **_options: object) -> None:
        raise OSError

    monkeypatch.setattr(distributed, "Client", fail)
    logging.getLogger("distributed").setLevel(logging.INFO)  # as when it is imported
    with pytest.raises(ConfigError, match="no Dask scheduler answers"):
        open_executor("dask", workers=1, address="tcp://127.0.0.1:1")

    scheduler = logging.getLogger("distributed.scheduler")
    assert not scheduler.isEnabledFor(logging.INFO)
    assert scheduler.isEnabledFor(logging.WARNING)


def test_dask_runs_equal_calls_separately() -> None:
    """A retry after a worker's death is the same call, which must not return a cached result."""
    distributed = pytest.importorskip("distributed")
    client = distributed.Client(processes=False, n_workers=1, dashboard_address="127.0.0.1:0")
    with _DaskExecutor(client, None) as executor:
        first, second = [executor.submit(os.urandom, 8) for _ in range(2)]

        assert first.result() != second.result()


def test_result_that_dask_cannot_fetch_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """If the scheduler was killed while a result was fetched, the batch never ended."""
    distributed = pytest.importorskip("distributed")
    client = distributed.Client(processes=False, n_workers=1, dashboard_address="127.0.0.1:0")

    async def lose(**_: object) -> None:
        raise distributed.comm.CommClosedError

    with _DaskExecutor(client, None) as executor:
        with monkeypatch.context() as patched:
            patched.setattr(client.scheduler, "gather", lose, raising=False)
            error = executor.submit(abs, -3).exception(timeout=60)

        assert error is not None
        assert is_lost(error)
        assert executor.submit(abs, -3).result(timeout=60) == 3


def test_dask_without_a_worker_is_known_to_wait() -> None:
    """While no worker had started, the command waited without saying why."""
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(
        n_workers=0, processes=False, dashboard_address="127.0.0.1:0"
    )
    with _DaskExecutor(distributed.Client(cluster), cluster) as executor:
        assert executor.lacks_workers()
        cluster.scale(1)
        assert executor.submit(abs, -3).result(timeout=60) == 3
        assert not executor.lacks_workers()


@pytest.mark.parametrize("status", ["closing", "closed"])
def test_lost_dask_scheduler_is_a_known_error(status: str) -> None:
    """Dask closes the client of a scheduler that does not come back within half a minute.

    A call to a closed client ended in a traceback; a call to a closing one never ended.
    """

    class ClosedClientError(Exception):
        """Stands for the error of `distributed.client`."""

    def refuse(*_: object, **__: object) -> None:
        raise ClosedClientError

    client: Any = SimpleNamespace(submit=refuse, status=status, close=lambda **_: None)

    with (
        pytest.raises(ShapecatError, match=r"scheduler is gone.*run the same command"),
        _DaskExecutor(client, None) as dask,
    ):
        dask.submit(abs, -3)


def test_processes_keep_order_and_hold_few_items() -> None:
    """A recording does not fit into memory, and its tables must not depend on timing."""
    used: list[tuple[int, int]] = []
    workers: set[int] = set()
    deadline = time.monotonic() + 60

    def items() -> Iterator[tuple[int, int]]:
        more = 100
        for k in count():
            assert k - len(used) <= _MOST_PENDING
            yield k, k
            more -= len(workers) == 3  # the others take a while to start
            if more == 0 or time.monotonic() > deadline:
                return

    with OrderedPool(slow_at_times, 3) as pool:
        for kept, (result, worker) in pool.in_order(items()):
            used.append((kept, result))
            workers.add(worker)
    assert used == [(k, -k) for k in range(len(used))]
    assert os.getpid() in workers
    assert len(workers) == 3


def test_killed_process_loses_no_item(caplog: pytest.LogCaptureFixture) -> None:
    """The kernel kills the largest process if memory is short; no frame may be missing then."""
    deadline = time.monotonic() + 60

    def killed() -> bool:
        return "repeating its work here" in caplog.text

    def items() -> Iterator[tuple[int, int]]:
        for k in count():
            time.sleep(0.005)  # so that the other process has room for the item that kills it
            yield k, k
            if k % 50 == 30 and (killed() or time.monotonic() > deadline):
                return

    with OrderedPool(frail, 2) as pool:
        pool.start()
        wait_for(lambda: all(future.done() for future in pool._warming_up))
        results = list(pool.in_order(items()))
    assert results == [(k, -k) for k in range(len(results))]
    assert killed()


def one_by_one() -> Iterator[tuple[int, float]]:
    for k in range(3):
        time.sleep(0.1)
        yield k, 0.4


def test_last_items_do_not_wait_for_slow_process(caplog: pytest.LogCaptureFixture) -> None:
    """Items not yet sent are processed in this process, without a traceback on the terminal."""
    with OrderedPool(slow_elsewhere, 2) as pool:
        pool.start()
        wait_for(lambda: all(future.done() for future in pool._warming_up))
        workers = [worker for _, worker in pool.in_order(one_by_one())]
    assert workers[0] == workers[1] != os.getpid()
    assert workers[2] == os.getpid()
    assert caplog.messages == []


def test_results_are_freed_without_garbage_collection() -> None:
    """Garbage is collected rarely: results in cycles would fill the memory."""
    received: list[Any] = []
    deadline = time.monotonic() + 60

    def items() -> Iterator[tuple[int, int]]:
        for k in count():
            yield k, k + 1
            if len(received) >= 20 or time.monotonic() > deadline:
                return

    gc.disable()
    try:
        with OrderedPool(process_and_ones, 2) as pool:
            for _, (process, ones) in pool.in_order(items()):
                if process != os.getpid():
                    received.append(weakref.ref(ones))
                del ones
        assert len(received) >= 20
        # Threads of the executor may hold the last ones for a moment.
        wait_for(lambda: sum(ones() is not None for ones in received) <= 2, seconds=5)
    finally:
        gc.enable()


def test_errors_are_raised_in_order() -> None:
    with OrderedPool(inverse_of_rest, 2) as pool:
        results = pool.in_order((k, k) for k in range(20))
        assert [next(results)[1] for _ in range(12)] == [0] * 11 + [1]
        with pytest.raises(ZeroDivisionError):
            next(results)


def test_error_that_cannot_be_unpickled_fails_only_its_task() -> None:
    """Otherwise the caller would wait forever."""
    with LocalExecutor(1) as executor:
        failing, after = executor.submit(raise_unreadable), executor.submit(abs, -3)
        with pytest.raises(TypeError, match="number"):
            failing.result(timeout=60)
        assert after.result(timeout=60) == 3


def test_records_are_read_only_after_transfer() -> None:
    """With writable arrays, a task could change its input, and kernels would be compiled again."""
    sent = Frame(
        "a", 0, 0, 0, "c", depth=np.ones((4, 5), np.float32), camera=Camera(5, 4, 3, 3, 2, 2)
    )

    for record in (sent, deepcopy(sent)):  # restored in the same way as in another process
        assert record.depth is not None
        assert not record.depth.flags.writeable
