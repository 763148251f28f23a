"""`nlt data`: verify finds every fault and nothing else, stats counts correctly, show draws twelve pictures."""

import json
import re
import shutil
import zlib
from pathlib import Path

import numpy as np
import pytest
import yaml
from generated import content, spec_of
from safetensors.numpy import load_file, save_file

from nlt.cli import main
from nlt.data import stats
from nlt.data.sample import FIELDS
from nlt.data.spec import FORMAT
from nlt.data.store import pilot_name, write_manifest

pytestmark = pytest.mark.slow


@pytest.fixture
def verify(dataset, tmp_path, capfd):
    """Return a copy of the dataset and a function that verifies it: exit code, findings and the last line of stderr."""
    directory = Path(shutil.copytree(dataset, tmp_path / dataset.name))

    def run():
        before = content(directory)
        capfd.readouterr()
        code = main(["data", "verify", str(directory)])
        out, error = capfd.readouterr()
        assert content(directory) == before, "verify wrote something"
        *findings, summary = out.splitlines()
        assert f"{len(findings)} findings" in summary
        return code, set(findings), error.splitlines()[-1] if error else ""

    return directory, run


def rewrite(path, **changes):
    """Change arrays in place and update their checksums; `changes` maps a field to a function."""
    arrays = load_file(path)
    for name, change in changes.items():
        arrays[name] = arrays[name].copy()
        change(arrays[name])
        arrays["crc:" + name] = np.array([zlib.crc32(row.tobytes()) for row in arrays[name]], np.uint32)
    save_file(arrays, path)


def assign(rows, value):
    def change(array):
        array[rows] = value

    return change


def test_nothing_wrong(verify):
    code, findings, error = verify[1]()
    assert code == 0 and not findings and "nlt: error" not in error


def test_one_bright_pixel_is_fine(verify):
    """At 1 spp, one image can be black and another nearly black although nothing is wrong."""
    directory, run = verify

    def one_pixel(noisy):
        noisy[0] = 0
        noisy[0, :, 3, 5] = 1

    rewrite(directory / "train/000-0000000.safetensors", noisy=one_pixel, noisy_input=assign(0, 0))
    assert run()[:2] == (0, set())


