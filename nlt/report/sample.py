"""`nlt data show`: a figure of one sample of a dataset."""

from pathlib import Path

import torch
from torch import Tensor
from torch.utils.data import default_collate

from nlt.data.dataset import LightTransportDataset
from nlt.data.files import open_path
from nlt.data.store import read_spec
from nlt.display import display
from nlt.errors import UserError
from nlt.models.projection import average, visible_pixels
from nlt.report.plots import plt


def show_sample(place: str, split: str, index: int, output: Path) -> Path:
    """Draw the twelve pictures of the supplementary's figure "Data Sample Components" and return the figure's path.

    Raise UserError if there is no such dataset or no sample `index` in the split, val or test.
    """
    directory = open_path(place)
    dataset = LightTransportDataset(directory, read_spec(directory), split)
    if not 0 <= index < len(dataset):
        raise UserError(f"{directory}: --index: must be 0 to {len(dataset) - 1} for {split}, is {index}")
    sample = default_collate([dataset[index]])
    visible, valid = sample["point_visible"][0], sample["photon_valid"][0]
    height, width = sample["depth"].shape[-2:]
    camera = (sample["camera_matrix"], sample["world_to_view"])
    # A depth map of "no hit" occludes nothing.
    in_view, kept = (
        visible_pixels(sample["point_position"], sample["point_visible"], *camera, depth, sample["normal"])
        for depth in (torch.zeros_like(sample["depth"]), sample["depth"])
    )
    points, hits = sample["point_position"][0], sample["photon_hit"][0][valid]
    reference = (sample["reference_a"] + sample["reference_b"]) / 2
    albedo, colour = sample["point_albedo"][0], (sample["photon_flux"] / sample["photon_flux"].amax())[0] * 0.8
    shown = lambda image: display(image, sample["exposure"])[0].permute(1, 2, 0)
    scatter = lambda pixels: average(albedo[None], pixels, height, width)[0].permute(1, 2, 0)
    emission = shown(sample["point_emission"].mT[..., None])[:, 0]
    images = {
        "(1) noisy, 1 spp": shown(sample["noisy"]),
        "(2) reference": shown(reference),
        "(3) depth": (sample["depth"] / sample["depth"].amax())[0, 0],
        "(4) normal": sample["normal"][0].permute(1, 2, 0) / 2 + 0.5,
        "(5) albedo": sample["albedo"][0].permute(1, 2, 0),
        "(6) point cloud": scatter(in_view),
        "(7) point cloud, occluded points masked": scatter(kept),
    }
    clouds: dict[str, tuple[Tensor, Tensor]] = {
        "(8) per-point visibility": (points, torch.tensor([[1, 0.9, 0], [0.3, 0.2, 0.5]])[visible.long()]),
        "(9) per-point albedo": (points[visible], albedo[visible]),
        "(10) per-point emission": (points[visible], emission[visible].clamp(min=0.3)),
        "(11) photon origins": (sample["photon_origin"][0], colour),
        "(12) photon hits": (hits, colour[valid]),
    }  # fmt: skip
    figure = plt.figure(figsize=(12, 8), facecolor="0.15")  # dark, because emitters are white
    for k, (name, image) in enumerate(images.items(), 1):
        figure.add_subplot(3, 4, k, title=name).imshow(image.clamp(0, 1).numpy(), cmap="viridis")
    low, high = points.amin(0), points.amax(0)
    for k, (name, (cloud, colours)) in enumerate(clouds.items(), len(images) + 1):
        axis = figure.add_subplot(3, 4, k, title=name, projection="3d", facecolor="none")
        x, y, z = cloud[:, 0], -cloud[:, 2], cloud[:, 1]
        axis.scatter(x, y, z, c=colours.clamp(0, 1).numpy(), s=1.5, linewidths=0)
        axis.set(xlim=(low[0], high[0]), ylim=(-high[2], -low[2]), zlim=(low[1], high[1]))
        axis.set_box_aspect((high - low)[[0, 2, 1]].tolist())
        axis.view_init(elev=35, azim=-60)
    for axis in figure.axes:
        axis.title.set(fontsize=8, color="white")
        axis.set_axis_off()
    figure.tight_layout()
    figure.savefig(output, dpi=110)
    plt.close(figure)
    return output
