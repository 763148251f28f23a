"""Generation writes the same bytes however often it is interrupted, on every engine and on every file system."""

import dataclasses
import errno
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import namedtuple
from contextlib import suppress
from pathlib import Path

import drjit as dr
import fsspec
import lightning as L
import numpy as np
import pytest
from conftest import write_room
from generated import SIZE, content, spec_of
from remote import RemoteFileSystem
from tiny import SCALE, write

from nlt.data import engines, files, store
from nlt.data import generate as generation
from nlt.data.generate import generate
from nlt.data.render import SampleRenderer
from nlt.data.spec import DatasetSpec
from nlt.data.verify import verify
from nlt.errors import UserError
from nlt.paths import PROJECT
from nlt.scenes.lanes import is_jit
from nlt.training import run_lightning

pytestmark = pytest.mark.slow

# ---- determinism and interruption -----------------------------------------------------------------------


def test_same_bytes_twice(dataset, tmp_path):
    again = generate(spec_of(), tmp_path, workers=2)
    assert content(again) == content(dataset) and again.name == dataset.name
    before = {p: p.stat().st_mtime_ns for p in again.rglob("*")}
    generate(spec_of(), tmp_path, workers=1)
    assert {p: p.stat().st_mtime_ns for p in again.rglob("*")} == before, "a complete dataset is left alone"
    assert spec_of(seed=1).directory("x") != spec_of().directory("x")


def test_progress_counts_what_samples_cost(tmp_path, monkeypatch):
    """The workers count a reference as often as it is slower than a training sample, and so does the bar's total."""
    bars, steps = [], []

    class Bar(generation.tqdm):
        def update(self, n=1):
            bars.append(self)
            steps.append(n)
            super().update(n)

    monkeypatch.setattr(generation, "tqdm", Bar)
    monkeypatch.setattr(generation, "_announce", lambda *_: 7)
    spec = spec_of()
    generate(spec, tmp_path, workers=1)
    assert bars[0].total == spec.train + 7 * (spec.val + spec.test) == sum(steps)
    assert steps[-1] == 0, "what the workers counted is the total"


HOLD = """
import sys, time
from pathlib import Path
from nlt.data.files import _locked
with _locked(Path(sys.argv[1])):
    print("locked", flush=True)
    time.sleep(600)
"""


