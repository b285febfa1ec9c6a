"""What each command answers: one model a command, which table, page, JSON and docs read."""
