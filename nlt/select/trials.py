"""The trainings of a space's candidates: each resumes from its checkpoint and is scored, and its scores are kept."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader

from nlt.config import merge
from nlt.data.dataset import LightTransportDataset, identity_collate
from nlt.data.files import write_bytes
from nlt.errors import DivergedError
from nlt.evaluation.evaluate import evaluate
from nlt.evaluation.trainings import fit
from nlt.metrics.image_metrics import ImageMetrics
from nlt.metrics.quantities import METRICS
from nlt.models.factory import read_checkpoint
from nlt.models.module import RenderingModule
from nlt.models.policy import Policy, accelerate
from nlt.select.space import Candidate, SearchSpace
from nlt.training import newest_checkpoint

SCORES = ("unbiased_mse", "mssim")  # where they disagree, the first one decides
_BATCH = 16

now = time.perf_counter
Scores = dict[str, list[float]]  # for every image, by the keys of SCORES


class Trials:
    """Trainings in `directory`, in a subdirectory for each candidate and seed."""

    def __init__(self, space: SearchSpace, dataset: Any, directory: Path, device: torch.device, policy: Policy) -> None:
        self.space, self.dataset, self.directory = space, dataset, directory
        self.device, self.policy = device, policy

    def split(self, name: str, inputs: tuple[str, ...] | None = None) -> LightTransportDataset:
        """Return a split of the dataset with the fields `inputs`; None for all."""
        return LightTransportDataset(self.dataset, self.space.spec, name, inputs)

    def train(self, candidate: Candidate, seed: int, steps: int, begun: int, step_s: float) -> dict[str, Any]:
        """Train from `begun` to `steps` and score on the validation split, or read the stored result.

        Returns `seconds`, and `scores` or, if the training diverges, `diverged`. Each step that a killed process has
        already done counts as `step_s` seconds.
        """
        run = self.run_of(candidate, seed)
        record = run / f"{steps}.json"
        if not record.exists():
            begin, result = now(), dict[str, Any]()
            try:
                done = self._fit(run, candidate, seed, steps)
                result["scores"] = self.score(candidate, seed, "val")
            except DivergedError as error:
                done, result["diverged"] = steps - begun, str(error)
            seconds = now() - begin + (steps - begun - done) * step_s
            write_bytes(record, json.dumps({**result, "seconds": seconds}).encode())
        return dict(json.loads(record.read_text()))

    def run_of(self, candidate: Candidate, seed: int) -> Path:
        """Return the directory of a training."""
        return self.directory / f"{candidate.slug}-seed{seed}"

    def _fit(self, run: Path, candidate: Candidate, seed: int, steps: int) -> int:
        """Train up to `steps` and return how many of them were done now."""
        checkpoint = newest_checkpoint(run)
        before = read_checkpoint(checkpoint)["global_step"] if checkpoint else 0
        if before < steps:
            limits = {"trainer": {"max_steps": steps, "limit_val_batches": 0}}
            fit(run, merge(self.space.config(candidate), limits), seed)
        return steps - before

    def score(self, candidate: Candidate, seed: int, split: str) -> Scores:
        """Return the scores of every image of a split.

        Raises:
            DivergedError: a prediction is not finite.
        """
        checkpoint = newest_checkpoint(self.run_of(candidate, seed))
        assert checkpoint is not None
        module = accelerate(RenderingModule.load_from_checkpoint(checkpoint), self.policy, self.device)
        batches = DataLoader(self.split(split, module.fields), batch_size=_BATCH, collate_fn=identity_collate)
        scores: dict[str, list[float]] = {key: [] for key in SCORES}
        for judged in evaluate(module, batches, ImageMetrics(perceptual=False).to(self.device)):
            if judged.nonfinite.any():
                indices = judged.batch["index"].tolist()
                raise DivergedError(f"a prediction is not finite among {split} samples {indices}")
            for key, values in scores.items():
                values += judged.metrics[key].tolist()
        return scores

    def scores(self, candidate: Candidate, key: str, seeds: Sequence[int], steps: int) -> np.ndarray:
        """Return validation scores (S, N), seeds by images."""
        results = [json.loads((self.run_of(candidate, s) / f"{steps}.json").read_text()) for s in seeds]
        return np.array([result["scores"][key] for result in results])


def as_error(key: str, scores: np.ndarray) -> np.ndarray:
    """Return scores turned into errors, of which lower is better."""
    return scores if METRICS[key].direction == "lower" else 1 - scores
