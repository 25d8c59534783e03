"""Studies: real data, a model identified from them, a swarm that runs on them, and a score of how well it did."""
