"""The parts of `sweep`: axes, points, the loop that renders and stores, the summary."""
