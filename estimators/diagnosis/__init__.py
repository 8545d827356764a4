"""Diagnosis of the missing physical effect: evidence, verdict, and the loop that adds it."""
