"""`nlt bench`: what a frame, a training step and a sample cost."""
