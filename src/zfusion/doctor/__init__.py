"""What would go wrong with a swarm on this machine, found out before it is started.

A module for each topic. Each gives findings: what was looked at, how bad it is, why it matters, and what to do about
it. Nothing is changed, and nobody is talked to but the endpoints that the scenario or the hosts file names.

    finding       what a check gives
    ground        what is looked at: the scenario, the hosts file, which host this is, who listens and dials here
    scenario      the files, the method, the design
    versions      Python, packages, extras
    ports         the endpoints that processes here are to listen at
    names         the names and addresses that they are to dial
    clocks        whether the clock is kept right, and fast to read
    certificates  what a deployed folder proves of its processes
    disk          room and speed where the recording goes
    limits        descriptors, memory, processors
    namespaces    what ``launch --netns`` would choose
    running       nodes that run already: versions, scenarios, clocks
    examine       all of it
"""
