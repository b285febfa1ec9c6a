"""`advsearch test`: claims about a model, each answered held, failed or undecided (docs/testing.md)."""
