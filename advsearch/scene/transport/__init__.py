"""Predict images by linear light transport, where nothing moves."""
