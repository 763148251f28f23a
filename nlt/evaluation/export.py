"""`nlt export`: a trained method's frame as one file that needs nothing but PyTorch, or its weights as safetensors."""

from __future__ import annotations

import dataclasses
import io
import json
import pydoc
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from nlt.data.datamodule import LightTransportDataModule
from nlt.data.files import write_bytes
from nlt.data.sample import BATCH_FIELDS, FIELDS
from nlt.data.spec import DatasetSpec, read_configs
from nlt.errors import UserError
from nlt.models.method import Batch
from nlt.models.module import RenderingModule
from nlt.training import load_method, read_checkpoint

SAFETENSORS = ".safetensors"


class _Frame(nn.Module):
    """What is exported: not the method itself, whose hooks are the trainer's."""

    def __init__(self, method: RenderingModule) -> None:
        super().__init__()
        self.method = method

    def forward(self, batch: Batch) -> Tensor:
        return self.method(batch)


def export(checkpoint: str, output: str, resolution: int, photons: int) -> None:
    """Write a method's network as a torch.export program: from a dict of batch fields, batch 1, to radiance.

    In float32, at this resolution and for this many photons; the file's inputs.json says which fields it reads.
    If `output` ends in .safetensors, the weights instead, with all that `load_trained` needs to build the method.

    Raises:
        UserError: not a checkpoint, or, for safetensors, not in the directory of its run.
    """
    if output.endswith(SAFETENSORS):
        save_trained(*load_trained(checkpoint), output)
        return
    method = load_method(checkpoint, "CKPT")
    sizes: dict[str, int] = {"H": resolution, "W": resolution, "P": photons, "N": method.hparams["num_points"]}
    fields = {name: (FIELDS | BATCH_FIELDS)[name] for name in (*method.fields, "exposure", "scene", "index")}
    batch, described = {}, {}
    for name, field in fields.items():
        dtype = "float32" if field.dtype == "float16" else field.dtype
        batch[name] = torch.zeros(1, *field.resolve(sizes), dtype=getattr(torch, dtype))
        described[name] = {"shape": list(batch[name].shape), "dtype": dtype, "unit": field.unit, "is": field.meaning}
    with torch.no_grad():
        program = torch.export.export(_Frame(method.eval()), (batch,))
    file = io.BytesIO()
    extra = {"inputs.json": json.dumps({"method": method.class_path(), "fields": described}, indent=1)}
    torch.export.save(program, file, extra_files=extra)
    write_bytes(Path(output), file.getvalue())


def save_trained(method: RenderingModule, spec: DatasetSpec, points: list[int], output: str) -> None:
    """Write a method and what it was trained on as safetensors, as `load_trained` returns it."""
    settings = {key: value for key, value in method.hparams.items() if not key.startswith("_")}
    about = {
        "method": method.class_path(),
        "init_args": settings,
        "dataset": dataclasses.asdict(spec),
        "points": points,
    }
    weights = {name: tensor.contiguous() for name, tensor in method.state_dict().items()}
    write_bytes(Path(output), save(weights, {"nlt": json.dumps(about)}))


def load_trained(path: str) -> tuple[RenderingModule, DatasetSpec, list[int]]:
    """A trained method, of a checkpoint within its run or of safetensors, and the dataset that it was trained on.

    Last the `points_crc` of each of its scenes; none of a file from before they were kept.

    Raises:
        UserError: it cannot be read, or is none.
    """
    if not path.endswith(SAFETENSORS):
        method, config = load_method(path, "CKPT"), Path(path).absolute().parents[1] / "config.yaml"
        if not config.exists():
            raise UserError(f"CKPT: {path}: {config} is missing, which says of what data; leave it in its run")
        try:
            spec = DatasetSpec(**read_configs([str(config)])["data"]["dataset"])
        except (LookupError, TypeError):
            raise UserError(f"CKPT: {path}: {config} says of no data; leave the checkpoint in its run") from None
        return method, spec, read_checkpoint(path).get(LightTransportDataModule.__qualname__, {}).get("points", [])
    try:
        with safe_open(path, "pt") as file:
            about = json.loads(file.metadata()["nlt"])
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        kind = pydoc.locate(about["method"])
        assert isinstance(kind, type) and issubclass(kind, RenderingModule)
        method = kind(**about["init_args"])
        method.load_state_dict(weights)
        return method, DatasetSpec(**about["dataset"]), about.get("points", [])
    except OSError as error:
        raise UserError(f"CKPT: {path}: cannot be read: {error.strerror or error}") from None
    except (SafetensorError, LookupError, TypeError, ValueError, RuntimeError, AssertionError):
        raise UserError(f"CKPT: {path}: not a model of nlt export -o NAME{SAFETENSORS}, or damaged") from None
