"""The pieces that a scenario is written in, and what each of them means to the numerics."""
