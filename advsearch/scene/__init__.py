"""Scenes: assets, loading, importing, rendering. Importing this package imports neither
Mitsuba nor torch.
"""
