"""Swarms of processes: starting them, watching them, and leaving nothing behind.

launch     the launcher: starts all, watches until all have ended
processes  which processes there are, and their commands
child      one of them, as its launcher has it
control    the line between the two
fallen     nodes that were felled by plan: when they are raised again
standstill processes that somebody has stopped
ports      free ports of this machine
watch      what a long run does to its processes
netns      network namespaces for them
"""
