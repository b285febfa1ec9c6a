"""Training a copy of a model on its worst cases."""
