"""Statistics without radio: censored robust regression, folds, evidence, interval widths."""
