"""The sample, the store, generation and the DataModule."""
