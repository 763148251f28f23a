"""Files of a dataset, on this machine or at any fsspec URL: written whole or not at all, read through a local cache."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import platform
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import fsspec
from upath import UPath

from nlt.errors import UserError
from nlt.paths import cache_root

# A local path is a plain pathlib.Path, a URL a UPath, which is used alike.
AnyPath = Path | UPath
_HOST = platform.node().replace(".", "-")


def open_path(place: str | AnyPath) -> AnyPath:
    """A local path or an fsspec URL, such as s3://bucket/datasets.

    Raises:
        UserError: no installed package knows the URL's protocol.
    """
    if "://" not in str(place) or isinstance(place, UPath):
        return place if isinstance(place, UPath) else Path(place)
    try:
        path = UPath(str(place))
        path.fs  # noqa: B018  imports what the protocol needs
    except (ImportError, ValueError) as error:
        raise UserError(f"data.root: {place}: {' '.join(str(error).split())}") from None
    return path


def write_bytes(path: AnyPath, content: bytes) -> None:
    """Write under a temporary name, then rename: a reader sees the whole file or none. To a URL, in one put.

    Raises:
        UserError: the disk is full. Nothing that was there is harmed.
    """
    if isinstance(path, UPath):
        path.fs.makedirs(path.parent.path, exist_ok=True)
        path.fs.pipe_file(path.path, content)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{_HOST}.{os.getpid()}.tmp")
    try:
        with _locked(temporary) as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
            temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            need = len(content) / 1e6
            raise UserError(f"{path}: no space left on disk ({need:.0f} MB needed); free some and run again") from None
        raise


def _locked(temporary: Path) -> BinaryIO:
    """Open a temporary file for writing and lock it; the lock ends with the file's closing or the process's death."""
    while True:
        file = temporary.open("wb")
        with suppress(OSError):  # some network file systems have no locks
            fcntl.flock(file, fcntl.LOCK_EX)
        try:
            if os.path.samestat(os.fstat(file.fileno()), temporary.stat()):
                return file
        except FileNotFoundError:
            pass  # `remove_leftovers` came between opening and locking
        file.close()


def remove_leftovers(directory: AnyPath) -> None:
    """Delete the temporary files whose writers on this machine are dead.

    A writer that lives holds a lock on its file. Its process id would not tell: a killed process keeps it until its
    parent notices, and the number may be used again. Files of other machines are left alone.
    """
    for leftover in directory.glob(f"**/.*.{_HOST}.*.tmp") if isinstance(directory, Path) else ():
        with suppress(OSError), leftover.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            leftover.unlink()


def list_files(directory: AnyPath) -> set[str]:
    """Every file below a directory, relative to it: one listing, not a question per file."""
    if isinstance(directory, UPath):
        directory.fs.invalidate_cache()  # other machines write too
        root = directory.path.rstrip("/") + "/"
        return {name.removeprefix(root) for name in directory.fs.find(root)}
    return {Path(top, name).relative_to(directory).as_posix() for top, _, names in os.walk(directory) for name in names}


def local_copy(path: AnyPath, fresh: bool = False) -> Path:
    """The file itself if it is local; of a URL, a copy in `NLT_CACHE` (default: ~/.cache/nlt), fetched once.

    Args:
        fresh: fetch it again.

    Raises:
        FileNotFoundError: there is no such file.
    """
    if not isinstance(path, UPath):
        return path
    key = hashlib.sha256(str(path).encode()).hexdigest()
    copy = cache_root() / key[:2] / f"{key}{path.suffix}"
    if fresh or not copy.exists():
        # Not path.fs: a file system that is kept does not survive a fork, as of a loader's worker.
        write_bytes(copy, fsspec.filesystem(path.protocol, **path.storage_options).cat_file(path.path))
    return copy
