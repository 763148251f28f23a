"""Comparison, timing, tables and figures."""
