"""Compile the kernels of perception in two processes: about a minute, once per installation.

    python -m shapecat.rehearsal

compiles them ahead of time, for example while a container image is built.
"""

import argparse
import gc
import hashlib
import os
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import wait
from contextlib import suppress
from multiprocessing import current_process
from pathlib import Path

import numba
import numpy as np

from shapecat.arrays import F4
from shapecat.cameras.colour import ColourImage, ColourView, LensCamera
from shapecat.colour.image_masks import find_masks, mask_of
from shapecat.colour.projection import project
from shapecat.completion import complete
from shapecat.config import Settings
from shapecat.description import describe
from shapecat.detection import detect
from shapecat.executors.local import LocalExecutor
from shapecat.executors.worker import WorkerLostError
from shapecat.geometry import IDENTITY, level_from_sensor
from shapecat.jit import code_folder
from shapecat.learning import load_model
from shapecat.reuse import KeyView, find_repeats, shows_the_same, view_object
from shapecat.surface import reconstruct, thin
from shapecat.surface.triangles import triangles_of
from shapecat.system import stopping
from shapecat.system.files import lock
from shapecat.system.progress import (
    COMPILE,
    WAIT_FOR_KERNELS,
    Observer,
    ignore,
    kernel_words,
)
from shapecat.system.scripts import runs_again
from shapecat.types import UNKNOWN, Camera, Candidate, Detection, Frame, NeuralGas, Pose, Scene

__all__ = ["compile_all", "find_ball", "find_mask", "main", "recognize_ball", "rehearse"]

_RADIUS_M, _TOP_M = 0.05, 0.11
"""Radii of the ball, and of the plate and the top of the block."""
_TABLE_M = 0.4
"""Half the width of the table and of a board."""


def find_ball() -> int:
    """Detect a synthetic ball, plate and block, which calls the kernels of detection and reuse.

    Return the number of objects that are recognized again in the same frame.
    """
    v, u = np.mgrid[:480, :640]
    rays = np.stack([(u - 320) / 525, (v - 240) / 525, np.ones(u.shape)], axis=-1)
    up = np.array([0, -np.sqrt(0.5), -np.sqrt(0.5)])
    down = np.minimum(rays @ up, -0.1)
    middle = np.array([0, 0, 0.7 * np.sqrt(2)])
    ball = middle + _RADIUS_M * up
    table, floor = -0.7 / down, -1.2 / down
    seen = np.where(abs(rays[..., 0] * table) < _TABLE_M, table, floor)
    for height, x in ((0.015, 0.2), (0.1, -0.25)):
        top = (height - 0.7) / down
        centre = middle + height * up + [x, 0, 0]
        near = np.linalg.norm(rays * top[..., None] - centre, axis=-1) < _TOP_M
        seen = np.where(near, top, seen)
    a, b, c = (rays**2).sum(axis=-1), rays @ ball, ball @ ball - _RADIUS_M**2
    root = b**2 - a * c
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, seen)
    frame = _frame_of(depth)
    scene = _detect(frame)
    board = 0.05 / np.maximum(rays[..., 1], 0.03)  # seen at a grazing angle
    _detect(_frame_of(np.where(abs(rays[..., 0] * board) < _TABLE_M, board, 2.5)))
    same = shows_the_same(frame, None, frame, None, range_m=2.0)
    views = [view_object(frame, IDENTITY, ball, scene.up, _RADIUS_M) for ball in scene.candidates]
    keys = [KeyView(view, _undescribed(view.candidate)) for view in views]
    return sum(repeat is not None for repeat in find_repeats(views, keys)) if same else 0


def _frame_of(depth: F4) -> Frame:
    camera = Camera(640, 480, 525, 525, 320, 240)
    return Frame("ball", 0, 0, 0, "camera", depth=depth.astype(np.float32), camera=camera)


def _detect(frame: Frame) -> Scene:
    return detect(frame, settings=Settings().detection, rng=np.random.default_rng(0))


