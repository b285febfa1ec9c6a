"""Runs as evidence for a model card or a safety case."""
