"""The answer of a run under other conditions."""