def _undescribed(candidate: Candidate) -> Detection:
    nothing = NeuralGas(np.zeros((0, 3)), np.zeros((0, 2), int))
    return Detection(candidate, nothing, np.zeros(0), np.zeros(0), 0.0, 0.0)


def recognize_ball() -> str:
    """Categorize a synthetic ball, which calls the kernels for depth images after detection.

    Return the category, ``unknown`` if the ball has no surface.
    """
    rng, eye = np.random.default_rng(0), np.array([1, 0, 1], np.float32)
    ways = rng.normal(size=(6000, 3))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    seen = ways @ (eye - [0, 0, _RADIUS_M]) > _RADIUS_M
    points = _RADIUS_M * ways[seen] + [0, 0, _RADIUS_M]
    settings, model = Settings(), load_model(None)
    cloud = thin(points.astype(np.float32), settings=settings.surface)
    gas = reconstruct(cloud, settings=settings.surface, rng=rng)
    if gas is None:
        return UNKNOWN
    triangles_of(gas.edges, len(gas.neurons))
    level_from_sensor((0, 0, 1), 0.0, cloud)
    complete(np.add(cloud, 1), (0, 0, 1), 0.0, np.ones(1), ("ball",))
    descriptor = describe(cloud, gas, eye=eye)
    return model.categories[int(model.predict(descriptor[None]).posteriors[0].argmax())]


def find_mask() -> int:
    """Find a square's masks on two colour images, which calls the kernels for colour images.

    One image is registered to the depth image, the other is not. Return the sum of the areas,
    pixels.
    """
    frame = _frame_of(np.full((480, 640), 0.7))
    v, u = np.mgrid[200:240, 300:340]
    square = (v * 640 + u).ravel().astype(np.uint32)
    lens = LensCamera(Camera(640, 480, 525, 525, 320, 240), "plumb_bob", (0.01, 0, 0, 0))
    image = ColourImage("rgb", 0, 0, "camera", "rgb8", 640, 480, 1920, b"")
    shifted = Pose(np.eye(3), np.array([0.02, 0, 0]))
    views = (ColourView(image), ColourView(image, lens, shifted))
    project(np.zeros((1, 3), np.float32), lens, shifted)
    return sum(mask_of(find_masks(frame, view, [square]), [0]).area for view in views)


_REHEARSALS: tuple[Callable[[], object], ...] = (find_ball, recognize_ball)
"""Functions that compile the kernels when they are called. They share no kernel and take equally
long, so that two processes can work at the same time."""
_POLL_S = 0.1
"""Interval between checks whether compilation, here or in another process, has finished."""
_TELL_S = 10.0
"""Interval between progress reports."""
_STAGES = ("completion", "description", "detection", "learning", "reuse", "surface")
"""Folders with the kernels for depth images; those for colour images are in ``colour``."""


def rehearse() -> None:
    """Call all kernels for depth images once, which compiles or loads them."""
    for rehearsal in _REHEARSALS:
        rehearsal()


def compile_all(observe: Observer = ignore, *, cores: int = 2, colour: bool = False) -> float:
    """Compile missing kernels, if possible in other processes; return the duration in seconds.

    If another call, here or in another process, is compiling them, wait for it. The duration is 0
    if none is missing, or if machine code cannot be stored: then nothing is compiled.

    Parameters
    ----------
    observe : called before compilation begins, and then every ten seconds with the number of
        kernels compiled so far, also while another process compiles them.
    cores : largest number of processes.
    colour : whether to compile the kernels for masks on colour images, too.

    Raises
    ------
    Stopped : a signal asked the process to stop; compiled kernels are kept.
    RuntimeError : this is a worker process that runs the main script again, since the script lacks
        ``if __name__ == "__main__":``. It would wait for its parent, which waits for it.
    """
    marker = _completion_marker(colour=colour)
    if marker is None or marker.exists():
        return 0.0
    if getattr(current_process(), "_inheriting", False):  # multiprocessing makes the same check
        msg = 'a script that processes recordings needs `if __name__ == "__main__":`'
        raise RuntimeError(msg)
    begun = time.perf_counter()
    report = _reporter(observe)
    marker.parent.mkdir(parents=True, exist_ok=True)  # another version may have removed it
    while (held := lock(marker.parent)) is None:
        stopping.check()
        report(WAIT_FOR_KERNELS)
        time.sleep(_POLL_S)
    try:
        if not marker.exists():
            observe(COMPILE, 0, None)
            # The rest is compiled when it is called; another version may remove the folder.
            with suppress(WorkerLostError, FileNotFoundError):
                called = (*_REHEARSALS, find_mask) if colour else _REHEARSALS
                _rehearse(cores, called, report)
                marker.touch()
                if colour and (of_depth := _completion_marker(colour=False)) is not None:
                    of_depth.touch()
    finally:
        os.close(held)
    return time.perf_counter() - begun


