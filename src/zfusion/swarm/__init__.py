"""Swarms of processes: starting them, watching them, and leaving nothing behind."""
