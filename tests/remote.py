"""A file system that is not local, for tests: whole objects in a flat store without directories, as S3 has."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from typing import ClassVar

from fsspec import AbstractFileSystem


class RemoteFileSystem(AbstractFileSystem):
    """remote://name is an object of that name; its bytes lie in the directory NLT_TEST_REMOTE."""

    protocol = "remote"
    calls: ClassVar[Counter[str]] = Counter()

    def _file(self, path):
        return Path(os.environ["NLT_TEST_REMOTE"]) / self._strip_protocol(path).strip("/").replace("/", "%")

    def ls(self, path, detail=True, **_):
        self.calls["ls"] += 1
        prefix = self._strip_protocol(path).strip("/")
        found = {}
        for file in Path(os.environ["NLT_TEST_REMOTE"]).iterdir():
            name = file.name.replace("%", "/")
            if name == prefix:
                return [{"name": name, "size": file.stat().st_size, "type": "file"}]
            if name.startswith(prefix + "/"):
                below = name[len(prefix) + 1 :].split("/")
                entry = f"{prefix}/{below[0]}"
                found[entry] = {
                    "name": entry,
                    "size": file.stat().st_size,
                    "type": ["file", "directory"][len(below) > 1],
                }
        if not found:
            raise FileNotFoundError(path)
        return list(found.values()) if detail else sorted(found)

    def info(self, path, **_):
        self.calls["info"] += 1
        return super().info(path)

    def cat_file(self, path, start=None, end=None, **_):
        self.calls["cat"] += 1
        return self._file(path).read_bytes()[start:end]

    def pipe_file(self, path, value, **_):
        self.calls["put"] += 1
        self._file(path).write_bytes(value)

    def _rm(self, path):
        self._file(path).unlink()

    def _open(self, path, mode="rb", **_):
        assert mode == "rb", "written in one put"
        return self._file(path).open("rb")
