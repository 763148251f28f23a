"""Datasets: the sample format, storage, generation and the DataModule."""
