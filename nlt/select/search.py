"""Successive halving of a space's candidates under a time budget (Jamieson and Talwalkar 2016).

A search has a directory. It holds plan.json, and for each candidate and seed a directory with the training's checkpoint
and the scores after each round. Every decision follows from these files, so a search that is killed and restarted ends
the same.
"""

import hashlib
import json
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, default_collate

from nlt.config import merge
from nlt.data.dataset import LightTransportDataset, identity_collate
from nlt.data.engines import Process
from nlt.data.files import write_bytes
from nlt.errors import DivergedError, UserError
from nlt.evaluation.clock import Clock, summary
from nlt.evaluation.evaluate import evaluate
from nlt.evaluation.frames import Frames
from nlt.evaluation.trainings import fit, newest_checkpoint
from nlt.metrics.image_metrics import ImageMetrics
from nlt.metrics.quantities import METRICS
from nlt.models.factory import read_checkpoint
from nlt.models.module import RenderingModule
from nlt.models.policy import Policy, accelerate, default_device
from nlt.select.choice import ranked
from nlt.select.space import Candidate, SearchSpace

SCORES = ("unbiased_mse", "mssim")  # where they disagree, the first one decides
_ETA, _ROUNDS = 3, 3  # one in three candidates continues; the largest number of planned rounds
_ENOUGH = 10  # candidates; if fewer fit into the budget, the rounds get fewer steps
_TIMING = 0.1  # share of the budget, at most, for timing steps, and as much again for timing frames
_SETUP = 3.0  # seconds that a training takes in addition to its steps, about
_RECENT = 5  # number of the last trainings by which the estimates are corrected

_BATCH = 16  # images that are scored at once

now = time.perf_counter
Scores = dict[str, list[float]]  # for every image, by the keys of SCORES


@dataclass
class Entry:
    """A candidate's record: times and sizes, steps of its training, why there are not more, and scores by seed."""

    cost: dict[str, Any]
    steps: int = 0
    status: str = ""
    scores: dict[int, Scores] = field(default_factory=dict)  # of the validation split, after these steps


