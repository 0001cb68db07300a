"""Files at a URL, by fsspec: read through a cache of bounded size, published so that none is seen half-written.

`s3://` and `gs://` need the extra `cloud`; credentials and endpoint are those that the store's own client finds, such
as AWS_ACCESS_KEY_ID and AWS_ENDPOINT_URL.
"""

import contextlib
import errno
import fcntl
import hashlib
import logging
import os
import pathlib
import re
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import fsspec

from sensors_io.codec import RecordsError

CACHE, CACHE_GB = "TOUCHR1_CACHE", "TOUCHR1_CACHE_GB"
"""Variables of the environment: folder of the cache, by default ~/.cache/touchr1, and its size, by default 50 GB."""

_COPY = re.compile(r"[0-9a-f]{24}-.+")  # name of a copy in the cache; nothing else is ever removed from its folder
_URL = re.compile(r"([a-z][a-z0-9+]+):/+(.+)")  # one slash is left where a URL was made a path
_ABSOLUTE = ("file", "local")  # kinds whose paths begin at the root, whatever a path made of the slashes
_LOG = logging.getLogger(__name__)
_SLOW_S = 10.0  # from which on a line says that a request is waited for
_AHEAD = 4  # files at once: one stream alone does not fill the line to a store
_WAITS_S = (0.1, 0.3, 1.0, 3.0, 9.0)
_UNKNOWN = ("is refused", "set the credentials of this store")
_LASTING = {
    "FileNotFoundError": ("is not there", "correct the URL, or make the bucket"),
    "PermissionError": ("is refused", "correct the credentials of this store"),
    "full": ("finds no room", f"free some space in the cache, {CACHE}, and in the store"),
    **dict.fromkeys(("NoCredentialsError", "PartialCredentialsError", "RefreshError"), _UNKNOWN),
}  # failures that do not pass: what is wrong, and the fix
_T = TypeVar("_T")


class StoreError(RecordsError):
    """A store that cannot be reached, refuses, or does not hold what is asked for."""


