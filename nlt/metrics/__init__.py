"""torchmetrics Metrics and the one display transform."""
