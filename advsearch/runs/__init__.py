"""What a run leaves behind (docs/runs.md): its directory, results, pictures and summary.

The names that others rely on, in a run directory:

- ``run.yaml``, ``results.sqlite``, ``summary.json``, ``report.html``;
- ``images/clean.png``, ``images/adversarial.png`` (and ``.exr``), ``images/difference.png``, ``images/search.gif``,
  ``images/verification-*.png``;
- ``artifacts/texture.png``, ``artifacts/texture-original.png`` and whatever else a control hands over.
"""
