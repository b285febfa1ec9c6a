"""Guards against files, code and requests of others.

Each module has one rule: about code that runs, connections, files that are written or
read, or pages that are served. All modules may import from here. Modules here import
only errors and other small modules.
"""
