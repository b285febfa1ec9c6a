"""What every question is answered with: problems, stages, replay, sweeps, plans and
domains.
"""
