"""Files of a dataset, local or at any fsspec URL: written atomically, and read through a local cache."""

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

# A local path is a pathlib.Path; a URL is a UPath, which has the same interface.
AnyPath = Path | UPath
_HOST = platform.node().replace(".", "-")


def open_path(place: str | AnyPath) -> AnyPath:
    """Return a path object for a local path or an fsspec URL; raise UserError if no package supports its protocol."""
    if isinstance(place, UPath):
        return place
    if "://" not in str(place):
        return Path(place)
    try:
        path = UPath(str(place))
        path.fs  # noqa: B018  imports the protocol's package
    except (ImportError, ValueError) as error:
        raise UserError(f"data.root: {place}: {' '.join(str(error).split())}") from None
    return path


def write_bytes(path: AnyPath, content: bytes) -> None:
    """Write a file atomically: under a temporary name that is then renamed or, to a URL, in one put.

    Raises:
        UserError: the disk is full; an existing file is kept.
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
            raise UserError(f"{path}: no space left on disk ({need:.0f} MB needed); free space and run again") from None
        raise


def _locked(temporary: Path) -> BinaryIO:
    """Open a temporary file for writing and lock it until it is closed or the process dies."""
    while True:
        file = temporary.open("wb")
        with suppress(OSError):  # some network file systems do not support locks
            fcntl.flock(file, fcntl.LOCK_EX)
        try:
            if os.path.samestat(os.fstat(file.fileno()), temporary.stat()):
                return file
        except FileNotFoundError:
            pass  # `remove_leftovers` deleted the file before it was locked
        file.close()


def remove_leftovers(directory: AnyPath) -> None:
    """Delete the temporary files whose writers on this machine are dead.

    A live writer holds a lock on its file. Its process id is not reliable: a killed process keeps its id until the
    parent notices, and ids are reused. Files of other machines are not touched.
    """
    for leftover in directory.glob(f"**/.*.{_HOST}.*.tmp") if isinstance(directory, Path) else ():
        with suppress(OSError), leftover.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            leftover.unlink()


def list_files(directory: AnyPath) -> set[str]:
    """Return every file below a directory, relative to it, by one listing instead of one request per file."""
    if isinstance(directory, UPath):
        directory.fs.invalidate_cache()  # other machines may have written files
        root = directory.path.rstrip("/") + "/"
        return {name.removeprefix(root) for name in directory.fs.find(root)}
    return {Path(top, name).relative_to(directory).as_posix() for top, _, names in os.walk(directory) for name in names}


def local_copy(path: AnyPath, fresh: bool = False) -> Path:
    """Return a local file itself, or a copy of a URL in `cache_root()`, downloaded once or, if `fresh`, again.

    Raises:
        FileNotFoundError: a URL's file does not exist.
    """
    if not isinstance(path, UPath):
        return path
    key = hashlib.sha256(str(path).encode()).hexdigest()
    copy = cache_root() / key[:2] / f"{key}{path.suffix}"
    if fresh or not copy.exists():
        # path.fs would be a cached file system, which does not survive the fork of a data loader's worker.
        write_bytes(copy, fsspec.filesystem(path.protocol, **path.storage_options).cat_file(path.path))
    return copy
