"""Which files a scene file is made of; no renderer needed."""

from __future__ import annotations

from pathlib import Path

from nlt.scenes import mitsuba_xml


def scene_files(path: Path) -> list[Path]:
    """The file and every file that it names and that is there: meshes, images, includes."""
    if path.suffix.lower() == ".xml":
        return sorted(set(mitsuba_xml.read(path).files))
    from nlt.scenes.model import named_files  # here: it imports trimesh, which most scenes do not need

    return sorted({path, *(f for name in named_files(path) if (f := path.parent / name).is_file())})
