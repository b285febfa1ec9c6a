"""Work-precision diagrams: error against run time, measured in interleaved rounds."""
