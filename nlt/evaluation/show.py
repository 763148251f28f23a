"""`nlt show`: one sample of a dataset as pictures."""

from __future__ import annotations

import json
from pathlib import Path

from torch.utils.data import default_collate

from nlt.data.datamodule import LightTransportDataset
from nlt.data.spec import DatasetSpec
from nlt.data.store import MANIFEST
from nlt.errors import UserError
from nlt.evaluation.figures import draw_sample


def show_sample(directory: str, split: str, index: int, output: str) -> str:
    """Draw sample `index` of an evaluated split and return the picture's path.

    Raises:
        UserError: there is no such dataset or sample.
    """
    manifest = Path(directory) / MANIFEST
    if not manifest.exists():
        raise UserError(f"{manifest}: no dataset here; `nlt generate` prints the directory that it fills")
    spec = DatasetSpec(**json.loads(manifest.read_text())["spec"])
    dataset = LightTransportDataset(Path(directory), spec, split)
    if not 0 <= index < len(dataset):
        raise UserError(f"{directory}: --index: {split} has samples 0 to {len(dataset) - 1}, not {index}")
    draw_sample(Path(output), default_collate([dataset[index]]))
    return output
