"""Predictors of images besides the matrix of light transport (`engine.prediction`)."""
