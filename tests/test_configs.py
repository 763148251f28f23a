"""Every experiment of configs/data, at every scale of configs/scale, is a dataset that can be generated."""

import pytest

from nlt.config import read_configs
from nlt.data.spec import load_spec
from nlt.paths import config_names, find_config, scenes_root

PAPER = {  # its experiments: how many scenes, how they change; the scale; resolution, iterations and batch size
    "static_egg": (1, "static", "paper_ablation", 128, 200_000, 128),
    "static_bathroom": (1, "static", "paper_static", 256, 150_000, 128),
    "static_kitchen": (1, "static", "paper_static", 256, 150_000, 128),
    "dynamic_fixed_lights": (4, "fixed_lights", "paper", 256, 300_000, 32),
    "dynamic_moving_lights": (4, "moving_lights", "paper", 256, 300_000, 32),
}


@pytest.mark.parametrize("scale", config_names("scale"))
@pytest.mark.parametrize("data", config_names("data"))
def test_dataset_at_scale(data, scale):
    if data.startswith("real/") and not scenes_root().is_dir():
        pytest.skip(f"no real scenes in {scenes_root()}")
    spec, _ = load_spec([str(find_config("data", data)), str(find_config("scale", scale))])
    assert sum(spec.count(shard.split) > 0 and shard.stop - shard.start for shard in spec.shards()) == len(
        spec.scenes
    ) * sum(map(spec.count, ("train", "val", "test")))
    assert len({description.name for description in spec.descriptions}) == len(spec.scenes), "names are unique"
    for description in spec.descriptions:
        moved = description.movables(spec.experiment)
        assert (len(moved) == 0) == (spec.experiment == "static")
        assert spec.nbytes("train") < spec.nbytes("test")


@pytest.mark.parametrize("folder", ["", "real/"])
@pytest.mark.parametrize("experiment", PAPER)
def test_papers_experiments(experiment, folder):
    count, change, scale, resolution, iterations, batch = PAPER[experiment]
    if folder and not scenes_root().is_dir():
        pytest.skip(f"no real scenes in {scenes_root()}")
    files = [str(find_config("data", folder + experiment)), str(find_config("scale", scale))]
    spec, config = load_spec(files)[0], read_configs(files)
    assert (len(spec.scenes), spec.experiment) == (count, change)
    assert (spec.train, spec.test, spec.points, spec.photons) == (100_000, 2048, 10_000, 10_000)
    assert (spec.noisy_spp, spec.input_spp, 2 * spec.reference_spp) == (1, 4, 128)
    assert (spec.resolution, config["trainer"]["max_steps"], config["data"]["batch_size"]) == (
        resolution,
        iterations,
        batch,
    )
    for name in spec.scenes:
        assert name.startswith(folder) and (folder or "/" not in name)
