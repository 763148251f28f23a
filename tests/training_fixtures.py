"""Session-wide fixtures of tests that train; a plugin of those files, so that all share them."""

from types import SimpleNamespace

import pytest
import torch
from tiny import DATASET, SCALE, write

from nlt.cli import main
from nlt.data.generate import generate
from nlt.data.spec import load_spec
from nlt.paths import CONFIGS


@pytest.fixture(scope="module")
def one_thread():
    """On a busy machine, threads that wait for each other take ten times as long."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """`dataset`: its directory; `data` and `scale`: configs; `fit(method, ...)`: arguments of a training."""
    folder = tmp_path_factory.mktemp("tiny")
    content = {"dataset": DATASET, "root": str(folder / "datasets"), "batch_size": 2, "workers": 0}
    data, scale = write(folder / "data.yaml", {"data": content}), write(folder / "scale.yaml", SCALE)

    def command(name, method, *more):
        model = CONFIGS / "model" / f"{method}.yaml"
        return [name, *(f"--config={file}" for file in (data, model, scale)), *more]

    dataset = generate(*load_spec([str(data)]), workers=1)
    return SimpleNamespace(dataset=dataset, data=data, scale=scale, command=command)


@pytest.fixture(scope="session")
def trained(tiny, tmp_path_factory):
    """The directory of a CNN's run of one epoch, through the command line; it holds one checkpoint."""
    folder = tmp_path_factory.mktemp("trained")
    assert main(tiny.command("fit", "cnn", f"--trainer.default_root_dir={folder}")) == 0
    return folder / "lightning_logs/version_0"


@pytest.fixture(scope="session")
def checkpoint(trained):
    (path,) = trained.glob("checkpoints/*.ckpt")
    return path
