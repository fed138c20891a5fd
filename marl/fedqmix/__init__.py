"""Model-aided federated QMIX: the learner in `federation`, the command in `__main__`."""
