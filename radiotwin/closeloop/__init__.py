"""Close the loop: find what a model lacks in measured data, trace it to an effect, add it, say what it brought."""
