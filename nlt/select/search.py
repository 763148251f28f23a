"""Successive halving of a space's candidates under a budget of time (Jamieson and Talwalkar 2016)."""

from __future__ import annotations

import hashlib
import json
import math
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import default_collate

from nlt.data.dataset import LightTransportDataset
from nlt.data.engines import Process
from nlt.data.files import write_bytes
from nlt.errors import UserError
from nlt.evaluation.clock import Clock, summary
from nlt.evaluation.frames import Frames
from nlt.models.module import RenderingModule
from nlt.models.policy import Policy, default_device
from nlt.select.choice import ranked
from nlt.select.space import Candidate, SearchSpace
from nlt.select.trials import SCORES, Trials, as_error

_ETA, _RUNGS = 3, 3  # one in three goes on, at most so often
_LEAST = 3  # candidates in the last round
_ENOUGH = 10  # candidates: below these, rather fewer steps
_TIMING = 0.1  # of the budget, at most, for the times per step, and as much for those per frame
_SETUP = 3.0  # seconds a training takes beside its steps, about
_RECENT = 5  # trainings, by which the estimates are corrected

now = time.perf_counter


@dataclass
class Entry:
    """What is known of a candidate: times and sizes; scores by seed, after `steps` steps; why it went no further."""

    candidate: Candidate
    cost: dict[str, Any]
    steps: int = 0
    status: str = ""


