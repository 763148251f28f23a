"""Which files a scene file is made of; no renderer needed."""

from __future__ import annotations

from pathlib import Path

from nlt.scenes import mitsuba_xml


def scene_files(path: Path) -> list[Path]:
    """The file and every file that it names and that is there: meshes, images, includes."""
    return sorted(set(mitsuba_xml.read(path).files))
