"""`compare`: two models, objects or answers beside each other, on the same pictures."""
