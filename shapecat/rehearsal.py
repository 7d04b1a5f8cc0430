"""Compiles the kernels of perception, which takes minutes once per installation, in two processes.

    python -m shapecat.rehearsal

compiles them now, for example while the image of a container is built.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import current_process

import numpy as np

from shapecat.config import Settings
from shapecat.description import describe
from shapecat.detection import detect
from shapecat.executors.local import LocalExecutor
from shapecat.learning import load_model
from shapecat.surface import reconstruct, thin
from shapecat.types import Camera, Frame

__all__ = ["compile_ahead", "compile_all", "find_ball", "recognize_ball"]

_RADIUS_M = 0.05


def find_ball() -> int:
    """Detect a ball that lies on a table, and return the number of objects found."""
    v, u = np.mgrid[:480, :640]
    rays = np.stack([(u - 320) / 525, (v - 240) / 525, np.ones(u.shape)], axis=-1)
    up = np.array([0, -np.sqrt(0.5), -np.sqrt(0.5)])
    table = -0.7 / np.minimum(rays @ up, -0.1)  # 0.7 m below the camera
    ball = np.array([0, 0, 0.7 * np.sqrt(2)]) + _RADIUS_M * up
    a, b, c = (rays**2).sum(axis=-1), rays @ ball, ball @ ball - _RADIUS_M**2
    root = b**2 - a * c
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, table).astype(np.float32)
    frame = Frame(
        "ball", 0, 0, 0, "camera", depth=depth, camera=Camera(640, 480, 525, 525, 320, 240)
    )
    scene = detect(frame, settings=Settings().detection, rng=np.random.default_rng(0))
    return len(scene.candidates)


def recognize_ball() -> str:
    """Categorize a ball that is seen from everywhere, and return what it is taken for."""
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(3000, 3))
    points = _RADIUS_M * ways / np.linalg.norm(ways, axis=1)[:, None] + [0, 0, _RADIUS_M]
    settings, model = Settings(), load_model(None)
    cloud = thin(points.astype(np.float32), settings=settings.surface)
    gas = reconstruct(cloud, settings=settings.surface, rng=rng)
    if gas is None:
        return "unknown"
    descriptor = describe(cloud, gas, eye=np.array([1, 0, 1], np.float32))
    return model.categories[int(model.predict(descriptor[None]).posteriors[0].argmax())]


_REHEARSALS: tuple[Callable[[], object], ...] = (find_ball, recognize_ball)
"""About as long each; none needs the kernels of another."""


@contextmanager
def compile_ahead() -> Iterator[None]:
    """Compile in another process, during the block, what a recording needs after detection.

    Machine code is shared through numba's cache on disk, kernel by kernel.
    """
    if current_process().daemon:  # may have no others
        yield
        return
    executor = LocalExecutor(1)
    executor.submit(recognize_ball)
    try:
        yield
    finally:
        executor.terminate()


def compile_all() -> None:
    """Compile whatever is not in the cache."""
    with LocalExecutor(len(_REHEARSALS)) as executor:
        for future in [executor.submit(rehearsal) for rehearsal in _REHEARSALS]:
            future.result()


if __name__ == "__main__":
    compile_all()
