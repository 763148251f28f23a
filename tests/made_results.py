"""Results of a comparison, made up: any numbers, with or without noise over seeds and views."""

from __future__ import annotations

import re

import numpy as np

from nlt.evaluation.paper import paper
from nlt.evaluation.results import (
    IMAGES,
    OK,
    RUNS,
    TIMES,
    TIMINGS,
    VIEWS,
    load,
    write_images,
    write_manifest,
    write_rows,
)
from nlt.metrics.quantities import METRICS

VIEW_COUNT = 12


def papers_numbers(table):
    """{method: {column: value}} of the paper."""
    content = paper()[table]
    columns = content.get("columns", paper()["columns"])
    rows = {m: dict(zip(columns, row, strict=True)) for m, row in content.items() if m in paper()["labels"]}
    if table != "ablation":  # not in the paper: what the claims and the figures read besides
        traced = {"time_per_frame_s": 0.2, "mse": 0.05, "mssim": 0.3, "fid": 300.0, "feature_l1": 0.5}
        rows |= {f"path_tracing_{spp}": {k: v / spp**0.5 for k, v in traced.items()} for spp in (1, 4, 16)}
        rows |= {f"oidn_{spp}": {k: v / spp**0.5 / 2 for k, v in traced.items()} for spp in (1, 4)}
        for m, row in rows.items():
            dropped = (5 - m.count("1")) if m.startswith("denoising") else 0
            row |= {f"feature_l1_layer{k}": row["feature_l1"] * (k + 1) / 2 + dropped for k in range(4)}
            row |= {"unbiased_mse": row["mse"] / 2, "flip": 3 * row["mse"] ** 0.5, "psnr": -10 * np.log10(row["mse"])}
    return rows


def make_results(directory, rows, table, seeds=1, over_seeds=0.0, over_views=1e-4, images=False):
    """Results with these means; relative standard deviations over seeds and, in common to all methods, over views."""
    rng = np.random.default_rng(0)
    runs, views = [], []
    weather = 1 + over_views * rng.standard_normal(VIEW_COUNT)
    for method, row in rows.items():
        for seed in range(seeds):
            scale = {key: 1 + over_seeds * rng.standard_normal() for key in row}
            run = {"method": method, "seed": seed, "status": OK, "message": ""}
            run |= {key: value * scale[key] for key, value in row.items()}
            sparse = method.startswith(("denoising", "guided"))
            kind = "SparseDenoising" if sparse else method.partition("_")[0]
            one_in = int(method.rpartition("_")[2]) if sparse else 1
            traced = method.startswith(("path", "oidn"))
            spp = int(re.findall(r"\d+", method)[0]) if traced else 4 * sparse
            run |= {"time_per_frame_error_s": 1e-3 * row.get("time_per_frame_s", 0), "parameters": 1000}
            runs.append(run | {"family": kind, "pixel_fraction": 1 / one_in if spp else 0, "spp": spp})
            for view in range(VIEW_COUNT):
                own = 1 + over_views * rng.standard_normal()
                each = {"method": method, "seed": seed, "view": view}
                for key in row.keys() & METRICS.keys():
                    name = key if METRICS[key].per_image else f"{key}_without"
                    each[name] = row[key] * scale[key] * weather[view] * own
                views.append(each)
    write_rows(directory / RUNS, runs)
    write_rows(directory / VIEWS, views)
    manifest = {"table": table, "n_test": VIEW_COUNT, "seeds": list(range(seeds)), "shown": list(range(4))}
    write_manifest(directory, manifest | {"clock": {"timed_frames": 40}})
    if images:
        smooth = rng.random((4, 3, 32, 32)).cumsum(-1) / 16
        exposure, view = np.full(4, 0.8, np.float32), np.arange(4)
        write_images(directory, "reference", radiance=smooth, exposure=exposure, view=view)
        write_images(directory, "noisy", radiance=smooth * rng.exponential(size=smooth.shape))
        albedo = rng.random(smooth.shape)
        buffers = {"albedo": albedo, "normal": albedo - 0.5, "depth": albedo[:, :1], "transmits": albedo[:, 0] > 0.5}
        write_images(directory, "gbuffer", **buffers, light_in_view=view > 1)
        for k, method in enumerate(rows):
            write_images(directory, method, radiance=smooth * (1 + 0.05 * k * rng.standard_normal(smooth.shape)))
        assert (directory / IMAGES / "reference.npz").exists()
    return load(directory)


def time_elsewhere(results, device, **faster):
    """The times of a second device, each method's `faster` times shorter; methods without are not timed there."""
    rows = []
    for run in results.runs:
        if run["status"] == OK and run["method"] in faster:
            times = {key: run[key] / faster[run["method"]] for key in TIMES if key in run}
            row = {key: run.get(key) for key in ("method", "seed", "run")}
            rows.append({**row, "device": device, "dataset": "made_up", "commit": 20 * "cd", **times})
    write_rows(results.directory / TIMINGS, rows)
    return load(results.directory)


TROUBLED = (
    "denoising_1_1", "denoising_1_4", "denoising_1_64", "cnn", "nlt", "nlt_photons", "path_tracing_1",
    "path_tracing_4",
)  # fmt: skip
ODD = "odd & <method>"


def make_troubled_results(directory):
    """Two seeds, images, and every trouble: `nlt` diverged at one seed, `ODD` failed at both, nothing has FLIP."""
    rows = {m: {k: v for k, v in row.items() if k != "flip"} for m, row in papers_numbers("table2").items()}
    rows = {method: rows[method] for method in TROUBLED}
    results = make_results(directory, rows, "table2", seeds=2, over_seeds=0.02, over_views=0.1, images=True)
    bad = [{"method": ODD, "seed": seed, "status": "failed", "message": "it <b>broke</b>"} for seed in (0, 1)]
    lost = {"method": "nlt", "seed": 1, "status": "diverged", "message": "train/loss is nan"}
    runs = [lost if (run["method"], run["seed"]) == ("nlt", 1) else run for run in results.runs]
    write_rows(directory / RUNS, [*({**run, "run": f"runs/{run['method']}-{run['seed']}"} for run in runs), *bad])
    origin = {"command": "nlt compare --config made_up", "commit": 20 * "ab", "device": "CPU, made up"}
    origin |= {"integrators": {"egg": "bdpt", "kitchen": "path"}}
    configs = {method: {"model": {"init_args": {"width": 8}}} for method in TROUBLED}
    write_manifest(directory, {**results.manifest, **origin, "versions": {"torch": "2.0"}, "configs": configs})
    return load(directory)
