"""What the neural field reads: surface positions against the camera's inverse in NumPy, and the light from photons."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from synthetic import SCENES, synthetic_batch

from nlt.baselines.neural_field import NeuralField, mean_light, surface_positions

SIZE = 12


def test_positions_are_those_of_the_inverse_camera():
    batch = {k: v.double() if v.is_floating_point() else v for k, v in synthetic_batch(size=SIZE).items()}
    batch["world_to_view"][:, :3, :3] = torch.from_numpy(Rotation.random(2, rng=0).as_matrix())
    batch["world_to_view"][:, :3, 3] = torch.tensor([1.0, -2, 3])
    row, column = np.mgrid[:SIZE, :SIZE] + 0.5
    for k in range(2):
        view, matrix = batch["world_to_view"][k].numpy(), batch["camera_matrix"][k].numpy()
        rays = np.stack([column, row, np.ones_like(row)], -1) @ np.linalg.inv(matrix).T  # of depth 1, in view space
        seen = np.concatenate([rays * batch["depth"][k, 0].numpy()[..., None], np.ones((SIZE, SIZE, 1))], -1)
        expected = (seen @ np.linalg.inv(view).T)[..., :3]
        direction = rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ view[:3, :3]
        batch["view_direction"][k] = torch.from_numpy(np.moveaxis(direction, -1, 0))
        np.testing.assert_allclose(surface_positions(batch)[k], expected, rtol=1e-9)


def test_the_light_is_where_most_power_leaves():
    """Two lamps of one and three watts; a photon that did not arrive counts for nothing."""
    lamps = torch.tensor([[0.0, 0, 0], [4, 0, 8], [99, 99, 99]])
    flux = torch.tensor([[1.0, 0, 0], [0, 2, 1], [5, 5, 5]])
    batch = {
        "photon_origin": lamps[None],
        "photon_flux": flux[None],
        "photon_valid": torch.tensor([[True, True, False]]),
    }
    assert mean_light(batch).tolist() == [[3, 0, 6]]


@torch.no_grad()
def test_a_field_for_each_scene():
    """One network serves all scenes of a dataset, but the same place in another scene is another place."""
    batch = synthetic_batch()
    batch = {name: value[:1].expand(SCENES, *value.shape[1:]) for name, value in batch.items()}
    batch["scene"] = torch.arange(SCENES)
    field = NeuralField(width=2, depth=1, num_scenes=SCENES).gbuffer(batch)[:, 10:]
    assert field.shape[1] == 16 and not torch.allclose(field[0], field[1])
    assert torch.equal(
        NeuralField(width=2, depth=1, field_width=0).gbuffer(batch)[0],
        NeuralField(width=2, depth=1).gbuffer(batch | {"scene": 0 * batch["scene"]})[0, :10],
    )
