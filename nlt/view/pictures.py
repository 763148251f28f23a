"""All that can draw a scene in the viewer: the trained methods, Open Image Denoise and path tracing."""

from pathlib import Path

import torch
from torch import Tensor

from nlt.baselines.path_tracing import OpenImageDenoise
from nlt.errors import UserError
from nlt.evaluation.paper import label
from nlt.evaluation.results import MANIFEST, OK, RUNS, load
from nlt.paths import is_checkpoint
from nlt.scenes.camera import Camera
from nlt.scenes.description import Experiment
from nlt.scenes.state import SceneState
from nlt.view.drawing import DEMO, load_models, open_models

DENOISED, TRACED, REFERENCE = "Open Image Denoise", "path tracing", "reference (accumulates)"


class Pictures:
    """Draws one scene by any of `names`. All of it must run in one thread, because Mitsuba and PyTorch do."""

    def __init__(self, source: str | None, scene: str | None = None, experiment: Experiment | None = None) -> None:
        """Load the models of a source for a scene, and open the scene.

        Args:
            source: a checkpoint; a results directory, for the first training of each method; a scene, in which nothing
                was trained; or None, for the demo's models.
            scene: see `load_models`; None if the source is a scene.
            experiment: see `load_models`; by default that of training, or fixed_lights if the source is a scene.

        Raises:
            UserError: a file is missing or wrong, or the scene does not suit a method.
        """
        checkpoints = find_checkpoints(source, scene)
        drawn = scene if checkpoints else source
        self._models = open_models(load_models(checkpoints, drawn, experiment=experiment))
        self._any = next(iter(self._models.values()))
        self.scene = self._any.render.scene
        self.names = [*(self._models if checkpoints else ()), DENOISED, TRACED, REFERENCE]

    @torch.no_grad()
    def draw(self, name: str, state: SceneState, camera: Camera, spp: int, frame: int = 0) -> Tensor:
        """Return linear radiance (3, H, W); `frame` is the seed of path tracing, whose samples per pixel are `spp`."""
        if name in self._models:
            return self._models[name].frame(state, camera)[0].cpu()
        traced = self._any.traced(state, camera, spp, frame)
        if name != DENOISED:
            return traced[0]
        guides = self._any.gbuffer(state, camera)
        batch = {key: torch.from_numpy(guides[key])[None] for key in ("albedo", "normal")}
        batch |= {"traced": traced, "exposure": torch.tensor([self.scene.description.exposure])}
        with self._any.stage("denoise"):
            return OpenImageDenoise(spp)(batch)[0]

    def layers(self, state: SceneState, camera: Camera) -> dict:
        """Return the layers of an EXR that do not depend on the method: the G-buffer, as arrays (C, H, W)."""
        return dict(self._any.gbuffer(state, camera))

    def lap(self) -> dict[str, float]:
        """Return the seconds per stage since the last call."""
        seconds: dict[str, float] = {}
        for model in self._models.values():
            for stage, duration in model.seconds.items():
                seconds[stage] = seconds.get(stage, 0.0) + duration
            model.seconds.clear()
        return seconds


def find_checkpoints(source: str | None, scene: str | None = None) -> dict[str, str]:
    """Return the checkpoints of a source (see `Pictures`) by the labels of their methods; that of a file is empty.

    There are none if the source is itself a scene.

    Raises:
        UserError: the results are incomplete, or a training that they name is gone.
    """
    if source is None:
        return DEMO
    if not Path(source).is_dir():
        return {"": source} if scene or is_checkpoint(source) else {}
    from nlt.evaluation.trainings import newest_checkpoint  # here, because it takes a second that --demo can do without

    results, found = load(source), {}
    for run in results.runs:
        folder = run.get("run")
        if run["status"] == OK and isinstance(folder, str) and run["method"] not in found:
            checkpoint = newest_checkpoint(Path(folder))
            if checkpoint is None:
                raise UserError(
                    f"{results.directory / RUNS}: run: there is no checkpoint in {folder}; start nlt in the directory "
                    "of that runs folder, or repeat the command in manifest.json to train again"
                )
            found[run["method"]] = str(checkpoint)
    if not found:
        raise UserError(f"{results.directory / MANIFEST}: methods: none is trained; give results with trained methods")
    return {label(method): checkpoint for method, checkpoint in found.items()}
