"""Benchmarks: what each measures, in rows; their command lines stand in :mod:`plab.cli.bench`."""
