"""The tables of Section 5 from a study's results, the paper's numbers beside ours."""
