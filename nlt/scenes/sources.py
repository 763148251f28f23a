"""List the files that a scene consists of. Needs no renderer."""

from __future__ import annotations

from pathlib import Path

from nlt.scenes import mitsuba_xml


def scene_files(path: Path) -> list[Path]:
    """Return the scene file and every existing file that it refers to: meshes, images, includes."""
    if path.suffix.lower() == ".xml":
        return sorted(set(mitsuba_xml.read(path).files))
    from nlt.scenes.model import named_files  # imported here because most scenes do not need trimesh

    return sorted({path, *(f for name in named_files(path) if (f := path.parent / name).is_file())})
