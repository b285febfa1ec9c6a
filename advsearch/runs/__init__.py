"""What a run leaves behind: its directory, results, pictures and summary; docs/runs.md
says which names hold.
"""
