"""Guards against what comes from others: what runs, connects, is written, is read, and
what a served page may do.

Each module has one rule. Anybody may import from here; nothing here imports more than
errors and other small modules.
"""
