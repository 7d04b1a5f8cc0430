"""Open a review in the Rerun viewer: in a window, in a browser, or as a screenshot."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any
from urllib.parse import quote

import numpy as np

from shapecat.errors import OutputError
from shapecat.system.files import require_utf8

__all__ = ["open_viewer", "serve_viewer", "take_screenshot"]

_SETTLE_S = 7.0  # until the viewer's notices have faded; everything else is drawn by then
_LOAD_S = 30.0  # longest wait for the viewer to answer or to load a file
_OPEN_S = 2.0
"""A viewer that cannot open a window ends within this time."""
_SHOTS = 4
"""Attempts at a screenshot: on a loaded machine, the software renderer takes half a minute."""
_SCREENSHOT_SIZE = "1280x800"  # pixels
_HERE = "127.0.0.1"
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")


def open_viewer(path: Path) -> None:
    """Open a review in a window, and return once it is clear that the window stays open.

    Raises
    ------
    OutputError : the file, the viewer or a display is missing, or the viewer fails.
    """
    _require_file(path)
    if sys.platform == "linux" and not any(os.environ.get(name) for name in _DISPLAYS):
        msg = "no display to open a window on; use --web for a browser, or --screenshot FILE.png"
        raise OutputError(msg)
    with tempfile.TemporaryFile() as log:
        viewer = _start(("--port", "auto", str(path.absolute())), log)
        with suppress(subprocess.TimeoutExpired):
            if viewer.wait(_OPEN_S) != 0:
                raise OutputError(_failure_text(log))


@contextmanager
def serve_viewer(path: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Serve a review to browsers on this machine during the block.

    Yields
    ------
    The address, and the process that serves it.

    Raises
    ------
    OutputError : the file or the viewer is missing, or the viewer ends or does not answer.
    """
    _require_file(path)
    web, data = _free_port(), _free_port()
    options = ("--serve-web", "--web-viewer-port", str(web), "--port", str(data))
    with tempfile.TemporaryFile() as log:
        viewer = _start((*options, str(path.absolute())), log)
        try:
            _wait_for(viewer, web, log)
            source = quote(f"rerun+http://{_HERE}:{data}/proxy", safe="")
            yield f"http://{_HERE}:{web}/?url={source}", viewer
        finally:
            _end(viewer)


def _start(options: Sequence[str], log: IO[bytes]) -> subprocess.Popen[bytes]:
    """Start the viewer in a process group of its own, reachable only from this machine."""
    command = [_viewer(), "--bind", _HERE, *options]
    return subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)


def _end(viewer: subprocess.Popen[bytes]) -> None:
    with suppress(ProcessLookupError):
        os.killpg(viewer.pid, signal.SIGKILL)  # `rerun` is a script that starts the viewer
    viewer.wait()


def take_screenshot(path: Path, png: Path) -> None:
    """Draw a review at its last time to a PNG file, without a window or a graphics card.

    Parameters
    ----------
    png : the file to write.

    Raises
    ------
    OutputError : the file, the viewer or a renderer is missing, or the viewer fails.
    """
    from rerun.experimental import ViewerClient  # noqa: PLC0415  only a screenshot needs it

    _require_file(path)
    require_utf8(png)
    port = _free_port()
    options = ("--port", str(port), "--hide-welcome-screen")
    window = ("--headless", "--window-size", _SCREENSHOT_SIZE)
    with tempfile.TemporaryFile() as log:
        viewer = _start((*options, *window), log)
        try:
            _wait_for(viewer, port, log)
            client = ViewerClient(f"rerun+http://{_HERE}:{port}/proxy")
            _show(client, path)
            _save(client, png, viewer)
        except (RuntimeError, OSError) as error:
            ended = _has_ended(viewer)
            msg = _failure_text(log) if ended else f"{path}: the viewer cannot draw it: {error}"
            raise OutputError(msg) from error
        finally:
            _end(viewer)


def _show(client: Any, path: Path) -> None:
    """Open the file at its last time, and wait until it is drawn."""
    client.open(str(path.absolute()))
    _wait_until(lambda: not client.get_state().loading)
    stamp_ns = _last_stamp(client)
    if stamp_ns is not None:
        at = np.datetime64(stamp_ns, "ns")
        client.set_time("sensor_time", timestamp=at, play_state="paused")
    time.sleep(_SETTLE_S)


def _save(client: Any, png: Path, viewer: subprocess.Popen[bytes]) -> None:
    """Save a screenshot; try again if the viewer needs longer than the 15 s that Rerun waits."""
    for left in reversed(range(_SHOTS)):
        try:
            client.save_screenshot(str(png.absolute()))  # returns once it is saved
        except TimeoutError:
            if not left or viewer.poll() is not None:
                raise
        else:
            return


def _last_stamp(client: Any) -> int | None:
    ends = [
        timeline.end
        for recording in client.get_state().recordings
        for timeline in recording.timelines
        if timeline.name == "sensor_time" and timeline.end is not None
    ]
    return max(ends, default=None)


def _require_file(path: Path) -> None:
    require_utf8(path)
    if not path.is_file():
        msg = f"{path}: no review there; process the recording without --no-rrd"
        raise OutputError(msg)


def _viewer() -> str:
    """Return the path of the viewer, beside this Python or else on the PATH.

    Raises
    ------
    OutputError : there is no viewer.
    """
    beside = shutil.which("rerun", path=str(Path(sys.executable).parent))
    found = beside or shutil.which("rerun")
    if found is None:
        msg = "no program `rerun` beside Python or on the PATH; install the package rerun-sdk"
        raise OutputError(msg)
    return found


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((_HERE, 0))
        return int(probe.getsockname()[1])


def _wait_for(viewer: subprocess.Popen[bytes], port: int, log: IO[bytes]) -> None:
    """Wait until the viewer answers.

    Raises
    ------
    OutputError : the viewer has ended, and the text says why; or it does not answer.
    """

    def answers() -> bool:
        if viewer.poll() is not None:
            raise OutputError(_failure_text(log))
        with socket.socket() as probe:
            return probe.connect_ex((_HERE, port)) == 0

    try:
        _wait_until(answers)
    except TimeoutError as error:
        msg = f"the viewer gave {error}"
        raise OutputError(msg) from error


def _has_ended(viewer: subprocess.Popen[bytes]) -> bool:
    """Return whether the viewer ends within `_SETTLE_S`.

    Its connection closes shortly before it ends.
    """
    with suppress(subprocess.TimeoutExpired):
        viewer.wait(_SETTLE_S)
    return viewer.poll() is not None


def _failure_text(log: IO[bytes]) -> str:
    log.seek(0)
    text = log.read().decode("utf-8", "replace")
    if panic := re.search(r" panicked at '(.*)'$", text, re.MULTILINE):
        text = panic[1]  # lines before it name the adapter in use, lines after it the stack
    if any(word in text for word in ("adapter", "Vulkan", "render context")):
        return (
            "the viewer found no graphics device; without a graphics card install a software "
            "renderer (Debian, Ubuntu: the package mesa-vulkan-drivers)"
        )
    lines = [line for line in text.splitlines() if line.strip()]
    return f"the viewer ended: {lines[-1] if lines else 'without a message'}"


def _wait_until(ready: Callable[[], bool]) -> None:
    deadline = time.monotonic() + _LOAD_S
    while not ready():
        if time.monotonic() > deadline:
            msg = f"no answer within {_LOAD_S:.0f} s"
            raise TimeoutError(msg)
        time.sleep(0.05)
