"""Benchmarks of `nodeslam bench`; the results are in docs/results.md."""