class Search:
    """Trains a space's candidates, the worse of them for a short time only.

    The full model and the best candidate of each method in `advised` go to the end: a method that has to learn what
    others are given, such as where light arrives in a scene in which nothing moves, is behind them at first.
    Every decision follows from what lies in `directory`: killed and started again, the search goes on and ends alike.
    """

    def __init__(self, space: SearchSpace, dataset: Any, root: Path, advised: Sequence[str] = ()) -> None:
        self.space, self.advised, self.budget = space, advised, 60.0 * space.minutes
        self.device = default_device()
        self.policy = Policy.for_device(self.device)
        decides = [space.config(candidate) for candidate in space.candidates]
        key = json.dumps([decides, self.policy.precision, space.minutes, space.seeds], sort_keys=True)
        self.directory = root / f"{space.name}-{hashlib.sha256(key.encode()).hexdigest()[:8]}"
        self.trials = Trials(space, dataset, self.directory, self.device, self.policy)
        self.spent = 0.0
        self.entries: dict[Candidate, Entry] = {}
        self.seeds = [0]
        self._ratios: list[float] = []  # of the time that trainings took, to what was estimated before the first
        trainer = space.config(space.full)
        self._most, batch_size = trainer["trainer"]["max_steps"], trainer["data"].get("batch_size", 32)
        self._epoch = max(1, len(space.spec.scenes) * space.spec.train // batch_size)
        self._batch_size = batch_size

    # --- the plan ---

    def plan(self) -> None:
        """Measure the candidates and decide how many fit, and the rounds.

        Raises:
            UserError: the budget is too small for any.
        """
        file = self.directory / "plan.json"
        if not file.exists():
            write_bytes(file, json.dumps(self._plan()).encode())
        plan = json.loads(file.read_text())
        self.rounds, self.spent = plan["rungs"], plan["spent_s"]
        torch.set_num_threads(plan["threads"])
        costs = dict(zip(self.space.candidates, plan["costs"], strict=False))
        self.entries = {candidate: Entry(candidate, cost) for candidate, cost in costs.items()}
        order = list(self.entries)
        fit = max((n for n in range(2, len(order) + 1) if self._fits(order, n, self.rounds)), default=2)
        counts = zip(self._counts(self.rounds, fit), self.rounds, strict=True)
        print(
            f"{fit} of {len(self.space.candidates)} candidates fit into {self.space.minutes:g} min: "
            + ", ".join(f"{n} for {steps} steps" for n, steps in counts)
            + (f", the last with {self.space.seeds} seeds" if self.space.seeds > 1 else "")
            + f"; about {(self.spent + self._cost(order[:fit], self.rounds)) / 60:.1f} min in all",
            flush=True,
        )

    def _plan(self) -> dict[str, Any]:
        """The steps of the rounds, and what every candidate costs: per step, and per frame with all taking turns."""
        begin, rounds = now(), self._steps(self._most)
        threads = self._set_fastest_threads()
        for candidate in self.space.candidates:
            if now() - begin > _TIMING * self.budget and len(self.entries) >= 2:
                break
            self.entries[candidate] = Entry(candidate, {"step_s": self._step_s(self.space.build(candidate))})
        order, enough = list(self.entries), min(_ENOUGH, len(self.entries))
        self.spent = now() - begin + _TIMING * self.budget
        while not self._fits(order, enough, rounds) and rounds[-1] > self._epoch:
            rounds = self._steps(max(rounds[-1] // 2, self._epoch))
        if not self._fits(order, 2, rounds):
            minutes = math.ceil(2 * (self.spent + self._cost(order[:2], rounds)) / 60)
            raise UserError(f"--minutes: {self.space.minutes:g} are too few for two candidates; give {minutes}")
        frames = Process(frame_costs, self.space, self.trials.split("val"), order, _TIMING * self.budget).result()
        costs = [self.entries[candidate].cost | frame for candidate, frame in zip(order, frames, strict=True)]
        return {"rungs": rounds, "costs": costs, "spent_s": now() - begin, "threads": threads}

    def _set_fastest_threads(self) -> int:
        """Train with one thread or with all: on a busy machine all are slower, for they wait for one another."""
        seconds = {}
        for threads in (1, torch.get_num_threads()):
            torch.set_num_threads(threads)
            seconds[threads] = self._step_s(self.space.build(self.space.full))
        threads = min(seconds, key=seconds.__getitem__)
        torch.set_num_threads(threads)
        return threads

    def _steps(self, last: int) -> list[int]:
        """Steps of the rounds, each a third of the next, in whole epochs: so going on is exact."""
        steps = [max(1, round(last / self._epoch)) * self._epoch if last > self._epoch else last]
        for k in range(1, _RUNGS):
            fewer = max(1, round(last / _ETA**k / self._epoch)) * self._epoch
            if fewer < steps[0]:
                steps.insert(0, fewer)
        return steps

    def _step_s(self, module: RenderingModule) -> float:
        """Seconds of a training step: the least of two, after a first."""
        data, wanted = self.trials.split("train", module.fields), self._batch_size
        batch = default_collate([data[k % len(data)] for k in range(wanted)])
        batch = {name: value.to(self.device) for name, value in batch.items()}
        module = module.to(self.device).train()
        (optimizer,), _ = module.configure_optimizers()
        seconds = []
        for _ in range(3):
            begin = now()
            with self.policy.applied(self.device):
                loss = module.loss(module(batch), batch["noisy"], batch["exposure"])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            float(loss.detach())
            seconds.append(now() - begin)
        return min(seconds[1:])

    def _counts(self, rounds: list[int], first: int) -> list[int]:
        """How many candidates are in each round, if so many are in the first."""
        return [max(math.ceil(first / _ETA**k), min(_LEAST, first)) for k in range(len(rounds))]

    def _estimate(self, candidate: Candidate, steps: int) -> float:
        """Seconds: as was measured before, corrected by what trainings took of late."""
        return self._nominal(candidate, steps) * (statistics.median(self._ratios[-_RECENT:]) if self._ratios else 1.0)

    def _nominal(self, candidate: Candidate, steps: int) -> float:
        return _SETUP + steps * float(self.entries[candidate].cost["step_s"])

    def _cost(self, order: list[Candidate], rounds: list[int], done: int = 0) -> float:
        """Seconds that the rounds from `done` on take at most, with `order` in the first of them; seeds included."""
        dearest = sorted(order, key=lambda c: (c != self.space.full, -self.entries[c].cost["step_s"]))
        counts, total = self._counts(rounds[done:], len(order)), 0.0
        for count, steps, begun in zip(counts, rounds[done:], [0, *rounds][done:], strict=False):
            total += sum(self._estimate(c, steps - begun) for c in dearest[:count])
        return total + (self.space.seeds - 1) * sum(self._estimate(c, rounds[-1]) for c in dearest[: counts[-1]])

    def _fits(self, order: list[Candidate], first: int, rounds: list[int], trained: int = 0) -> bool:
        """Whether the first of `order` fit into what is left of the budget; `trained` of them are through round one."""
        paid = sum(self._estimate(c, rounds[0]) for c in order[:trained])
        return self.spent - paid + self._cost(order[:first], rounds) <= self.budget

    # --- the search ---

    def run(self) -> list[Candidate]:
        """Those that were trained longest, each with scores of all `seeds`: at the same number of steps."""
        self.plan()
        finals = self._round(0, list(self.entries))
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
        while (last := self.rounds[-1]) < self._most:  # less had been hoped for than there was time
            rounds = [*self.rounds, min(_ETA * last, self._most // self._epoch * self._epoch)]
            if rounds[-1] == last or self.spent + self._cost(finals, rounds, len(self.rounds)) > self.budget:
                break
            self.rounds = rounds
            finals = self._round(len(rounds) - 1, self._order(finals)) or finals
        finals = self._more_seeds(finals)
        for candidate in finals:
            self.entries[candidate].status = "trained to the end"
        return finals

    def _round(self, k: int, order: list[Candidate]) -> list[Candidate]:
        """Train candidates up to a round, as long as there is time; those that did not diverge."""
        steps, begun = self.rounds[k], self.rounds[k - 1] if k else 0
        alive = []
        for number, candidate in enumerate(order, 1):
            late = self.spent + self._estimate(candidate, steps - begun) > self.budget
            if k == 0 and number > 2:  # room for the rounds that follow, too
                late = not self._fits(order, number, self.rounds, number - 1)
            if late and (candidate != self.space.full or self.spent >= self.budget):
                self.entries[candidate].status = f"no time left after {begun} steps"
                continue
            if self.train(candidate, 0, steps, begun):
                alive.append(candidate)
            left = (self.budget - self.spent) / 60
            print(f"round {k + 1} of {len(self.rounds)}, {number} of {len(order)}: {candidate.name}: {steps} steps; "
                  f"{left:.1f} of {self.space.minutes:g} min left", flush=True)  # fmt: skip
        return alive

    def _more_seeds(self, finals: list[Candidate]) -> list[Candidate]:
        """Train them with further seeds, as long as there is time for all; those that did not diverge."""
        steps = self.entries[finals[0]].steps
        for seed in range(1, self.space.seeds):
            left, done = list(finals), list[Candidate]()
            while left and self.spent + sum(self._estimate(c, steps) for c in left) <= self.budget:
                if self.train(left[0], seed, steps, 0):
                    done.append(left[0])
                del left[0]
            print(f"seed {seed}: {len(done)} of {len(finals)} candidates; "
                  f"{(self.budget - self.spent) / 60:.1f} of {self.space.minutes:g} min left", flush=True)  # fmt: skip
            if left or not done:
                break
            finals = done
            self.seeds.append(seed)
        return finals

    def _order(self, candidates: list[Candidate]) -> list[Candidate]:
        """Those worth going on with first: the full model, the best of each advised method, the others."""
        times = {c: float(self.entries[c].cost["time_per_frame_s"]) for c in candidates}
        order = ranked([self.errors(candidates, key) for key in SCORES], times)
        advised = {c.method: c for c in reversed(order) if c.method in self.advised}.values()
        return sorted(order, key=lambda c: 0 if c == self.space.full else 1 if c in advised else 2)

    def train(self, candidate: Candidate, seed: int, steps: int, begun: int) -> bool:
        """Train on from `begun` to `steps` and score on the validation split; False if it diverges."""
        entry = self.entries[candidate]
        found = self.trials.train(candidate, seed, steps, begun, entry.cost["step_s"])
        self.spent += found["seconds"]
        if "diverged" in found:
            entry.status = "diverged"
            return False
        self._ratios.append(found["seconds"] / self._nominal(candidate, steps - begun))
        entry.steps = steps
        return True

    def scores(self, candidate: Candidate, key: str, seeds: Sequence[int]) -> np.ndarray:
        """(S, N) on the validation split, after all the candidate's steps: seeds and images."""
        return self.trials.scores(candidate, key, seeds, self.entries[candidate].steps)

    def errors(self, candidates: list[Candidate], key: str) -> dict[Candidate, np.ndarray]:
        """Scores of candidates that were trained with all `seeds`, as errors: the lower the better."""
        return {c: as_error(key, self.scores(c, key, self.seeds)) for c in candidates}


def frame_costs(
    space: SearchSpace, dataset: LightTransportDataset, candidates: list[Candidate], seconds: float
) -> list[dict[str, Any]]:
    """What a frame of each candidate takes, all taking turns for `seconds`, and its sizes."""
    modules = {candidate.slug: space.build(candidate) for candidate in candidates}
    clock = Clock(Frames(dataset), default_device())
    laps = clock.time_interleaved(modules, seconds)
    return [summary(laps[slug]) | clock.size(module) for slug, module in modules.items()]
