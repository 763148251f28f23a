"""Image metrics as torchmetrics Metrics, and the display transform."""
