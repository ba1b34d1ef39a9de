"""Whether the encoder still shows what the plant does, and the plant answers the effort as its model says."""