class Mirror:
    """A folder at a URL whose files are copied to the cache when they are first read.

    A copy is named by what the store says of the file (its ETag, or its size and time), so that a file that was
    replaced is read anew.  Several processes may share one cache.
    """

    def __init__(self, url: str):
        if (found := _URL.fullmatch(url)) is None:
            raise StoreError(f"url is {url!r}: must be KIND://PATH, as in s3://bucket/records; correct it")
        kind, path = found.groups()
        root = "/" if kind in _ABSOLUTE else ""
        self.url, self._path = f"{kind}://{root}{path}", f"{root}{path}".rstrip("/")
        try:
            more = {"auto_mkdir": True} if root else {}
            self._store = fsspec.filesystem(kind, use_listings_cache=False, **more)
        except Exception as error:  # each kind has errors of its own
            fix = "must be of a kind that fsspec knows, its package installed; pip install 'touchr1-jax[cloud]'"
            raise StoreError(f"{self.url} cannot be opened ({error}): {fix}") from error
        try:
            self._cache = pathlib.Path(os.environ.get(CACHE, "~/.cache/touchr1")).expanduser()
        except RuntimeError as error:
            raise StoreError(f"{CACHE} is {os.environ.get(CACHE)!r}: {error}; set it to a folder") from error
        stated = os.environ.get(CACHE_GB, "50")
        if re.fullmatch(r"(\d+\.?\d*|\.\d+)(e-?\d)?", stated) is None:
            raise StoreError(f"{CACHE_GB} is {stated!r}: must be a number of gigabytes ≥ 0; correct it, or unset it")
        self._most = int(float(stated) * 1e9)

    def __str__(self) -> str:
        return self.url

    def __reduce__(self) -> Any:
        return Mirror, (self.url,)

    def fetch(self, name: str, size: int | None = None) -> pathlib.Path:
        """A copy of a file of `size` bytes in the cache; others may take its place once it is not read for a while.

        Raises:
          StoreError: it is not there or has another size, or the store fails again and again.
        """
        about = self._retried(lambda: self._store.info(f"{self._path}/{name}"), name)
        if size is not None and about["size"] != size:
            raise StoreError(f"{self.url}/{name} has {about['size']} bytes where {size} were written: upload it again")
        state = [str(about.get(key)) for key in ("ETag", "etag", "md5Hash", "size", "LastModified", "created", "mtime")]
        named = hashlib.sha256("\0".join([self.url, name, *state]).encode()).hexdigest()[:24]
        path = self._cache / f"{named}-{name.rpartition('/')[2]}"
        try:
            while True:
                if not path.exists():
                    self._cache.mkdir(parents=True, exist_ok=True)
                    self._download(name, path, about["size"])
                with contextlib.suppress(FileNotFoundError):  # another process needed the room just now
                    os.utime(path)  # the one that was not read for the longest time goes first
                    return path
        except PermissionError as error:
            raise StoreError(f"the cache {self._cache} cannot be written ({error}): set {CACHE} to a folder") from error

    def fetch_ahead(self, files: Iterable[tuple[str, int]]) -> None:
        """Begin to copy files, given by name and size, in their order and in threads, as many as fit into the cache."""
        total, listed, lock = 0, iter(files), threading.Lock()

        def work() -> None:
            nonlocal total
            while True:
                with lock:
                    name, size = next(listed, ("", self._most + 1))
                    total += size
                if total > self._most:
                    return
                with contextlib.suppress(StoreError):  # whoever reads the file meets it too
                    self.fetch(name, size)

        for _ in range(_AHEAD):
            threading.Thread(target=work, daemon=True).start()

    def _download(self, name: str, path: pathlib.Path, size: int) -> None:
        temporary = path.with_name(f".{path.name}.tmp")
        with temporary.open("ab") as file:
            fcntl.flock(file, fcntl.LOCK_EX)  # whoever else wants this file waits for it
            try:
                if not path.exists():
                    self._make_room(size)
                    self._retried(lambda: self._store.get_file(f"{self._path}/{name}", str(temporary)), name)
                    if (came := temporary.stat().st_size) != size:
                        raise StoreError(f"{self.url}/{name}: {came} of {size} bytes came; run it again")
                    temporary.replace(path)
            finally:
                temporary.unlink(missing_ok=True)

    def _make_room(self, size: int) -> None:
        """Remove the copies that were not read for the longest time until `size` bytes more keep within the bound."""
        files = []
        for file in filter(lambda file: _COPY.fullmatch(file.name), self._cache.iterdir()):
            with contextlib.suppress(FileNotFoundError):  # another process removes as well
                files.append((file.stat().st_mtime, file.stat().st_size, file))
        total = sum(bytes_ for _, bytes_, _ in files)
        for _, bytes_, file in sorted(files):
            if total + size <= self._most:
                return
            file.unlink(missing_ok=True)
            total -= bytes_

    def files(self) -> dict[str, str]:
        """File → MD5 where the store states one, of its folders too; empty where the folder does not exist yet."""

        def listed() -> dict[str, dict[str, Any]]:
            with contextlib.suppress(FileNotFoundError):
                return dict(self._store.find(self._path, detail=True))
            return {}

        found = self._retried(listed, "")
        name = lambda path: path.partition(f"{self._path}/")[2]
        return {name(path): str(about.get("ETag", "")).strip('"') for path, about in found.items() if name(path)}

    def copy(self, folder: pathlib.Path) -> None:
        """Show all files of the URL in a folder on this machine, under their own names."""
        for name in self.files():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).symlink_to(self.fetch(name).absolute())

    def publish(self, folder: pathlib.Path, names: Iterable[str]) -> int:
        """Upload and verify files of a folder in this order, without those whose MD5 the store has; the bytes sent."""
        sent, there = 0, self.files()
        for name in names:
            size, target = (folder / name).stat().st_size, f"{self._path}/{name}"
            if there.get(name) != _md5(folder / name):
                self._retried(lambda n=name, t=target: self._store.put_file(str(folder / n), t), name)  # type: ignore[misc]
                sent += size
                found = self._retried(lambda t=target: self._store.info(t)["size"], name)  # type: ignore[misc]
                if found != size:
                    raise StoreError(f"{self.url}/{name} has {found} of {size} bytes; run the same command again")
        return sent

    def _retried(self, call: Callable[[], _T], name: str) -> _T:
        """The call's value; failures that may pass are tried again, after longer and longer times."""
        where = f"{self.url}/{name}".rstrip("/")
        for wait_s in (*_WAITS_S, None):
            slow = threading.Timer(_SLOW_S, _LOG.warning, ("%s: no answer for %g s, still waiting", where, _SLOW_S))
            slow.daemon = True
            slow.start()
            try:
                return call()
            except Exception as error:
                full = getattr(error, "errno", None) == errno.ENOSPC
                if lasting := _LASTING.get("full" if full else type(error).__name__):
                    raise StoreError(f"{where} {lasting[0]} ({error}): {lasting[1]}") from error
                reason = f"{where}: {type(error).__name__}: {error}"
                if wait_s is None:
                    fix = "wait until the store answers and has room, and run the same command again"
                    raise StoreError(f"{reason}, {len(_WAITS_S) + 1} times: {fix}") from error
                _LOG.warning("%s; trying again in %g s", reason, wait_s)
                time.sleep(wait_s)
            finally:
                slow.cancel()
        raise AssertionError


Place = pathlib.Path | Mirror  # a folder on this machine, or at a URL


def at_url(path: str | os.PathLike[str]) -> bool:
    """True of a URL, also of one that was made a path."""
    return _URL.fullmatch(os.fspath(path)) is not None


def place(path: str | os.PathLike[str]) -> Place:
    """The folder that a path or a URL names."""
    return Mirror(os.fspath(path)) if at_url(path) else pathlib.Path(path)


def local(root: Place, name: str, size: int | None = None) -> pathlib.Path:
    """A file of a folder on this machine; see `Mirror.fetch`."""
    return root / name if isinstance(root, pathlib.Path) else root.fetch(name, size)


def _md5(path: pathlib.Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.md5(usedforsecurity=False)).hexdigest()
