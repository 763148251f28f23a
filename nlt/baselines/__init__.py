"""The baselines: each a file that says what it feeds the shared U-Net."""
