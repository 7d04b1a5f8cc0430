"""Files and folders at URLs, through fsspec; requests that may succeed later are repeated.

fsspec is in the extra ``remote``; each storage needs its own package (s3fs, gcsfs, ...).
"""

import errno
import random
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from datetime import datetime
from functools import partial
from hashlib import sha256
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar
from urllib.parse import unquote

from shapecat.errors import ConfigError, RecordingError, ShapecatError

__all__ = ["Location", "content_key", "is_url", "names_in", "without_query"]

_T = TypeVar("_T")

_WAITS_S = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Waits between attempts. Each is varied by up to half, so that workers do not return together."""
_DIGESTS = ("ETag", "etag", "md5Hash", "content_md5", "Content-MD5", "Digest")
_TIMES = ("mtime", "LastModified", "last_modified", "Last-Modified", "created")
"""Entries of a file's info that change with its content, or with the time it was written."""
_TRANSIENT = {
    errno.EAGAIN,
    errno.EBUSY,  # s3fs: SlowDown, ServiceUnavailable
    errno.ECONNREFUSED,
    errno.ECONNRESET,
    errno.EPIPE,
    errno.ETIMEDOUT,
    getattr(errno, "EREMOTEIO", errno.EIO),  # s3fs: InternalError
}
_TRANSIENT_NAMES = {"ClientPayloadError", "ServerDisconnectedError"}
"""Errors of aiohttp by name, since it need not be installed."""
_PAGE = 1000
"""Names per page of a listing, the most that S3 returns."""
_PART_BYTES = 16 * 2**20  # smallest part of a multipart upload
_MOST_PARTS = 9_000
"""Largest number of parts of a multipart upload; S3 allows 10,000."""


def is_url(text: str) -> bool:
    """Return whether a source or an output is a URL rather than a path.

    Examples
    --------
    >>> is_url("s3://lab/x.mcap"), is_url("/data/x.mcap")
    (True, False)
    """
    return "://" in text


def without_query(url: str) -> str:
    """Return a URL without its query (http) or version (S3, where names may hold a ``?``)."""
    return url.partition("?" if url.startswith("http") else "?versionId=")[0]


def names_in(url: str) -> tuple[str, str]:
    """Return the names of the parent folder and of the file at a URL, without the query.

    Names at http URLs are decoded, except one that would be hidden or lead out of a folder.

    Examples
    --------
    >>> names_in("http://host/my%20day/lab.mcap?key=1"), names_in("s3://lab/100%25/b?.bag")
    (('my day', 'lab.mcap'), ('100%25', 'b?.bag'))
    """
    pure = PurePosixPath(without_query(url).partition("://")[2])
    decode = _decoded if url.startswith("http") else str
    return decode(pure.parent.name), decode(pure.name)


def _decoded(name: str) -> str:
    plain = unquote(name)
    return name if plain.startswith(".") or not {"/", "\0", "\ufffd"}.isdisjoint(plain) else plain


def content_key(info: Mapping[str, Any]) -> str:
    """Return a key that changes with a file's content, from its size and its digest or times.

    It is empty if neither digest nor time is known.
    """
    names = _DIGESTS if any(info.get(name) for name in _DIGESTS) else _TIMES
    values = [info[name] for name in names if info.get(name) is not None]
    texts = [v.isoformat() if isinstance(v, datetime) else str(v) for v in values]
    content = [info.get("size"), *texts]
    return sha256(repr(content).encode()).hexdigest()[:16] if values else ""


