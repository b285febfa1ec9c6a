"""The engine of all experiments: problems, predictors of images, trials, gradients and
the journal.
"""
