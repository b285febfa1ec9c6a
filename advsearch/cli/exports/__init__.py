"""What a run is exported as besides a table of its rows: a module for each format, found by lying in this folder.

A module's docstring says in one sentence what comes out. It has

- `FORMAT`, the word of `--format`, and `WRITES`, what the name after `--out` is of: "a PDF file";
- `EXAMPLE`, a command line without `advsearch` in front;
- `ENDING`, where files of this ending are of this format if no other is asked for: "pdf";
- `write(args, out)`, which writes the run that the words of the command line name, and returns what to tell.
"""

Written = tuple[dict[str, object], str]
"""What to tell of a file, as JSON and in words."""
