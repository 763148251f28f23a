"""Speedrun: the minutes that this machine takes from an empty dataset to three finish lines.

    python benchmarks/speedrun.py cnn --what "the starting point"
    python benchmarks/speedrun.py photons_only --set data.dataset.train=800 trainer.max_steps=800 --what "fewer steps"

The room, the test views and their references are fixed: by default those of data/demo at scale/recipe. The lines are
the FID and MSSIM of Open Image Denoise at 1 spp, and half the MSE of the first record, which must be the CNN at that
scale. The clock runs while the training set is rendered and while the method is trained, on all cores; it stands still
while the result is judged. Each run adds a record to records.csv and writes records.md.
"""

from __future__ import annotations

import argparse
import datetime
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from nlt.cli import exit_code
from nlt.config import merge, read_configs
from nlt.data.dataset import LightTransportDataset
from nlt.data.files import write_bytes
from nlt.data.generate import generate
from nlt.data.spec import load_spec
from nlt.data.store import ShardReader
from nlt.errors import UserError
from nlt.evaluation.comparison import build_if_untrained
from nlt.evaluation.frames import Frames
from nlt.evaluation.judge import Evaluation
from nlt.evaluation.provenance import origin, surroundings
from nlt.evaluation.results import read_rows, write_manifest, write_rows
from nlt.evaluation.trainings import fit, newest_checkpoint
from nlt.models.method import Method
from nlt.models.module import RenderingModule
from nlt.models.policy import Policy, default_device
from nlt.paths import find_config
from nlt.report.table_writer import grid

_LINES = {"fid": "FID", "mssim": "MSSIM", "mse": "MSE"}
_PEER = "oidn_1"


def passed(record: dict[str, Any], lines: dict[str, float]) -> str:
    """Return the numbers of the finish lines that a record passes, such as "line 1, line 3", or "none"."""
    better = {name: record[name] > line if name == "mssim" else record[name] < line for name, line in lines.items()}
    return ", ".join(f"line {number}" for number, name in enumerate(_LINES, 1) if better[name]) or "none"


def table(records: list[dict[str, Any]], lines: dict[str, float]) -> str:
    """Return the records and, for each line, the fastest record that passes it, in Markdown."""
    text = ["# Speedrun", ""]
    rows = []
    for number, (name, label) in enumerate(_LINES.items(), 1):
        through = [record for record in records if f"line {number}" in record["lines"]]
        best = min(through, key=lambda record: record["minutes"], default=None)
        cells = [f"{best['minutes']:.1f}", f"{best['method']}: {best['what']}"] if best else ["–", "not passed"]
        rows.append([number, f"{label} {'above' if name == 'mssim' else 'below'} {lines[name]:.4g}", *cells])
    text += grid(["line", "goal", "minutes", "record"], rows, numbers=False)
    headings = ["date", "commit", "method", "what changed", "rendering (min)", "training (min)", "total (min)",
                *_LINES.values(), "lines passed"]  # fmt: skip
    cells_of = lambda r: [
        r["date"], r["commit"][:7], r["method"], r["what"],
        *(f"{r[key]:.2f}" for key in ("render_min", "train_min", "minutes")),
        f"{r['fid']:.1f}", f"{r['mssim']:.4f}", f"{r['mse']:.5f}", r["lines"],
    ]  # fmt: skip
    return "\n".join([*text, *grid(headings, map(cells_of, records), numbers=False)])


def run(config: dict[str, Any], room: list[str], seed: int) -> dict[str, Any]:
    """Render the training set, train, and return the minutes of both and the trained method.

    `room` are the arguments of `nlt generate` that describe the training set. With data.online, its images are rendered
    while the method trains, and the first step renders points alone.
    """
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        # A process of its own, because each worker imports the main module again, and this one imports Lightning.
        own_room = ["data.dataset.val=0", "data.dataset.test=0", f"data.root={folder}"]
        if failed := subprocess.run([sys.executable, "-m", "nlt.cli", "generate", *room, *own_room]).returncode:
            sys.exit(failed)  # it has said why
        rendered = time.perf_counter()
        own = {"data": {"root": folder, "dataset": {"val": 0, "test": 0}}, "trainer": {"limit_val_batches": 0}}
        fit(Path(folder) / "run", merge(config, own), seed)
        trained = time.perf_counter()
        checkpoint = newest_checkpoint(Path(folder) / "run")
        assert checkpoint is not None
        method = RenderingModule.load_from_checkpoint(checkpoint, map_location=default_device()).eval()
    return {"method": method, "render_min": (rendered - begin) / 60, "train_min": (trained - rendered) / 60}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="a config in configs/model")
    parser.add_argument("--what", required=True, help="what this run changes, for the table")
    parser.add_argument("--variant", default="demodulated", help="a config in configs/variant")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings that override the configs")
    parser.add_argument("--data", default="demo", help="a config in configs/data, with the room")
    parser.add_argument("--scale", default="recipe", help="a config in configs/scale, with the test views")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", default="results/speedrun")
    options = parser.parse_args()
    settings = [tuple(setting.partition("=")[::2]) for setting in options.set]
    data, model, scale, variant = (
        str(find_config(kind, getattr(options, kind))) for kind in ("data", "model", "scale", "variant")
    )
    spec, root = load_spec([data, scale], settings)
    tests, out = spec.without_train(), Path(options.out)
    directory = generate(tests, root)
    shard = directory / tests.shard("test", 0, 0).name
    first_pixel = ShardReader().read(shard, 0, ["reference_a"])["reference_a"][:, 0, 0].tolist()
    device = default_device()
    judge = Evaluation(Frames(LightTransportDataset(directory, tests, "test")), device, Policy.for_device(device))
    lines_file, records_file = out / "lines.json", out / "records.csv"
    if not lines_file.exists():
        peer = build_if_untrained(_PEER)
        assert isinstance(peer, Method)
        line = judge.evaluate(peer)[0]
        content = {
            "fid": line["fid"],
            "mssim": line["mssim"],
            "views": tests.test,
            "first_pixel": first_pixel,
        }
        write_bytes(lines_file, json.dumps(content).encode())
    known = json.loads(lines_file.read_text())
    if known["first_pixel"] != first_pixel or known["views"] != tests.test:
        raise UserError(f"--set: changes the test views, so {lines_file} does not apply; leave them as they are")
    room = [f"--config={data}", f"--config={scale}", *options.set]
    result = run(read_configs([data, model, scale, variant], settings), room, options.seed)
    metrics = judge.evaluate(result.pop("method"))[0]
    provenance = origin()
    record = {
        "date": datetime.date.today().isoformat(), "commit": provenance["commit"], "method": options.model,
        "what": options.what, "settings": " ".join(options.set), "seed": options.seed, **result,
        "minutes": result["render_min"] + result["train_min"], **{name: metrics[name] for name in _LINES},
    }  # fmt: skip
    records = read_rows(records_file) if records_file.exists() else []  # only now: another run may have added one
    lines = {"fid": known["fid"], "mssim": known["mssim"], "mse": (records or [record])[0]["mse"] / 2}
    records.append(record | {"lines": passed(record, lines)})
    write_rows(records_file, records)
    write_bytes(out / "records.md", table(records, lines).encode())
    write_manifest(out, provenance | surroundings(device) | {"lines": lines, "torch_threads": torch.get_num_threads()})
    print(table(records, lines))


if __name__ == "__main__":
    sys.exit(exit_code(main))
