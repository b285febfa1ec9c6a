"""The box around a configuration in which the verdict stays."""
