"""Collect the claims of runs as evidence for a model card or a safety case.

`advsearch report` writes the evidence.
"""
