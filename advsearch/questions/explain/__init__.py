"""Why a model is wrong, in words, from rows of sweeps."""
