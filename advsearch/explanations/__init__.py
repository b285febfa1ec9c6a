"""Why a model is wrong, in words: rules, parameters that matter, and where it can be relied on, from rows of sweeps."""