class Location:
    """A file or folder at a URL; failures raise errors with a one-line message."""

    def __init__(self, url: str, error: type[ShapecatError] = RecordingError) -> None:
        """Open the file system of a URL, without a request.

        Parameters
        ----------
        error : class of the exceptions that this location raises.

        Raises
        ------
        ConfigError : a library is not installed.
        error : the URL is invalid.
        """
        self.url, self._error = url, error
        self._system, self._path = _connect(url, error)

    def __truediv__(self, name: str) -> "Location":
        return Location(f"{self.url.rstrip('/')}/{name}", self._error)

    @property
    def root(self) -> str:
        """The URL of this folder, in the form with which the URLs from `walk` begin."""
        return self._url_of({"name": self._path})

    def _retry(self, participle: str, call: Callable[[], _T]) -> _T:
        """Return the result of a call; repeat the call while it may still succeed.

        Raises
        ------
        ShapecatError : the call failed; ``participle`` is for the message ("read").
        FileNotFoundError, FileExistsError : raised by the storage.
        """
        for wait_s in (*_WAITS_S, 0.0):
            try:
                return call()
            except (FileNotFoundError, FileExistsError):
                raise
            except Exception as error:  # every storage has errors of its own
                if not wait_s or not _is_transient(error):
                    raise self._as_error(participle, error) from error
            time.sleep(wait_s * random.uniform(0.5, 1.5))  # noqa: S311  no secret
        raise AssertionError

    def _as_error(self, participle: str, error: Exception) -> ShapecatError:
        reason = " ".join((str(error) or type(error).__name__).split())
        return self._error(f"{self.url}: cannot be {participle}: {reason}")

    def info(self) -> Mapping[str, Any] | None:
        """Return what fsspec knows about a file or folder (type, size, times); None if missing."""
        with suppress(FileNotFoundError):
            info: Mapping[str, Any] = self._retry("read", lambda: self._system.info(self._path))
            return info
        return None

    def read(self) -> bytes | None:
        """Return the content of a small file; None if it does not exist."""
        with suppress(FileNotFoundError):
            return bytes(self._retry("read", lambda: self._system.cat_file(self._path)))
        return None

    def write(self, content: bytes) -> None:
        """Write a small file."""
        self._put("written", lambda: self._system.pipe_file(self._path, content))

    def create(self, content: bytes) -> bool:
        """Write a small file unless it exists; return whether it was written.

        On storages without exclusive creation, two processes may both succeed.
        """
        try:
            self._put("written", lambda: self._system.pipe_file(self._path, content, mode="create"))
        except FileExistsError:
            return False
        return True

    def upload(self, file: Path) -> None:
        """Upload a file, in parts if it is large, to limit memory."""
        options = self._in_parts(file.stat().st_size)
        self._put("uploaded", lambda: self._system.put_file(str(file), self._path, **options))

    def _in_parts(self, size: int = 0) -> dict[str, int]:
        """Return options that limit the memory to transfer ``size`` bytes; S3 would use 0.5 GB."""
        part = max(_PART_BYTES, -(-size // _MOST_PARTS))
        return {"chunksize": part, "max_concurrency": 2} if self._is_s3() else {}

    def _put(self, participle: str, call: Callable[[], Any]) -> None:
        if not self._is_s3():  # S3 would create a bucket with a misspelt name
            parent = self._path.rstrip("/").rpartition("/")[0]
            self._retry(participle, lambda: self._system.makedirs(parent, exist_ok=True))
        try:
            self._retry(participle, call)
        except FileNotFoundError as error:
            raise self._as_error(participle, error) from error

    def download(self, target: Path) -> None:
        """Download a file, or a folder with its content.

        Raises
        ------
        ShapecatError : the file does not exist, the transfer failed, or the name of a file leads
            out of the folder.
        """

        def get(source: str, file: Path) -> None:  # `get` treats some names as patterns
            file.parent.mkdir(parents=True, exist_ok=True)
            self._system.get_file(source, str(file), **self._in_parts())

        with suppress(FileNotFoundError):
            if not self._retry("downloaded", lambda: self._system.isdir(self._path)):
                self._retry("downloaded", lambda: get(self._path, target))
            for info in self._list(deep=True) if not target.exists() else ():
                name = PurePosixPath(info["name"]).relative_to(self._path)
                if ".." in name.parts:
                    msg = f"{self.url}: the name {str(name)!r} leads out of the folder"
                    raise self._error(msg)
                is_encoded = "http" in self._system.protocol
                file = target.joinpath(*map(_decoded, name.parts) if is_encoded else name.parts)
                self._retry("downloaded", partial(get, info["name"], file))
        if not target.exists():
            msg = f"{self.url}: does not exist"
            raise self._error(msg)

    def copy(self, other: "Location") -> None:
        """Copy the file to ``other``, which must be in the same storage."""
        other._put("written", lambda: self._system.cp_file(self._path, other._path))  # noqa: SLF001  of this class

    def remove(self) -> None:
        """Remove a file, if it exists."""
        with suppress(FileNotFoundError):
            self._retry("removed", lambda: self._system.rm_file(self._path))

    def names(self) -> set[str]:
        """Return the names of the files and folders in a folder."""
        return {PurePosixPath(url).name for url, _ in self.walk(deep=False)}

    def walk(self, *, deep: bool = True) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """Yield URL and info, as from `info`, of the files in a folder, which need not exist.

        Parameters
        ----------
        deep : whether to yield the files in subfolders, instead of the subfolders themselves.
        """
        with suppress(FileNotFoundError):
            for info in self._list(deep=deep):
                yield self._url_of(info), info

    def matches(self) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """Yield URL and info of the files and folders that match this URL, which is a pattern."""
        infos = self._retry("listed", lambda: self._system.glob(self._path, detail=True))
        for info in infos.values():
            yield self._url_of(info), info

    def _url_of(self, info: Mapping[str, Any]) -> str:
        return str(self._system.unstrip_protocol(info["name"].rstrip("/")))

    def _list(self, *, deep: bool) -> Iterator[Mapping[str, Any]]:
        system, path = self._system, self._path
        if self._is_s3():
            yield from self._list_pages(deep=deep)
        elif deep:
            found = self._retry("listed", lambda: system.find(path, detail=True))
            # For a path that is a file, such as a page without links, the info is empty.
            yield from ({"name": name, **info} for name, info in found.items())
        else:
            yield from self._retry("listed", lambda: system.ls(path, detail=True))

    def _list_pages(self, *, deep: bool) -> Iterator[Mapping[str, Any]]:
        """Yield the infos of a folder in S3 for `walk`, by pages: a bucket may hold millions."""
        bucket, key, _ = self._system.split_path(self._path)
        prefix = f"{key.rstrip('/')}/" if key else ""
        delimiter = "" if deep else "/"
        options = {"Bucket": bucket, "Prefix": prefix, "Delimiter": delimiter, "MaxKeys": _PAGE}
        call = self._system.call_s3
        while True:
            try:
                page = self._retry("listed", lambda: call("list_objects_v2", **options))
            except FileNotFoundError as error:  # no such bucket; a missing folder is an empty one
                raise self._as_error(participle="listed", error=error) from error
            for item in page.get("Contents", ()):
                if not item["Key"].endswith("/"):  # an empty object that stands for a folder
                    yield {**item, "name": f"{bucket}/{item['Key']}", "size": item["Size"]}
            for item in page.get("CommonPrefixes", ()):
                yield {"name": f"{bucket}/{item['Prefix']}", "size": 0}
            if not page.get("IsTruncated"):
                return
            options["ContinuationToken"] = page["NextContinuationToken"]

    def abort_uploads(self) -> None:
        """Abort unfinished multipart uploads to a folder in S3, since their parts cost money."""
        if not self._is_s3():
            return
        bucket, key, _ = self._system.split_path(self._path)
        call = self._system.call_s3
        options = {"Bucket": bucket, "Prefix": f"{key}/"}
        begun = self._retry("listed", lambda: call("list_multipart_uploads", **options))
        for upload in begun.get("Uploads", ()):
            ids = {"Bucket": bucket, "Key": upload["Key"], "UploadId": upload["UploadId"]}
            with suppress(FileNotFoundError):
                self._retry("removed", partial(call, "abort_multipart_upload", **ids))

    def _is_s3(self) -> bool:
        return "s3" in self._system.protocol


def _connect(url: str, error: type[ShapecatError]) -> tuple[Any, str]:
    """Return the fsspec file system of a URL, and the path in it; errors are as for `Location`."""
    try:
        from fsspec.core import url_to_fs  # noqa: PLC0415  an extra
    except ImportError as missing:
        msg = f"{url}: URLs need fsspec: in a clone of shapecat, pip install '.[remote]'"
        raise ConfigError(msg) from missing
    try:
        # Listings are not cached, since other workers change the storage.
        system, path = url_to_fs(url, use_listings_cache=False)
    except ImportError as missing:
        msg = f"{url}: {missing}"
        raise ConfigError(msg) from missing
    except (OSError, ValueError) as reason:
        msg = f"{url}: cannot be reached: {reason}"
        raise error(msg) from reason
    return system, str(path)


def _is_transient(error: Exception) -> bool:
    """Return whether a call may succeed later: the server is busy, or a connection broke."""
    status = getattr(error, "status", None)
    if isinstance(status, int):
        return status == 429 or status >= 500
    return (
        isinstance(error, TimeoutError | ConnectionError)
        or type(error).__name__ in _TRANSIENT_NAMES
        or getattr(error, "errno", None) in _TRANSIENT
    )