def _completion_marker(*, colour: bool) -> Path | None:
    """Return the path of a file that exists once all kernels for depth images are compiled.

    With ``colour``, so are those for colour images. The result is None if machine code cannot be
    stored.
    """
    stages = (*_STAGES, "colour") if colour else _STAGES
    folders = [code_folder(Path(__file__).with_name(stage)) for stage in stages]
    names = [folder.name for folder in folders if folder is not None]
    if folders[0] is None or len(names) < len(stages):
        return None
    made_of = (*names, numba.__version__, str(sys.implementation.cache_tag))
    return folders[0] / f"complete-{hashlib.sha256(' '.join(made_of).encode()).hexdigest()[:16]}"


def _reporter(observe: Observer) -> Callable[[str], None]:
    """Return a function that is called often with the phase, and reports it every ten seconds.

    It reports the number of compiled kernels, too.
    """
    last = time.monotonic()

    def report(phase: str) -> None:
        nonlocal last
        if time.monotonic() - last >= _TELL_S:
            last = time.monotonic()
            observe(phase, _count(), None)

    return report


def _rehearse(
    cores: int, rehearsals: Sequence[Callable[[], object]], report: Callable[[str], None]
) -> None:
    if current_process().daemon or runs_again():  # may not start processes
        for rehearsal in rehearsals:
            rehearsal()
        return
    executor = LocalExecutor(min(cores, len(_REHEARSALS)))
    try:
        waiting = {executor.submit(_call_without_gc, rehearsal) for rehearsal in rehearsals}
        while waiting:
            stopping.check()
            report(COMPILE)
            done, waiting = wait(waiting, timeout=_POLL_S)
            for future in done:
                future.result()
    finally:
        executor.terminate()


def _call_without_gc(rehearsal: Callable[[], object]) -> None:
    """Call ``rehearsal`` without garbage collection, a twelfth faster; for short-lived workers."""
    gc.disable()
    rehearsal()


def _count() -> int:
    """Return the number of kernels that are compiled and stored."""
    folders = (code_folder(Path(__file__).with_name(stage)) for stage in (*_STAGES, "colour"))
    found = (os.walk(folder) for folder in folders if folder is not None)  # which may disappear
    names = (name for walk in found for _, _, files in walk for name in files)
    return sum(name.endswith(".nbi") for name in names)


def main(words: Sequence[str] | None = None) -> None:
    """Compile the kernels, and print their number every ten seconds.

    Parameters
    ----------
    words : command-line arguments, by default of this process; only ``--help`` is allowed.

    Raises
    ------
    SystemExit : there are arguments.
    """
    about = "Compile the kernels of perception ahead of time, unless that is already done."
    argparse.ArgumentParser("python -m shapecat.rehearsal", description=about).parse_args(words)

    def say(line: str) -> None:
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()

    seconds = compile_all(lambda phase, done, _total: say(kernel_words(phase, done)), colour=True)
    if seconds:
        say(f"all {_count()} kernels compiled in {seconds:.0f} s")


if __name__ == "__main__":
    main()