def test_leftovers_of_a_killed_writer(tmp_path):
    """A live writer keeps its temporary file; a killed writer loses it even while the process is still a zombie."""
    half = tmp_path / f".half.safetensors.{files._HOST}.1.tmp"
    foreign = tmp_path / ".half.safetensors.elsewhere.1.tmp"
    foreign.write_bytes(b"half")
    with subprocess.Popen([sys.executable, "-c", HOLD, str(half)], cwd=PROJECT, stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline() == b"locked\n"
        files.remove_leftovers(tmp_path)
        assert half.exists()
        writer.kill()
        os.waitid(os.P_PID, writer.pid, os.WEXITED | os.WNOWAIT)  # dead, and still a zombie
        os.kill(writer.pid, 0)
        files.remove_leftovers(tmp_path)
        assert not half.exists() and foreign.exists()


def test_a_leftover_removed_before_it_is_locked(tmp_path, monkeypatch):
    """A writer notices that its temporary file was deleted before it was locked, and opens it again."""
    removed, lock = [], files.fcntl.flock

    def removed_first(file, operation):
        if not removed:
            removed.append(next(tmp_path.glob(".*.tmp")).unlink())
        lock(file, operation)

    monkeypatch.setattr(files.fcntl, "flock", removed_first)
    files.write_bytes(tmp_path / "whole", b"content")
    assert removed and (tmp_path / "whole").read_bytes() == b"content" and len(list(tmp_path.iterdir())) == 1


# ---- how many samples per pixel the references have -----------------------------------------------------

PILOTED = {"experiment": "fixed_lights", "train": 0, "val": 2, "test": 3, "reference_spp": 100, "reference_mse": 6e-4}


@pytest.fixture(scope="module")
def piloted(tmp_path_factory, variant):
    return generate(spec_of(**PILOTED), tmp_path_factory.mktemp("piloted"), workers=1)


def as_shown(radiance, exposure):
    x = np.clip(np.asarray(radiance, float) * exposure, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("decay", [1, 0.7])
@pytest.mark.parametrize(("most", "target"), [(4096, 1e-3), (4096, 3e-6), (1000, 1e-5), (20, 1e-3), (32, 1e-3)])
def test_chosen_spp_by_trying_all(most, target, decay):
    """The choice is the first power of two, from the pilot's spp on, whose MSE is below the target, or the maximum."""
    spec = spec_of(reference_spp=most, reference_mse=target)
    pilot = min(32, most)
    for mse in [0.0, target, *np.random.default_rng(0).uniform(0, 20, 50) * target]:
        enough = (2**k for k in range(5, 12) if mse * (pilot / 2**k) ** decay <= target and 2**k < most)
        assert generation.needed_spp(spec, mse, decay) == next(enough, most)


def test_pilot_measures_the_halves_disagreement(piloted):
    """The pilot's MSE and its decay agree with numpy's, over many pairs of halves of the same views, by other seeds."""
    spec = spec_of(**PILOTED)
    render, errors = SampleRenderer(spec, 0), {8: [], 32: []}
    for split, index in (("test", 0), ("test", 1), ("test", 2), ("val", 0)):
        camera = render.place(split, index)
        for spp, of_views in errors.items():
            images = [as_shown(render.radiance(camera, spp, seed), render.description.exposure) for seed in range(20)]
            of_views.append(np.mean([(a - b) ** 2 for a, b in zip(images[::2], images[1::2], strict=True)]))
    found = json.loads((piloted / store.pilot_name(0)).read_text())
    assert found["pilot_spp"] == 32 and found["pilot_mse"] == pytest.approx(np.mean(errors[32]), rel=0.3)
    power = np.log(np.mean(errors[8]) / np.mean(errors[32])) / np.log(4)
    assert 0.5 < found["decay"] < 1 and found["decay"] == pytest.approx((1 + power) / 2, abs=0.1)
    assert found["spp"] == generation.needed_spp(spec, found["pilot_mse"], found["decay"])
    assert found["predicted_mse"] == pytest.approx(found["pilot_mse"] * (32 / found["spp"]) ** found["decay"])


def test_references_have_the_chosen_spp(piloted):
    """In both splits, references have the bytes that a spec with this fixed spp gives."""
    (reference,) = store.references(piloted, spec_of(**PILOTED))
    assert 32 < reference["spp"] <= 100, "the target is one that the pilot's own samples do not reach"
    render = SampleRenderer(spec_of(**{**PILOTED, "reference_spp": reference["spp"], "reference_mse": 0}), 0)
    for split in ("test", "val"):
        stored = store.ShardReader().read(piloted / f"{split}/000-0000000.safetensors", 1, ["reference_a"])
        assert np.array_equal(stored["reference_a"], render.sample(split, 1, only=["reference_a"])["reference_a"])


def _no_pilot(*_):
    raise UserError("a second choice")


def _stopped(*_):
    raise KeyboardInterrupt


def test_chosen_once(piloted, tmp_path, monkeypatch):
    """A generation stopped after the choice keeps it; a lost file is chosen again, with the same result."""
    spec = spec_of(**PILOTED)
    with monkeypatch.context() as patch:
        patch.setattr(generation, "_announce", _stopped)
        with pytest.raises(KeyboardInterrupt):
            generate(spec, tmp_path, workers=1)
    directory = spec.directory(tmp_path)
    assert set(content(directory)) == {"manifest.json", "pilot-000.json"}
    with monkeypatch.context() as patch:
        patch.setattr(generation, "_pilot", _no_pilot)
        patch.setattr(generation, "_announce", lambda *_: 1)
        generate(spec, tmp_path, workers=2)
    assert content(directory) == content(piloted)
    (directory / "pilot-000.json").unlink()
    with pytest.raises(UserError, match=r"incomplete, 1 files missing, such as pilot-000.json"):
        store.check_dataset(directory, spec)
    monkeypatch.setattr(generation, "_run", lambda *_: None)
    monkeypatch.setattr(generation, "_announce", lambda *_: 1)
    generate(spec, tmp_path, workers=1)
    assert content(directory) == content(piloted)


def test_damaged_choice(piloted, tmp_path, capsys):
    directory = shutil.copytree(piloted, tmp_path / piloted.name)
    verify(str(directory))
    (directory / "pilot-000.json").write_text('{"spp": 64}')
    with pytest.raises(UserError, match="1 findings"):
        verify(str(directory))
    assert "pilot-000.json: damaged ('predicted_mse'); delete the file" in capsys.readouterr().out
    with pytest.raises(UserError, match=r"pilot-000.json: damaged"):
        store.references(directory, spec_of(**PILOTED))


def test_no_pilots_without_references():
    assert not spec_of(reference_mse=1e-4, val=0, test=0).has_pilots and not spec_of().has_pilots
    assert spec_of(reference_mse=0).directory("x") == spec_of(reference_mse=0.0).directory("x")


# ---- interruption ---------------------------------------------------------------------------------------

LONG = {**SIZE, "resolution": 8, "train": 768, "val": 16, "test": 16, "num_points": 16, "num_photons": 16,
        "input_spp": 1, "reference_spp": 1, "shard_size": 64}  # fmt: skip
# The trial of the renderer before the first job would be half of the time.
RUN = f"""if __name__ == "__main__":
    import sys
    from nlt.data import generate as generation
    from nlt.data.spec import DatasetSpec
    generation._announce = lambda *_: 1
    generation.generate(DatasetSpec(sys.argv[2:], **{LONG!r}), sys.argv[1], workers=2)
"""


def start(root, scene):
    """Start a generation of sixteen shards of 64 samples in its own process group."""
    command = [sys.executable, "-c", RUN, str(root), scene]
    quiet = subprocess.DEVNULL
    return subprocess.Popen(command, cwd=PROJECT, start_new_session=True, stdout=quiet, stderr=quiet)


def shards(directory):
    """Return the bytes of every shard and point cloud, with the inode and the time that show whether it was touched."""
    found = {path: (path.read_bytes(), path.stat()) for path in directory.rglob("*.safetensors")}
    return {str(p.relative_to(directory)): (data, s.st_ino, s.st_mtime_ns) for p, (data, s) in found.items()}


def test_sixteen_shards_survive(tmp_path):
    """A generation survives kill -9 at ten random moments, two concurrent runs, a flipped bit and a deleted shard."""
    scene = str(write_room(tmp_path / "room"))
    spec = DatasetSpec([scene], **LONG)
    assert start(tmp_path / "undisturbed", scene).wait(120) == 0
    expected = content(spec.directory(tmp_path / "undisturbed"))
    assert len(expected) == 16 + 2

    directory, rng = spec.directory(tmp_path / "killed"), np.random.default_rng(0)
    moments, before = [], {}
    for _ in range(10):
        run, more = start(tmp_path / "killed", scene), int(rng.integers(2))
        deadline = time.monotonic() + 60
        while len(list(directory.rglob("*.safetensors"))) < min(len(before) + more, 15):
            assert run.poll() is None and time.monotonic() < deadline
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.2 if more else 1))
        os.killpg(run.pid, signal.SIGKILL)
        run.wait()
        after = shards(directory)
        assert all(data == expected[name] for name, (data, *_) in after.items()), "half a file has its name"
        assert before == {name: after[name] for name in before}, "a finished file was touched"
        moments.append(len(after))
        before = after
    assert 3 < moments[-1] < 17 and len(set(moments)) > 3, moments

    both = [start(tmp_path / "killed", scene) for _ in range(2)]
    assert [run.wait(120) for run in both] == [0, 0]
    assert content(directory) == expected
    assert {name: shards(directory)[name] for name in before} == before

    harmed = directory / "train/000-0000128.safetensors"
    harmed.write_bytes(bytes(byte ^ (8 * (k == 100_000)) for k, byte in enumerate(harmed.read_bytes())))
    with pytest.raises(UserError, match=r"000-0000128.*damaged"):
        [store.ShardReader().read(harmed, row, spec.fields("train")) for row in range(64)]
    harmed.unlink()
    with pytest.raises(UserError, match=r"incomplete, 1 files missing, such as train/000-0000128"):
        store.check_dataset(directory, spec)
    assert start(tmp_path / "killed", scene).wait(120) == 0
    assert content(directory) == expected


