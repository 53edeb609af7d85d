"""Simulated cell, object families, robots and synthetic datasets."""
