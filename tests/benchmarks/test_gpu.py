"""benchmarks/gpu.py says what it needs. What it measures is measured on a GPU only."""

import gpu
import pytest
import torch


def test_without_a_gpu_there_is_one_clear_line(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["benchmarks/gpu.py"])
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit) as stopped:
        gpu.main()
    assert stopped.value.code == 2
    assert capsys.readouterr().err.splitlines()[-1].endswith("no CUDA device; benchmarks/bench.py measures a processor")