class Search:
    """Trains a space's candidates, the worse ones for a short time only.

    The full model, the best candidate and the best one of each method in `advised` continue to the last round. A method
    that has to learn what others are given, for example where light arrives in a static scene, is worse at first.
    """

    def __init__(self, space: SearchSpace, dataset: Any, root: Path, advised: Sequence[str] = ()) -> None:
        self.space, self.dataset, self.advised, self.budget = space, dataset, advised, 60.0 * space.minutes
        self.device = default_device()
        self.policy = Policy.for_device(self.device)
        decides = [space.config(candidate) for candidate in space.candidates]
        key = json.dumps([decides, self.policy.precision, space.minutes, space.seeds], sort_keys=True)
        self.directory = root / f"{space.name}-{hashlib.sha256(key.encode()).hexdigest()[:8]}"
        self.spent = 0.0
        self.entries: dict[Candidate, Entry] = {}
        self.seeds = [0]
        self._ratios: list[float] = []  # measured over initially estimated time of each training
        config = space.config(space.full)
        self._most, self._batch_size = config["trainer"]["max_steps"], config["data"].get("batch_size", 32)
        self._epoch = max(1, len(space.spec.scenes) * space.spec.train // self._batch_size)

    def run(self) -> list[Candidate]:
        """Return the candidates trained longest, all for the same steps and with scores for all `seeds`.

        Raises:
            UserError: the budget is too small for two candidates, or all of them diverge.
        """
        plan = _stored(self.directory / "plan.json", self._plan)
        self.rounds, self.spent = plan["rungs"], plan["spent_s"]
        torch.set_num_threads(plan["threads"])
        costs = dict(zip(self.space.candidates, plan["costs"], strict=False))
        self.entries = {candidate: Entry(cost) for candidate, cost in costs.items()}
        order = list(self.entries)
        fit = max((n for n in range(2, len(order) + 1) if self._fits(order, n, self.rounds)), default=2)
        counts = self._counts(self.rounds, fit)
        said = ", ".join(f"{n} for {steps} steps" for n, steps in zip(counts, self.rounds, strict=True))
        seeds = f", the last with {self.space.seeds} seeds" if self.space.seeds > 1 else ""
        total = (self.spent + self._cost(order[:fit], self.rounds)) / 60
        print(f"{fit} of {len(self.space.candidates)} candidates fit into {self.space.minutes:g} min: {said}{seeds}; "
              f"about {total:.1f} min in all", flush=True)  # fmt: skip

        finals = self._round(0, order)
        if not finals:
            raise UserError(f"{self.space.scale}: every candidate diverged; lower model.init_args.learning_rate")
        counts = self._counts(self.rounds, len(finals))
        for k in range(1, len(self.rounds)):
            order, keep = self._order(finals), counts[k]
            while keep > 1 and self.spent + self._cost(order[:keep], self.rounds, k) > self.budget:
                keep -= 1
            for candidate in order[keep:]:
                self.entries[candidate].status = f"dropped after {self.rounds[k - 1]} steps"
            finals = self._round(k, order[:keep]) or finals
        while (last := self.rounds[-1]) < self._most:  # there is more time than was planned
            rounds = [*self.rounds, min(_ETA * last, self._most // self._epoch * self._epoch)]
            if rounds[-1] == last or self.spent + self._cost(finals, rounds, len(self.rounds)) > self.budget:
                break
            self.rounds = rounds
            finals = self._round(len(rounds) - 1, self._order(finals)) or finals
        finals = self._more_seeds(finals)
        for candidate in finals:
            self.entries[candidate].status = "trained to the end"
        return finals

    # --- the plan ---

    def _plan(self) -> dict[str, Any]:
        """Return the rounds' steps and every candidate's cost per step and, with interleaved timing, per frame."""
        begin, rounds, seconds = now(), self._steps(self._most), dict[int, float]()
        for threads in (1, torch.get_num_threads()):  # on a busy machine, all are slower than one because they wait
            torch.set_num_threads(threads)
            seconds[threads] = self._step_s(self.space.build(self.space.full))
        threads = min(seconds, key=seconds.__getitem__)
        torch.set_num_threads(threads)
        for candidate in self.space.candidates:
            if now() - begin > _TIMING * self.budget and len(self.entries) >= 2:
                break
            self.entries[candidate] = Entry({"step_s": self._step_s(self.space.build(candidate))})
        order, enough = list(self.entries), min(_ENOUGH, len(self.entries))
        self.spent = now() - begin + _TIMING * self.budget
        while not self._fits(order, enough, rounds) and rounds[-1] > self._epoch:
            rounds = self._steps(max(rounds[-1] // 2, self._epoch))
        if not self._fits(order, 2, rounds):
            minutes = math.ceil(2 * (self.spent + self._cost(order[:2], rounds)) / 60)
            raise UserError(f"--minutes: {self.space.minutes:g} are too few for two candidates; give {minutes}")
        frames = Process(frame_costs, self.space, self._split("val"), order, _TIMING * self.budget).result()
        costs = [self.entries[candidate].cost | frame for candidate, frame in zip(order, frames, strict=True)]
        return {"rungs": rounds, "costs": costs, "spent_s": now() - begin, "threads": threads}

    def _steps(self, last: int) -> list[int]:
        """Return the rounds' steps, each a third of the next, in whole epochs so that resuming is exact."""
        steps = [max(1, round(last / self._epoch)) * self._epoch if last > self._epoch else last]
        for k in range(1, _ROUNDS):
            fewer = max(1, round(last / _ETA**k / self._epoch)) * self._epoch
            if fewer < steps[0]:
                steps.insert(0, fewer)
        return steps

    def _step_s(self, module: RenderingModule) -> float:
        """Return the seconds of a training step: the least of two, after a warm-up step."""
        data = self._split("train", module.training_fields)
        batch = default_collate([data[k % len(data)] for k in range(self._batch_size)])
        batch = {name: value.to(self.device) for name, value in batch.items()}
        module = module.to(self.device).train()
        optimizer = module.build_optimizer()
        seconds = []
        for _ in range(3):
            begin = now()
            with self.policy.autocast(self.device):
                loss = module.noisy_loss(module(batch), batch)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            float(loss.detach())
            seconds.append(now() - begin)
        return min(seconds[1:])

    def _counts(self, rounds: list[int], first: int) -> list[int]:
        """Return the number of candidates in each round, with `first` in the first one."""
        return [max(math.ceil(first / _ETA**k), min(2 + len(self.advised), first)) for k in range(len(rounds))]

    def _estimate(self, candidate: Candidate, steps: int) -> float:
        """Return a training's estimated seconds, corrected by the latest trainings."""
        return self._nominal(candidate, steps) * (statistics.median(self._ratios[-_RECENT:]) if self._ratios else 1.0)

    def _nominal(self, candidate: Candidate, steps: int) -> float:
        return _SETUP + steps * float(self.entries[candidate].cost["step_s"])

    def _cost(self, order: list[Candidate], rounds: list[int], done: int = 0) -> float:
        """Return the most seconds that the rounds from `done` on take, seeds included, if `order` enters the first."""
        costliest = sorted(order, key=lambda c: (c != self.space.full, -self.entries[c].cost["step_s"]))
        counts, total = self._counts(rounds[done:], len(order)), 0.0
        for count, steps, begun in zip(counts, rounds[done:], [0, *rounds][done:], strict=False):
            total += sum(self._estimate(c, steps - begun) for c in costliest[:count])
        return total + (self.space.seeds - 1) * sum(self._estimate(c, rounds[-1]) for c in costliest[: counts[-1]])

    def _fits(self, order: list[Candidate], first: int, rounds: list[int], trained: int = 0) -> bool:
        """Return whether the `first` ones of `order` fit the budget; `trained` of them have finished round one."""
        paid = sum(self._estimate(c, rounds[0]) for c in order[:trained])
        return self.spent - paid + self._cost(order[:first], rounds) <= self.budget

    # --- the search ---

    def _round(self, k: int, order: list[Candidate]) -> list[Candidate]:
        """Train candidates to the end of round `k` while there is time; return those that did not diverge."""
        steps, begun = self.rounds[k], self.rounds[k - 1] if k else 0
        converged = []
        for number, candidate in enumerate(order, 1):
            late = self.spent + self._estimate(candidate, steps - begun) > self.budget
            if k == 0 and number > 2:  # leave time for the later rounds
                late = not self._fits(order, number, self.rounds, number - 1)
            if late and (candidate != self.space.full or self.spent >= self.budget):
                self.entries[candidate].status = f"no time left after {begun} steps"
                continue
            if self.train(candidate, 0, steps, begun):
                converged.append(candidate)
            left = (self.budget - self.spent) / 60
            print(f"round {k + 1} of {len(self.rounds)}, {number} of {len(order)}: {candidate.name}: {steps} steps; "
                  f"{left:.1f} of {self.space.minutes:g} min left", flush=True)  # fmt: skip
        return converged

    def _more_seeds(self, finals: list[Candidate]) -> list[Candidate]:
        """Train the finalists with further seeds while there is time for all; return those that did not diverge."""
        steps = self.entries[finals[0]].steps
        for seed in range(1, self.space.seeds):
            left, done = list(finals), list[Candidate]()
            while left and self.spent + sum(self._estimate(c, steps) for c in left) <= self.budget:
                candidate = left.pop(0)
                if self.train(candidate, seed, steps, 0):
                    done.append(candidate)
            print(f"seed {seed}: {len(done)} of {len(finals)} candidates; "
                  f"{(self.budget - self.spent) / 60:.1f} of {self.space.minutes:g} min left", flush=True)  # fmt: skip
            if left or not done:
                break
            finals = done
            self.seeds.append(seed)
        return finals

    def _order(self, candidates: list[Candidate]) -> list[Candidate]:
        """Return candidates by priority: the full model, the best, the best of each advised method, the others."""
        times = {c: float(self.entries[c].cost["time_per_frame_s"]) for c in candidates}
        order = ranked([self.errors(candidates, key) for key in SCORES], times)
        best = {c.method: c for c in reversed(order)}
        kept = [self.space.full, order[0], *(c for c in order if c == best[c.method] and c.method in self.advised)]
        return sorted(order, key=lambda c: kept.index(c) if c in kept else len(kept))

    # --- a training ---

    def train(self, candidate: Candidate, seed: int, steps: int, begun: int) -> bool:
        """Train from `begun` to `steps` and score on the validation split; return False if the training diverges."""
        entry = self.entries[candidate]
        file = self.run_of(candidate, seed) / f"{steps}.json"
        result = _stored(file, partial(self._train, candidate, seed, steps, begun))
        self.spent += result["seconds"]
        if "diverged" in result:
            entry.status = "diverged"
            return False
        self._ratios.append(result["seconds"] / self._nominal(candidate, steps - begun))
        entry.steps, entry.scores[seed] = steps, result["scores"]
        return True

    def _train(self, candidate: Candidate, seed: int, steps: int, begun: int) -> dict[str, Any]:
        """Return `seconds`, and `scores` or why it `diverged`; steps before a kill count with their estimated time."""
        begin, result = now(), dict[str, Any]()
        try:
            done = self._fit(self.run_of(candidate, seed), candidate, seed, steps)
            result["scores"] = self.score(candidate, seed, "val")
        except DivergedError as error:
            done, result["diverged"] = steps - begun, str(error)
        result["seconds"] = now() - begin + (steps - begun - done) * self.entries[candidate].cost["step_s"]
        return result

    def run_of(self, candidate: Candidate, seed: int) -> Path:
        """Return the directory of a training."""
        return self.directory / f"{candidate.slug}-seed{seed}"

    def _split(self, name: str, inputs: tuple[str, ...] | None = None) -> LightTransportDataset:
        return LightTransportDataset(self.dataset, self.space.spec, name, inputs)

    def _fit(self, run: Path, candidate: Candidate, seed: int, steps: int) -> int:
        """Train up to `steps` from the newest checkpoint and return how many of them were done now."""
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
        batches = DataLoader(self._split(split, module.fields), batch_size=_BATCH, collate_fn=identity_collate)
        scores: Scores = {key: [] for key in SCORES}
        for judged in evaluate(module, batches, ImageMetrics(perceptual=False).to(self.device)):
            if judged.nonfinite.any():
                indices = judged.batch["index"].tolist()
                raise DivergedError(f"a prediction is not finite among {split} samples {indices}")
            for key, values in scores.items():
                values += judged.metrics[key].tolist()
        return scores

    def test_scores(self, candidate: Candidate) -> list[Scores]:
        """Return the scores of the test split for each of `seeds`, computed once."""
        files = {s: self.run_of(candidate, s) / f"test-{self.entries[candidate].steps}.json" for s in self.seeds}
        return [_stored(file, partial(self.score, candidate, seed, "test")) for seed, file in files.items()]

    def errors(self, candidates: list[Candidate], key: str) -> dict[Candidate, np.ndarray]:
        """Return the validation errors (S, N), seeds by images, of candidates trained with all `seeds`."""
        return {c: as_errors(key, [self.entries[c].scores[seed] for seed in self.seeds]) for c in candidates}


def _stored(file: Path, compute: Callable[[], Any]) -> Any:
    """Return the content of a JSON file, which is computed and written first if it is missing."""
    if not file.exists():
        write_bytes(file, json.dumps(compute()).encode())
    return json.loads(file.read_text())


def as_errors(key: str, scores: Sequence[Scores]) -> np.ndarray:
    """Return a key's scores as errors (S, N), seeds by images, of which lower is better."""
    values = np.array([of_seed[key] for of_seed in scores])
    return values if METRICS[key].direction == "lower" else 1 - values


def frame_costs(
    space: SearchSpace, dataset: LightTransportDataset, candidates: list[Candidate], seconds: float
) -> list[dict[str, Any]]:
    """Return each candidate's time per frame, by interleaved timing for `seconds`, and its sizes."""
    clock = Clock(Frames(dataset), default_device())
    modules = {candidate.slug: space.build(candidate) for candidate in candidates}
    fast = {slug: accelerate(module, clock.policy, clock.device) for slug, module in modules.items()}
    laps = clock.time_interleaved(fast, seconds)
    return [summary(laps[slug]) | clock.size(module) for slug, module in modules.items()]