def test_everything_wrong_is_found(verify):
    directory, run = verify
    train, other, val, test = (
        directory / f"{name}.safetensors"
        for name in ("train/000-0000000", "train/000-0000004", "val/000-0000000", "test/000-0000000")
    )
    (directory / "train/000-0000008.safetensors").unlink()
    (directory / "train/notes.txt").write_text("mine")
    rewrite(train, noisy=assign((2, 1, 3, 4), np.nan), photon_hit=assign((0, 7), np.inf), depth=assign(1, 0))
    rewrite(test, reference_a=assign([0, 3], 0), reference_b=assign(1, np.float32(0.25)))
    states = load_file(train)
    copied = {
        name: lambda array, name=name: array.__setitem__(3, states[name][1]) for name in ("translation", "present")
    }
    rewrite(val, noisy=assign(0, 0), noisy_input=assign(0, 0), **copied)
    header = int.from_bytes(other.read_bytes()[:8], "little")
    offsets = json.loads(other.read_bytes()[8 : 8 + header])["albedo"]["data_offsets"]
    harmed = bytearray(other.read_bytes())
    harmed[8 + header + offsets[0] + (offsets[1] - offsets[0]) * 3 // 4 + 1] ^= 4  # in the last of four samples
    other.write_bytes(harmed)
    points = load_file(directory / "points-000.safetensors")
    save_file({**points, "albedo": points["albedo"].astype(np.float16)}, directory / "points-000.safetensors")
    (directory / "manifest.json").write_text(
        (directory / "manifest.json").read_text().replace(f'"format": {FORMAT}', f'"format": {FORMAT + 1}')
    )
    code, findings, error = run()
    assert code == 2 and re.search(r"^nlt: error: .*: 12 findings; delete .*nlt generate", error)
    expected = [
        "manifest.json: format: ", "train/000-0000008.safetensors: missing", "train/notes.txt: not part",
        "train/000-0000000.safetensors: noisy: sample 2: not finite",
        "train/000-0000000.safetensors: photon_hit: sample 0: not finite",
        "train/000-0000000.safetensors: depth: sample 1: the camera sees no surface",
        "train/000-0000004.safetensors: albedo: sample 3: fails its CRC",
        "test/000-0000000.safetensors: reference_a: sample 0, 3: black or constant",
        "test/000-0000000.safetensors: reference_b: sample 1: black or constant",
        "val/000-0000000.safetensors: noisy, noisy_input: sample 0: both black",
        "points-000.safetensors: albedo: is ((1, 200, 3), 'float16'), not ((1, 200, 3), 'float32')",
        "living_room: 1 states are in train and in val",
    ]  # fmt: skip
    assert len(findings) == len(expected)
    for start in expected:
        assert any(finding.startswith(start) for finding in findings), (start, findings)


@pytest.mark.parametrize("cut", [0, 7, 5000, -1])
def test_truncated(verify, cut):
    directory, run = verify
    shard = directory / "val/000-0000000.safetensors"
    shard.write_bytes(shard.read_bytes()[:cut])
    code, findings, _ = run()
    (finding,) = findings
    assert code == 2 and finding.startswith("val/000-0000000.safetensors: cannot be read: ")


@pytest.mark.parametrize("action", ["show", "verify", "stats"])
def test_no_dataset(action, tmp_path, capfd):
    assert main(["data", action, str(tmp_path)]) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and str(tmp_path) in error and "no dataset here" in error
    (tmp_path / "manifest.json").write_text('{"spec": {"nope": 1}}')
    assert main(["data", action, str(tmp_path)]) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and "manifest.json: spec" in error


def test_stats(dataset, tmp_path, monkeypatch, capfd):
    paper = {"resolution": 24, "train": 100_000, "val": 2, "test": 46, "num_photons": 50}
    (tmp_path / "scale").mkdir()
    (tmp_path / "scale" / "paper.yaml").write_text(yaml.safe_dump({"data": {"dataset": paper}}))
    monkeypatch.setattr(stats, "CONFIGS", tmp_path)
    assert main(["data", "stats", str(dataset), "--workers=1"]) == 0
    report = capfd.readouterr().out
    rows = {words[0]: words[1:] for words in map(str.split, report.splitlines()) if words}
    assert sorted(name for fields in stats.STAGES.values() for name in fields) == sorted(FIELDS)
    stored = load_file(dataset / "val/000-0000000.safetensors")
    for name in FIELDS:
        assert rows[name][0].replace(",", "") == str(stored[name][0].nbytes), name
    assert rows["noisy"][1].replace(",", "") == str(3 * 24 * 24 * 4)
    milliseconds = {name: float(rows[name][-1]) for name in ("noisy", "noisy_input", "target", "reference")}
    assert all(value > 0 for value in milliseconds.values())
    # 100,048 samples in 98 processes, by one worker.
    hours, train, evaluated, start = map(
        float, re.search(r"paper's: .*: ([\d.]+) h .*\((\d+) ms.* (\d+) ms.* ([\d.]+) s", report).groups()
    )
    assert hours * 3600 == pytest.approx(100_000 * train / 1e3 + 48 * evaluated / 1e3 + 98 * start, abs=60 + 36)
    size = sum(stored[name][0].nbytes for name in ("camera_matrix", "world_to_view", "translation", "present"))
    size += 24 * 24 * (5 * 3 * 4 + 4 + 3 * 3 * 2) + 50 * (12 + 6 + 12 + 12 + 1)
    assert f"{(100_048 * size + (48 * 2 - 46) * 24 * 24 * 12) / 1e9:.2f} GB" in report


def test_stats_count_the_chosen_spp(tmp_path, monkeypatch):
    """The dataset's references count with the spp that the pilot views chose, the paper's with those of its scale."""
    spec, counted = spec_of("living_room", "egg", reference_mse=1e-3, reference_spp=512), []
    write_manifest(tmp_path, spec, "")
    for scene, spp in enumerate((128, 32)):
        (tmp_path / pilot_name(scene)).write_text(json.dumps({"spp": spp, "predicted_mse": 1e-3}))
    measured = dict.fromkeys((*stats.STAGES, "start"), 1.0)
    monkeypatch.setattr(stats, "_measure", lambda _, spp, *rest: (counted.append(spp), measured)[1])
    stats.stats(str(tmp_path), 1)
    assert counted == [[128, 32], [64, 64]]


def test_show(dataset, tmp_path, monkeypatch):
    from matplotlib import pyplot

    from nlt.report import figures

    drawn = []
    monkeypatch.setattr(figures.plt, "close", drawn.append)
    assert main(["data", "show", str(dataset), "--split=val", "--index=3", "-o", str(tmp_path / "s.png")]) == 0
    (figure,) = drawn
    titles = [axis.get_title() for axis in figure.axes]
    assert [title.split()[0] for title in titles] == [f"({k})" for k in range(1, 13)]
    image = pyplot.imread(tmp_path / "s.png")
    assert image.std() > 0.05
    assert main(["data", "show", str(dataset), "--index=4", "-o", str(tmp_path / "t.png")]) == 2
    assert not (tmp_path / "t.png").exists()
    assert spec_of().test == 4
