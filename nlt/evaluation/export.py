"""`nlt export`: a trained method's frame as one file that needs nothing but PyTorch."""

from __future__ import annotations

import io
import json
from pathlib import Path

import torch
from torch import Tensor, nn

from nlt.data.files import write_bytes
from nlt.data.sample import BATCH_FIELDS, FIELDS
from nlt.models.method import Batch
from nlt.models.module import RenderingModule
from nlt.training import load_method


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

    Raises:
        UserError: not a checkpoint.
    """
    method = load_method(checkpoint, "CKPT")
    sizes: dict[str, int] = {"H": resolution, "W": resolution, "P": photons, "N": method.hparams["num_points"]}
    fields = {name: (FIELDS | BATCH_FIELDS)[name] for name in (*method.inputs, "exposure", "scene", "index")}
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
