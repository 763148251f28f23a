"""The perspective camera: intrinsics, world-to-view transform and the rays through pixel centres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: intrinsics `matrix` K (3, 3), from view space to pixels, and rigid `world_to_view` T (4, 4).

    Conventions are those of `nlt.data.sample`: x right, y down, z forward, in metres.
    """

    matrix: np.ndarray
    world_to_view: np.ndarray
    width: int
    height: int

    @classmethod
    def look_at(
        cls, position: np.ndarray, target: np.ndarray, up: np.ndarray, fov: float, width: int, height: int
    ) -> Camera:
        """A camera at `position` that faces `target`, with a horizontal field of view `fov` in degrees."""
        forward = np.asarray(target, float) - position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        world_to_view = np.eye(4)
        world_to_view[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        world_to_view[:3, 3] = -world_to_view[:3, :3] @ position
        focal = width / 2 / np.tan(np.radians(fov) / 2)
        matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
        # Stored samples are float32. Rounding here makes the rendered camera equal to the stored one.
        return cls(matrix.astype(np.float32), world_to_view.astype(np.float32), width, height)

    def window(self, column: int, row: int, size: int) -> Camera:
        """Return the camera of a square window of the image, `size` pixels wide, with its first pixel at (column, row).

        Its pixels see what they see in the image; the principal point lies outside the window's middle.
        """
        matrix = self.matrix.copy()
        matrix[:2, 2] -= column, row
        return Camera(matrix, self.world_to_view, size, size)

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) view-to-world rotation, float64."""
        return self.world_to_view[:3, :3].T.astype(float)

    @property
    def position(self) -> np.ndarray:
        """(3,) world position of the camera centre, float64."""
        return -self.rotation @ self.world_to_view[:3, 3]

    @property
    def fov(self) -> float:
        """Horizontal field of view in degrees."""
        return float(np.degrees(2 * np.arctan(self.width / 2 / self.matrix[0, 0])))

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Unit world directions (n, 3) through continuous pixel coordinates (n, 2)."""
        focal, centre = np.diag(self.matrix)[:2].astype(float), self.matrix[:2, 2].astype(float)
        view = np.concatenate([(pixels - centre) / focal, np.ones((len(pixels), 1))], 1)
        view /= np.linalg.norm(view, axis=1, keepdims=True)
        return view @ self.rotation.T

    def centres(self) -> np.ndarray:
        """(H*W, 2) float32 coordinates of all pixel centres, row by row."""
        return self.corners() + 0.5

    def corners(self) -> np.ndarray:
        """(H*W, 2) float32 coordinates of the upper left corners of all pixels, row by row."""
        corners = np.empty((2, self.height, self.width), np.float32)
        corners[0], corners[1] = np.arange(self.width), np.arange(self.height)[:, None]
        return corners.reshape(2, -1).T

    def view_directions(self) -> np.ndarray:
        """(3, H, W) float32 view direction map: unit world directions through pixel centres (Sec. Method)."""
        # Faster than `directions`, because it works along rows and columns: every epoch needs a map for every sample.
        focal, centre = np.diag(self.matrix)[:2].astype(float), self.matrix[:2, 2].astype(float)
        x = (np.arange(self.width) + 0.5 - centre[0]) / focal[0]
        y = ((np.arange(self.height) + 0.5 - centre[1]) / focal[1])[:, None]
        right, down, forward = self.rotation.T[..., None, None]
        columns, rows = (right * x).astype(np.float32), (down * y + forward).astype(np.float32)
        return (columns + rows) / np.sqrt((x**2).astype(np.float32) + (y**2 + 1).astype(np.float32))