_render = generation._render


def _killed_once(spec, directory, variant, cost, job, *rest):
    """Kill the worker once, after its first shard."""
    marker = Path(directory).parent / "killed"
    if not marker.exists():
        marker.touch()
        _render(spec, directory, variant, cost, generation.Job(job.scene, job.shards[:1], False), *rest)
        os.kill(os.getpid(), signal.SIGKILL)
    _render(spec, directory, variant, cost, job, *rest)


def _always_killed(*_):
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize("workers", [1, 2, 3, 64])
@pytest.mark.parametrize("scenes", [["living_room"], ["living_room", "kitchen"]])
def test_workers_have_equally_many_jobs(scenes, workers):
    spec = DatasetSpec(scenes, train=1600, val=8, test=96)
    missing = store.dataset_files(spec)
    jobs = generation.plan(spec, missing, workers)
    assert len(jobs) % workers == 0 or all(len(job.shards) == 1 for job in jobs)
    assert sorted(shard.name for job in jobs for shard in job.shards) == sorted(s.name for s in spec.shards())
    references = [sum(shard.size for shard in job.shards if shard.split != "train") for job in jobs]
    assert max(references) - min(references) <= 8, "references are spread over the jobs"
    assert sum(job.needs_points for job in jobs) == len(scenes)


