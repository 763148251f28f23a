"""The shared U-Net, the Light Transport Layer and the LightningModules of the paper's model."""
