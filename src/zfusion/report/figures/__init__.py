"""Figures of runs and experiments: one module a family, plain numbers in, a matplotlib figure out.

Nothing here reads files or knows where the numbers are from. A figure is made without pyplot, so that no state is
shared between figures; `style` has what they have in common, `quantities` their labels and units.
"""
