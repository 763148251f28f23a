"""The baselines; each trained one is a file that defines the input of the shared U-Net."""
