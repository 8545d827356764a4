"""The next experiment: which feasible one tells the remaining hypotheses apart."""
