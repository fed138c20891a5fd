"""Evidence, probabilities, intervals and the verdict, with the thresholds that decide it."""
