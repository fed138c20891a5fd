"""Closing the loop: find what a twin lacks in measured data, trace it to an effect, add that."""
