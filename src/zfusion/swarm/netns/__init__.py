"""The live swarm in network namespaces: real processes, the kernel's own TCP, and links as the scenario says."""
