"""Predict images by light that is stored on surfaces, where only cameras move."""
