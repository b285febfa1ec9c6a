"""Extreme scenes, objectives and arithmetic, and whether each of them holds."""
