"""Comparison of methods: training, evaluation, timing, and results on disk."""
