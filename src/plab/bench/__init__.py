"""Benchmarks: each prints a table and can write its data."""
