"""`nlt data show`: a figure of one sample of a dataset."""

from __future__ import annotations

from pathlib import Path

from torch.utils.data import default_collate

from nlt.data.dataset import LightTransportDataset
from nlt.data.files import open_path
from nlt.data.store import read_spec
from nlt.errors import UserError
from nlt.report.figures import draw_sample


def show_sample(place: str, split: str, index: int, output: Path) -> Path:
    """Draw sample `index` of an evaluated split and return the figure's path.

    Raises:
        UserError: there is no such dataset or sample.
    """
    directory = open_path(place)
    dataset = LightTransportDataset(directory, read_spec(directory), split)
    if not 0 <= index < len(dataset):
        raise UserError(f"{directory}: --index: must be 0 to {len(dataset) - 1} for {split}, is {index}")
    draw_sample(output, default_collate([dataset[index]]))
    return output
