"""What the two-stage method is proven against: independent, slow, and as plain as the definitions.

    random_systems   random systems, graphs and used sets to prove it on, and `paper` the published example
    brute_force      least-squares projection on the stacked measurements: no recursion at all
    printed_form     the recursion as the paper prints it, one pair of nodes at a time

None of them uses the statistics that the library's own filters are fed with.
"""
