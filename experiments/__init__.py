"""Experiments and benchmarks, one module each: `python -m experiments.NAME`."""
