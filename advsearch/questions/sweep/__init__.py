"""`sweep`: how often a model is right over a grid, or over draws by chance."""