def test_killed_worker(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(generation, "_render", _killed_once)
    monkeypatch.setattr(generation, "_announce", lambda *_: 1)
    assert content(generate(spec_of(), tmp_path, workers=1)) == content(dataset)
    assert (tmp_path / "killed").exists()


def test_worker_killed_twice(tmp_path, monkeypatch):
    monkeypatch.setattr(generation, "_render", _always_killed)
    monkeypatch.setattr(generation, "_announce", lambda *_: 1)
    with pytest.raises(UserError, match=r"living_room.*worker died twice"):
        generate(spec_of(), tmp_path, workers=1)


@pytest.mark.parametrize("preload", [(), ("json",)])
def test_nothing_outlives_a_killed_command(preload, tmp_path):
    """A killed command's processes end in the middle of their job; their children use the default start method."""
    (tmp_path / "beating.py").write_text(
        "import multiprocessing\nimport time\nfrom pathlib import Path\n"
        "def beat(job, threads, tick):\n"
        "    while True:\n"
        "        Path('next').write_text(f'{multiprocessing.get_start_method()} {time.time()}')\n"
        "        Path('next').replace(job)\n"
        "        time.sleep(0.02)\n"
    )
    run = f"list(Local(1, {preload}).run(beating.beat, ['beat'], {{}}))"
    code = f"from nlt.data.engines import Local; import beating; {run}"
    path = os.pathsep.join([str(tmp_path), *sys.path])
    command = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, env={**os.environ, "PYTHONPATH": path})
    beat = tmp_path / "beat"
    while not beat.exists():
        assert command.poll() is None
        time.sleep(0.05)
    command.kill()
    seen = []
    while len(seen) < 2 or seen[-1] != seen[-2]:
        assert len(seen) < 20
        seen.append(beat.read_text())
        time.sleep(1)
    assert seen[-1].startswith(multiprocessing.get_start_method())


# ---- nothing is compiled twice --------------------------------------------------------------------------


@pytest.mark.parametrize("experiment", ["static", "fixed_lights", "moving_lights"])
def test_no_kernel_is_compiled_anew(experiment):
    """A new view, state or number of photons per emitter runs the kernels that the first sample compiled."""
    if not is_jit():
        pytest.skip("the scalar variant compiles nothing")
    render = SampleRenderer(spec_of(experiment=experiment, train=8, test=2), 0)
    compiled: set = set()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for split, index in [("test", 0), ("test", 1), *(("train", k) for k in range(8))]:
            render.sample(split, index)
            kernels = {k["hash"] for k in dr.kernel_history((dr.KernelType.JIT,))}
            assert kernels and (not compiled or kernels <= compiled), (split, index)
            compiled |= kernels
            dr.kernel_history_clear()


# ---- clusters -------------------------------------------------------------------------------------------


def _kills_its_dask_worker(spec, directory, variant, cost, job, *rest):
    """Kill the Dask worker, which is the parent of the job's process, once after the first shard."""
    marker = Path(directory).parent / "killed"
    if not marker.exists():
        _render(spec, directory, variant, cost, generation.Job(job.scene, job.shards[:1], False), *rest)
        with suppress(FileExistsError), marker.open("x"):
            os.kill(os.getppid(), signal.SIGKILL)
            time.sleep(0.5)
    _render(spec, directory, variant, cost, job, *rest)


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster


