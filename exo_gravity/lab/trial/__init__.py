"""A trial: its script, what was recorded, the analysis and the verdict."""
