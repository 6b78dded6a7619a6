"""The figures of Section 5 from a study's results."""
