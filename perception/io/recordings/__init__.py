"""Readers and writers of recorded RGB-D sequences."""