def test_killed_dask_worker(cluster, dataset, tmp_path, monkeypatch):
    """The run is complete and has the same bytes although one of two Dask workers is killed during a job."""
    monkeypatch.setattr(generation, "_render", _kills_its_dask_worker)
    workers = {worker.pid for worker in cluster.workers.values()}
    assert content(generate(spec_of(), tmp_path, scheduler=cluster.scheduler_address)) == content(dataset)
    assert (tmp_path / "killed").exists() and len(workers) == 2
    assert workers != {worker.pid for worker in cluster.workers.values()}


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """Run where submitit may write its logs, and let its tasks import what this process can."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))


def _mistaken(*_):
    raise UserError("scene.yaml: objects: wrong")


@pytest.mark.parametrize("where", ["local", "dask", "slurm-local"])
def test_mistake_far_away(where, tmp_path, monkeypatch, request, elsewhere):
    monkeypatch.setattr(generation, "_render", _mistaken)
    monkeypatch.setattr(generation, "_announce", lambda *_: 1)
    scheduler = request.getfixturevalue("cluster").scheduler_address if where == "dask" else where
    with pytest.raises(UserError, match=r"^scene.yaml: objects: wrong$"):
        generate(spec_of(), tmp_path, workers=1, scheduler=scheduler)


def test_slurm(dataset, tmp_path, monkeypatch, elsewhere):
    """A task that submitit's local stand-in for Slurm runs is killed once; the bytes are the same."""
    monkeypatch.setattr(generation, "_render", _killed_once)
    monkeypatch.setattr("submitit.Job._results_timeout_s", 0)  # for file systems that are late
    assert content(generate(spec_of(), tmp_path, workers=2, scheduler="slurm-local")) == content(dataset)
    assert (tmp_path / "killed").exists()


def test_slurm_script(tmp_path, monkeypatch, elsewhere):
    """A cluster would get an array of the jobs with the user's options."""
    for name in ("srun", "sbatch"):
        (tmp_path / name).write_text("#!/bin/sh\ncat $1 > given; echo no such partition >&2; exit 1\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setattr(generation, "_announce", lambda *_: 1)
    with pytest.raises(UserError, match=r"--slurm: .*slurm_nope"):
        generate(spec_of(), tmp_path, scheduler="slurm", slurm={"nope": "1"})
    options = {"partition": "gpu", "time": "60", "cpus_per_task": "4"}
    with pytest.raises(UserError, match=r"--scheduler slurm: .*no such partition"):
        generate(spec_of(), tmp_path, workers=2, scheduler="slurm", slurm=options)
    given = (tmp_path / "given").read_text()
    for line in ("--array=0-1%2", "--partition=gpu", "--time=60", "--cpus-per-task=4", "--job-name=nlt"):
        assert f"#SBATCH {line}\n" in given, given


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("nowhere", None, {}), "--scheduler: must be local, slurm"),
        (("local", 1, {"time": "1"}), "--slurm: "),
        (("slurm-local", 1, {"time": "1"}), "--slurm: "),
        (("slurm", 1, {}), "--scheduler slurm: .*srun"),
        (("tcp://127.0.0.1:1", 1, {}), "tcp://127.0.0.1:1: no Dask scheduler answers"),
    ],
)
def test_engine_refused(arguments, words, monkeypatch, elsewhere):
    monkeypatch.setattr(engines, "_CONNECT", 0.2)
    with pytest.raises(UserError, match=words):
        engines.find_engine(*arguments)


