"""`nlt export`: a trained method as a program that needs only PyTorch, or its weights as safetensors."""

import dataclasses
import io
import json
from collections.abc import Sequence
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from nlt.config import read_configs
from nlt.data.datamodule import LightTransportDataModule
from nlt.data.files import write_bytes
from nlt.data.sample import BATCH_FIELDS, FIELDS
from nlt.data.spec import DatasetSpec
from nlt.data.store import Points
from nlt.errors import UserError
from nlt.models.factory import build, load_method, read_checkpoint
from nlt.models.method import Batch
from nlt.models.module import RenderingModule

SAFETENSORS = ".safetensors"
_POINTS = "points."  # begins the names of the points' tensors: points.SCENE.FIELD


class _Frame(nn.Module):
    """The exported module: a method without its trainer hooks."""

    def __init__(self, method: RenderingModule) -> None:
        super().__init__()
        self.method = method

    def forward(self, batch: Batch) -> Tensor:
        return self.method(batch)


def export(checkpoint: str, output: str, resolution: int, photons: int) -> None:
    """Write a method's network as a torch.export program that maps a dict of batch fields, batch 1, to radiance.

    The program runs in float32 at this resolution and with this many photons; the file's inputs.json describes the
    fields that it reads. If `output` ends in .safetensors, write the weights instead, with all that `load_trained`
    needs to rebuild the method.

    Raises:
        UserError: `checkpoint` is not a checkpoint or, for safetensors, not in its run's directory.
    """
    if output.endswith(SAFETENSORS):
        save_trained(*load_trained(checkpoint), output)
        return
    method = load_method(checkpoint, "CKPT")
    sizes: dict[str, int] = {"H": resolution, "W": resolution, "P": photons, "N": method.hparams.get("num_points", 1)}
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


def save_trained(method: RenderingModule, spec: DatasetSpec, points: Sequence[Points], output: str) -> None:
    """Write a method, its dataset's spec and, if it has embeddings of them, each scene's points for `load_trained`."""
    settings = {key: value for key, value in method.hparams.items() if not key.startswith("_")}
    metadata = {
        "method": method.class_path(),
        "init_args": settings,
        "dataset": dataclasses.asdict(spec),
    }
    tensors = {name: tensor.contiguous() for name, tensor in method.state_dict().items()}
    if method.has_point_embeddings:
        named = {f"{_POINTS}{k}.{name}": array for k, each in enumerate(points) for name, array in each.items()}
        tensors |= {name: torch.from_numpy(array) for name, array in named.items()}
    write_bytes(Path(output), save(tensors, {"nlt": json.dumps(metadata)}))


def load_trained(path: str) -> tuple[RenderingModule, DatasetSpec, list[Points]]:
    """Load a trained method from a checkpoint in its run's directory or from safetensors.

    Returns the method, the spec of the dataset that it was trained on, and each scene's points, to which embeddings
    belong. Safetensors of methods without embeddings have no points.

    Raises:
        UserError: the file cannot be read or holds no trained method.
    """
    if not path.endswith(SAFETENSORS):
        method, config = load_method(path, "CKPT"), Path(path).absolute().parents[1] / "config.yaml"
        if not config.exists():
            raise UserError(
                f"CKPT: {path}: {config} is missing; keep the checkpoint in its run, whose config names the dataset"
            )
        try:
            spec = DatasetSpec(**read_configs([str(config)])["data"]["dataset"])
        except (LookupError, TypeError):
            raise UserError(f"CKPT: {path}: {config} names no dataset; keep the checkpoint in its run") from None
        stored = read_checkpoint(path).get(LightTransportDataModule.__qualname__, {}).get("points", [])
        return method, spec, [{name: tensor.numpy() for name, tensor in each.items()} for each in stored]
    try:
        with safe_open(path, "pt") as file:
            metadata = json.loads(file.metadata()["nlt"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        loaded = build({"model": {"class_path": metadata["method"], "init_args": metadata["init_args"]}}, "CKPT")
        assert isinstance(loaded, RenderingModule)
        points: list[Points] = [{} for _ in metadata["dataset"]["scenes"]]
        for name in [name for name in tensors if name.startswith(_POINTS)]:
            scene, field = name.removeprefix(_POINTS).split(".")
            points[int(scene)][field] = tensors.pop(name).numpy()
        loaded.load_state_dict(tensors)
        return loaded, DatasetSpec(**metadata["dataset"]), points
    except OSError as error:
        raise UserError(f"CKPT: {path}: cannot be read: {error.strerror or error}") from None
    except (SafetensorError, LookupError, TypeError, UserError, ValueError, RuntimeError, AssertionError):
        raise UserError(
            f"CKPT: {path}: damaged, or not written by nlt export -o NAME{SAFETENSORS}; export it again"
        ) from None
