"""Experiments that YAML files describe, and what their figures say."""
