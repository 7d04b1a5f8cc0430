"""Object storage on this machine: moto's S3, which can refuse a fraction of the requests.

    python -m tests.object_storage SHARE LOG   prints its port, serves until killed

Each answered request is a line of LOG: method, path, status.
"""

import random
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

REFUSAL = b"<Error><Code>SlowDown</Code><Message>Please reduce your request rate.</Message></Error>"


class Throttled:
    """A web application that refuses some requests, as S3 does under load, and logs all."""

    def __init__(self, application: Any, share: float, log: Path) -> None:
        """Refuse a ``share`` of the requests to an application, and append all to ``log``."""
        self._application, self._share = application, share
        self._log = log.open("a", encoding="utf-8", buffering=1)
        self._random = random.Random(0)  # noqa: S311  no secret

    def __call__(self, environ: Any, start: Callable[..., Any]) -> Iterable[bytes]:
        """Answer a request."""

        def start_and_log(status: str, *rest: Any) -> Any:
            method, path = environ["REQUEST_METHOD"], environ["PATH_INFO"]
            self._log.write(f"{method} {path}?{environ['QUERY_STRING']} {status[:3]}\n")
            return start(status, *rest)

        if self._random.random() < self._share:
            start_and_log("503 Slow Down", [("Content-Type", "application/xml")])
            return [REFUSAL]

        answer: Iterable[bytes] = self._application(environ, start_and_log)
        return answer


def serve(share: float, log: Path) -> None:
    """Serve on a free port until killed."""
    from moto.moto_server.werkzeug_app import (  # noqa: PLC0415  only in the server's process
        DomainDispatcherApplication,
        create_backend_app,
    )
    from werkzeug.serving import make_server  # noqa: PLC0415  the same

    application = Throttled(DomainDispatcherApplication(create_backend_app), share, log)
    server = make_server("127.0.0.1", 0, application, threaded=True)
    print(server.server_port, flush=True)  # noqa: T201  for whoever started it
    server.serve_forever()


@contextmanager
def object_storage(log: Path, *, refused: float = 0.0, bucket: str = "lab") -> Iterator[Path]:
    """Serve an empty bucket; environment variables, which processes inherit, name the server.

    Provide the ``log`` of the requests, of which a fraction is ``refused``.
    """
    import fsspec  # noqa: PLC0415  nothing else here needs it
    import pytest  # noqa: PLC0415  the same

    command = [sys.executable, "-m", "tests.object_storage", str(refused), str(log)]
    server = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=Path(__file__).parents[1]
    )
    try:
        with pytest.MonkeyPatch.context() as patch:
            port = server.stdout.readline().decode().strip() if server.stdout else ""
            patch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
            for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
                patch.setenv(name, "testing")
            patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
            patch.setenv("AWS_EC2_METADATA_DISABLED", "true")
            system = fsspec.get_filesystem_class("s3")
            system.clear_instance_cache()
            fsspec.filesystem("s3").mkdir(bucket)
            yield log
            system.clear_instance_cache()
    finally:
        server.kill()
        server.wait()
        if server.stdout:
            server.stdout.close()


def requests(log: Path, method: str, ending: str) -> list[str]:
    """Return the paths of granted requests with this method and ending of the path."""
    lines = [line.split() for line in log.read_text("utf-8").splitlines()]
    return [
        path
        for verb, url, status in lines
        for path in [url.partition("?")[0]]
        if verb == method and path.endswith(ending) and status.startswith("2")
    ]


if __name__ == "__main__":
    serve(float(sys.argv[1]), Path(sys.argv[2]))
