"""Benchmarks of `nodeslam bench`; figures of the past, with machine and versions, are in RESULTS.md."""
