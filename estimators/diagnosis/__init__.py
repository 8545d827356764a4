"""Which physical effect is missing: evidence, verdict, and the loop that adds it."""
