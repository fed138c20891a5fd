"""Censored robust regression, folds, evidence, intervals: mathematics that knows no radio."""