@pytest.mark.parametrize(("scheduler", "package"), [("slurm", "submitit"), ("tcp://a:1", "distributed")])
def test_missing_extra(scheduler, package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(UserError, match=rf"--scheduler: {package} is not installed; .*nlt\[cluster\]"):
        engines.find_engine(scheduler, None, {})


def test_files_that_nobody_sees(tmp_path, monkeypatch):
    """Generation reports that the files of workers with a disk of their own are missing."""
    monkeypatch.setattr(generation, "_render", _writes_nothing)
    monkeypatch.setattr(generation, "_announce", lambda *_: 1)
    with pytest.raises(UserError, match=r"is still missing; check that all machines see this directory"):
        generate(spec_of(), tmp_path, workers=1)


def _writes_nothing(*_):
    pass


# ---- other file systems ---------------------------------------------------------------------------------


@pytest.fixture
def remote(tmp_path, monkeypatch):
    """Return a URL whose file system worker processes find like s3://, by a package's entry point."""
    package = tmp_path / "packages" / "remote-1.dist-info"
    package.mkdir(parents=True)
    (package / "entry_points.txt").write_text("[fsspec.specs]\nremote = remote:RemoteFileSystem\n")
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: remote\nVersion: 1\n")
    monkeypatch.syspath_prepend(package.parent)
    (tmp_path / "store").mkdir()
    monkeypatch.setenv("NLT_TEST_REMOTE", str(tmp_path / "store"))
    monkeypatch.setenv("NLT_CACHE", str(tmp_path / "cache"))
    fsspec.register_implementation("remote", RemoteFileSystem, clobber=True)
    return "remote://bucket/datasets"


@pytest.mark.filterwarnings("ignore:UPath 'remote'")
def test_remote(remote, dataset, tmp_path, monkeypatch):
    """A dataset generated at a URL has the same samples; every file is fetched once, and a damaged copy again."""
    objects = tmp_path / "store"
    directory = generate(spec_of(), remote, workers=2)
    names = {f"bucket%datasets%{directory.name}%{name}".replace("/", "%"): name for name in content(dataset)}
    assert {names[name]: data for name, data in content(objects).items()} == content(dataset)

    calls = RemoteFileSystem.calls
    calls.clear()
    assert not store.missing_files(directory, spec_of())
    assert calls["ls"] == 4 and calls["info"] <= 1, "asked about every file"
    calls.clear()
    for reader in (store.ShardReader(), store.ShardReader()):
        for shard in spec_of().shards():
            for row in range(shard.stop - shard.start):
                ours = reader.read(directory / shard.name, row, spec_of().fields(shard.split))
                theirs = store.ShardReader().read(dataset / shard.name, row, spec_of().fields(shard.split))
                assert all(np.array_equal(ours[name], theirs[name]) for name in theirs)
    assert calls["cat"] == len(spec_of().shards())

    shard, fields = directory / spec_of().shards()[0].name, spec_of().fields("test")
    copy = files.local_copy(shard)
    whole = copy.read_bytes()
    for harmed in (whole[:-9], whole[:9000] + bytes([whole[9000] ^ 1]) + whole[9001:]):
        copy.write_bytes(harmed)
        reader = store.ShardReader()
        [reader.read(shard, row, fields) for row in range(4)]
        assert copy.read_bytes() == whole
    assert calls["cat"] == len(spec_of().shards()) + 2

    (objects / f"bucket%datasets%{directory.name}%test%000-0000000.safetensors").write_bytes(whole[:-9])
    copy.unlink()
    with pytest.raises(UserError, match=r"remote://.*test/000-0000000.safetensors: damaged"):
        store.ShardReader().read(shard, 3, fields)
    shard.unlink()
    copy.unlink()
    with pytest.raises(UserError, match=r"remote://.*: missing shard"):
        store.ShardReader().read(shard, 0, fields)
    monkeypatch.setattr(generation, "_announce", lambda *_: 1)
    generate(spec_of(), remote, workers=1)
    assert {names[name]: data for name, data in content(objects).items()} == content(dataset)


@pytest.mark.parametrize("url", ["nope://bucket/x", "nope+more://x"])
def test_unknown_protocol(url):
    with pytest.raises(UserError, match=rf"data.root: {url.replace('+', '.')}: .*nope"):
        files.open_path(url)


# ---- a full disk ----------------------------------------------------------------------------------------


def test_full_disk_within_a_write(tmp_path, monkeypatch):
    path = tmp_path / "shard"
    path.write_bytes(b"before")

    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UserError, match=r"shard: no space left on disk"):
        files.write_bytes(path, b"after")
    assert [p.name for p in tmp_path.iterdir()] == ["shard"] and path.read_bytes() == b"before"


def _fills_the_disk(*arguments):
    """The disk is full when this process writes its second file."""
    written, fsync = [], os.fsync

    def full(file):
        written.append(file)
        if len(written) > 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        fsync(file)

    os.fsync = full
    _render(*arguments)


