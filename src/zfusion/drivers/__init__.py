"""The worlds that a node runs in: live on Zenoh, simulated in virtual time, replayed from a recording."""
