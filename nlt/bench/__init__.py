"""`nlt bench`: the cost of a frame, a training step and a sample."""