def test_full_disk_on_the_way(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(generation, "_announce", lambda *_: 1)
    with monkeypatch.context() as patch:
        patch.setattr(generation, "_render", _fills_the_disk)
        with pytest.raises(UserError, match=r"no space left on disk"):
            generate(spec_of(), tmp_path, workers=1)
    (directory,) = tmp_path.iterdir()
    kept = content(directory)
    assert len(kept) == 2 and kept.items() < content(dataset).items()
    assert content(generate(spec_of(), tmp_path, workers=1)) == content(dataset)


def test_full_disk_at_the_start(tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10, 9, 1))
    with pytest.raises(UserError, match=r"no space left on disk.*GB"):
        generate(spec_of(), tmp_path, workers=1)
    assert not list(tmp_path.rglob("*.safetensors"))


@pytest.mark.parametrize(
    ("quota", "cpus"), [("max 100000", 4), ("150000 100000", 1), ("250000 100000", 2), ("10 100", 1)]
)
def test_cpus_within_a_containers_quota(tmp_path, monkeypatch, quota, cpus):
    (tmp_path / "cpu.max").write_text(quota)
    monkeypatch.setattr(engines, "_CPU_QUOTA", tmp_path / "cpu.max")
    monkeypatch.setattr("os.sched_getaffinity", lambda _: range(4))
    assert engines.available_cpus() == cpus


# ---- crops ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("crop", "words"),
    [(4, "crop: must be 0 .* 8 to data.dataset.resolution .16., is 4"), (17, "is 17"), (-1, "crop")],
)
def test_crop_refused(crop, words):
    with pytest.raises(UserError, match=words):
        spec_of(crop=crop)


@pytest.fixture(scope="module")
def crops(tmp_path_factory):
    """A dataset like `dataset`, but its training samples are windows."""
    return generate(spec_of(crop=8), tmp_path_factory.mktemp("crops"), workers=1)


def test_crops_are_windows_of_the_images(dataset, crops):
    """Training samples are windows of the views that whole images would show; the other splits are the same bytes."""
    spec, whole = spec_of(crop=8), spec_of()
    verify(str(crops))
    assert {k: v for k, v in content(crops).items() if k.startswith(("test", "val"))} == {
        k: v for k, v in content(dataset).items() if k.startswith(("test", "val"))
    }
    reader, corners = store.ShardReader(), set()
    for index in range(spec.train):
        cut, full = (
            reader.read(folder / s.shard("train", 0, index).name, index % spec.shard_size, s.fields("train"))
            for folder, s in ((crops, spec), (dataset, whole))
        )
        column, row = (full["camera_matrix"] - cut["camera_matrix"])[:2, 2].astype(int)
        corners.add((column, row))
        inside = np.s_[:, row : row + 8, column : column + 8]
        for name in ("depth", "normal", "albedo"):
            border = int(name == "albedo")  # a window does not know whether the albedo differs beyond its border
            seen = np.s_[:, border : 8 - border, border : 8 - border]
            np.testing.assert_allclose(cut[name][seen], full[name][inside][seen], rtol=1e-3, atol=1e-3)
        for name in ("photon_hit", "photon_flux", "translation", "world_to_view"):
            assert np.array_equal(cut[name], full[name])
        assert cut["noisy"].shape == cut["noisy_input"].shape == (3, 8, 8)
    assert len(corners) > 6 and all(0 <= c <= 8 for corner in corners for c in corner)


@pytest.mark.parametrize("method", ["nlt_photons", "photons_only", "denoising_1_4"])
def test_training_on_crops(crops, tmp_path, monkeypatch, method):
    """It trains on windows and is validated on whole images."""
    monkeypatch.chdir(tmp_path)
    sides = []
    fields = {"dataset": dataclasses.asdict(spec_of(crop=8)), "root": str(crops.parent), "batch_size": 4}
    config = write(tmp_path / "crops.yaml", {"data": fields, **SCALE})

    class Sides(L.Callback):
        def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx):
            sides.append(("train", *batch["noisy"].shape[2:]))

        def on_validation_batch_end(self, trainer, module, outputs, batch, batch_idx):
            sides.append(("val", *outputs.shape[2:]))

    run_lightning(["fit", f"--config={config}", f"--config=model/{method}"], [Sides()])
    assert set(sides) == {("train", 8, 8), ("val", 16, 16)}
