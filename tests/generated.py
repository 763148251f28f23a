"""The small dataset that tests of generation and of the DataModule share; light to import in many processes."""

from nlt.data.spec import DatasetSpec

SIZE = {
    "resolution": 16, "train": 12, "val": 4, "test": 4, "num_points": 200, "num_photons": 200, "reference_spp": 2,
    "shard_size": 4,
}  # fmt: skip


def spec_of(*scenes, **more):
    return DatasetSpec(list(scenes) or ["living_room"], **{**SIZE, **more})


def content(directory):
    """Every file's bytes."""
    return {str(p.relative_to(directory)): p.read_bytes() for p in sorted(directory.rglob("*")) if p.is_file()}
