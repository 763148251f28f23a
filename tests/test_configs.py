"""Every experiment of configs/data, at every scale of configs/scale, can be generated; the wheel has every config."""

import shutil
import subprocess
import sys
import zipfile

import pytest

from nlt.config import read_configs
from nlt.data.spec import load_spec
from nlt.paths import CONFIGS, PROJECT, config_names, scenes_root

PAPER = {  # its experiments: how many scenes, how they change; the scale; resolution, iterations and batch size
    "egg": (1, "static", "paper_ablation", 128, 200_000, 128),
    "bathroom": (1, "static", "paper_static", 256, 150_000, 128),
    "kitchen": (1, "static", "paper_static", 256, 150_000, 128),
    "fixed_lights": (4, "fixed_lights", "paper", 256, 300_000, 32),
    "moving_lights": (4, "moving_lights", "paper", 256, 300_000, 32),
}


@pytest.mark.parametrize("scale", config_names("scale"))
@pytest.mark.parametrize("data", config_names("data"))
def test_dataset_at_scale(data, scale):
    if data.startswith("real_") and not scenes_root().is_dir():
        pytest.skip(f"no real scenes in {scenes_root()}")
    if data == "renderformer_room" and not (scenes_root() / "renderformer-room/scene.xml").is_file():
        pytest.skip("its files are made by the commands of docs/exam.md")
    spec, _ = load_spec([f"data/{data}", f"scale/{scale}"])
    assert sum(spec.count(shard.split) > 0 and shard.stop - shard.start for shard in spec.shards()) == len(
        spec.scenes
    ) * sum(map(spec.count, ("train", "val", "test")))
    assert len({description.name for description in spec.descriptions}) == len(spec.scenes), "names are unique"
    for description in spec.descriptions:
        moved = description.movables(spec.experiment)
        assert (len(moved) == 0) == (spec.experiment == "static")
        assert spec.nbytes("train") < spec.nbytes("test")


@pytest.mark.parametrize("kind", ["builtin", "real"])
@pytest.mark.parametrize("experiment", PAPER)
def test_papers_experiments(experiment, kind):
    count, change, scale, resolution, iterations, batch = PAPER[experiment]
    if kind == "real" and not scenes_root().is_dir():
        pytest.skip(f"no real scenes in {scenes_root()}")
    files = [f"data/{kind}_{experiment}", f"scale/{scale}"]
    spec, config = load_spec(files)[0], read_configs(files)
    assert (len(spec.scenes), spec.experiment) == (count, change)
    assert (spec.train, spec.test, spec.num_points, spec.num_photons) == (100_000, 2048, 10_000, 10_000)
    assert (spec.noisy_spp, spec.input_spp, 2 * spec.reference_spp) == (1, 4, 128)
    sizes = spec.resolution, config["trainer"]["max_steps"], config["data"]["batch_size"]
    assert sizes == (resolution, iterations, batch)
    assert all(name.startswith("real/") == (kind == "real") for name in spec.scenes)


def test_wheel(tmp_path):
    """It contains every config and everything else of the package, without a symbolic link."""
    for name in ("nlt", "configs"):
        shutil.copytree(PROJECT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(PROJECT / name, tmp_path)
    build = [sys.executable, "-c", "from setuptools import build_meta; build_meta.build_wheel('.')"]
    subprocess.run(build, cwd=tmp_path, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    installed = {name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("nlt/")}
    package = {path.relative_to(tmp_path).as_posix() for path in tmp_path.glob("nlt/**/*") if path.is_file()}
    configs = {f"nlt/configs/{path.relative_to(CONFIGS).as_posix()}" for path in CONFIGS.rglob("*.yaml")}
    assert installed == package | configs
